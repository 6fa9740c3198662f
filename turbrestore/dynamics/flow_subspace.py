"""Subspace of the flows by the method of snapshots: singular values and modes from the τ×τ Gram matrix.

Symbols (paper 3, sections 3.1 and 3.2)
---------------------------------------
τ, n : number of flows, number of states
W̄ : mean flow
X : matrix of the flows minus W̄, 2HW × τ, one flow in each column
U Σ Vᵀ : singular value decomposition of X
G : Gram matrix Xᵀ X = V Σ² Vᵀ
C : first n columns of U; Ξ : first n rows of Σ Vᵀ

U is never formed: G is summed over strips of image rows, and C = X V Σ⁻¹ is computed strip by strip. The sums are
float64: float32 would save less than a tenth of a second at τ = 100 and 256², and rounding would hide the small
singular values.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.arrays import FloatArray, check_flow
from ..core.errors import DataError
from ..runtime.scratch import iter_slices, new_stack
from ..runtime.threads import map_ahead, sum_in_threads
from .flow_model import Float64Array

# Bytes of a float64 strip of all flows, of which each thread has one in memory.  Flows that are computed on the fly are
# computed again for every strip, so their strips are larger.
_STRIP_BYTES, _STRIP_BYTES_MADE = 2**22, 2**25


@dataclass(frozen=True)
class FlowStrips:
    """Reads all flows strip by strip of image rows, whatever container the flows are in."""

    flows: FloatArray | Iterable[FloatArray]  # (τ, H, W, 2), or iterable of arrays of shape (H, W, 2)
    # τ, H and W.
    count: int
    height: int
    width: int
    # Strips of an array that are worked on side by side, 0 for one per available core; flows in other containers may be
    # computed on the fly and are read by one thread.
    threads: int = 0

    @classmethod
    def of(cls, flows: FloatArray | Iterable[FloatArray], threads: int = 0) -> FlowStrips:
        """Check the shapes of flows.

        ``flows`` (τ, H, W, 2), or iterable of arrays of shape (H, W, 2).
        """
        if isinstance(flows, np.ndarray):
            shapes = [flows.shape[1:]] * len(flows) if flows.ndim else []
        elif not isinstance(flows, Iterable) or iter(flows) is flows:
            raise DataError(
                f"flows: expected an array or an iterable that can be iterated again, "
                f"found {type(flows).__name__}; make a list of it"
            )
        else:
            shapes = [np.shape(flow) for flow in flows]
        if len(shapes) < 2:
            raise DataError(f"flows: expected at least 2 flows, found {len(shapes)}")
        for shape in shapes:
            if len(shape) != 3 or shape[2] != 2 or 0 in shape or shape != shapes[0]:
                raise DataError(f"flows: expected all of one shape (H, W, 2), found {shape} beside {shapes[0]}")
        height, width = shapes[0][:2]
        return cls(flows, len(shapes), height, width, threads if isinstance(flows, np.ndarray) else 1)

    def rows(self, *written: object) -> Iterator[slice]:
        """Rows of each strip."""
        size = _STRIP_BYTES if isinstance(self.flows, np.ndarray) else _STRIP_BYTES_MADE
        step = max(size // (16 * self.count * max(self.width, 1)), 1)
        return iter_slices(self.height, step, self.flows, *written)

    def read(self, rows: slice) -> Float64Array:
        """Flows of these rows.

        Returns (τ, numbers).
        """
        flows = self.flows
        strip = flows[:, rows] if isinstance(flows, np.ndarray) else np.stack([np.asarray(f)[rows] for f in flows])
        return check_flow(strip, "flows").astype(np.float64).reshape(self.count, -1)


def gram_matrix(strips: FlowStrips) -> tuple[FloatArray, Float64Array, float]:
    """Gram matrix of the flows without their mean, strip by strip.

    Returns ``mean`` (H, W, 2), ``gram`` (τ, τ).
    """
    mean = np.empty((strips.height, strips.width, 2), np.float32)

    def add(batch: list[slice]) -> tuple[Float64Array, ...]:
        gram, energy = np.zeros((strips.count, strips.count)), np.zeros(())
        for rows in batch:
            strip = strips.read(rows)
            energy += np.vdot(strip, strip)
            flat = strip.mean(0).astype(np.float32)
            mean[rows] = flat.reshape(mean[rows].shape)
            strip -= flat
            gram += strip @ strip.T
        return gram, energy

    gram, energy = sum_in_threads(add, strips.rows(), strips.threads)
    return mean, gram, float(np.sqrt(energy))


def singular_vectors(gram: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Singular values of X, and V.

    ``gram`` (τ, τ); returns ``values`` (τ,), ``V`` (τ, τ).
    """
    values, V = np.linalg.eigh(gram)
    values, V = np.sqrt(np.maximum(values[::-1], 0.0)), V[:, ::-1]
    largest = V[np.abs(V).argmax(0), np.arange(len(V))]
    return values, V * np.where(largest < 0, -1.0, 1.0)


def spatial_modes(
    strips: FlowStrips,
    mean: FloatArray,
    singular_values: Float64Array,
    V: Float64Array,
    scratch: Path | None = None,
) -> tuple[FloatArray, Float64Array]:
    """C = X V Σ⁻¹ and the energy outside its subspace, strip by strip.

    ``mean`` (H, W, 2); ``singular_values`` (n,); ``V`` (τ, n); returns ``C`` (2 H W, n), ``energy`` (H, W).
    """
    # Stored mode after mode: products with C and with Cᵀ are then twice as fast.
    C = new_stack((len(singular_values), *mean.shape), scratch)
    energy = np.empty(mean.shape[:2])

    def fill(rows: slice) -> None:
        strip = strips.read(rows)
        strip -= mean[rows].reshape(-1)
        modes = strip.T @ V
        # V has orthonormal columns, so the energies of modes and residual add up.
        left = np.einsum("tx,tx->x", strip, strip) - np.einsum("xi,xi->x", modes, modes)
        energy[rows] = np.maximum(left, 0.0).reshape(mean[rows].shape).mean(-1)
        C[:, rows] = (modes / singular_values).T.reshape(C[:, rows].shape)

    for _ in map_ahead(fill, strips.rows(C), strips.threads):
        pass
    return C.reshape(len(singular_values), mean.size).T, energy
