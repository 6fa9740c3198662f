"""Operators on all pairs of a nonlocal graph at once, by their definitions: the oracle of the compiled loops.

A function on pairs has shape (2, E): row 0 is its value from the tail to the head of each pair, row 1 from the head to
the tail.
"""

import numpy as np

from turbrestore.deconvolution.nonlocal_prior.nonlocal_weights import NonlocalGraph


def tails(graph: NonlocalGraph) -> np.ndarray:
    return np.repeat(np.arange(len(graph.starts) - 1, dtype=np.int32), np.diff(graph.starts))


def weight_matrix(graph: NonlocalGraph) -> np.ndarray:
    count = graph.shape[0] * graph.shape[1]
    matrix = np.zeros((count, count))
    matrix[tails(graph), graph.heads] = graph.roots.astype(np.float64) ** 2
    return matrix + matrix.T


def gradient(graph: NonlocalGraph, u: np.ndarray) -> np.ndarray:
    along = (u.ravel()[graph.heads] - u.ravel()[tails(graph)]) * graph.roots
    return np.stack([along, -along])


def divergence(graph: NonlocalGraph, v: np.ndarray) -> np.ndarray:
    net, size = (v[0] - v[1]) * graph.roots, graph.shape[0] * graph.shape[1]
    found = np.bincount(tails(graph), net, size) - np.bincount(graph.heads, net, size)
    return found.reshape(graph.shape).astype(np.float32)


def magnitude(graph: NonlocalGraph, v: np.ndarray) -> np.ndarray:
    squares = np.bincount(_owners(graph), np.square(v).ravel(), graph.shape[0] * graph.shape[1])
    return np.sqrt(squares).astype(np.float32).reshape(graph.shape)


def project(graph: NonlocalGraph, v: np.ndarray) -> np.ndarray:
    return v / np.maximum(magnitude(graph, v), 1).ravel()[_owners(graph)].reshape(v.shape)


def total_variation(graph: NonlocalGraph, u: np.ndarray) -> float:
    return float(magnitude(graph, gradient(graph, u)).sum(dtype=np.float64))


def _owners(graph: NonlocalGraph) -> np.ndarray:
    """Pixel that each value of a flattened function on pairs leaves."""
    return np.concatenate([tails(graph), graph.heads])
