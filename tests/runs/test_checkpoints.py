"""Checkpoints of the filter: when they are written, what is in them, and what goes on from them."""

from dataclasses import astuple, replace

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.core.errors import DataError
from turbrestore.filtering.estimates import Gaussian, PixelGaussian
from turbrestore.filtering.filter_records import FilterCheckpoint, FilterParams, FilterState, FrameRecord
from turbrestore.pipeline import RestoreParams, restore
from turbrestore.registration.centroid import CentroidParams
from turbrestore.runs.checkpoint import load_checkpoint, save_checkpoint
from turbrestore_cli.__main__ import main

from .conftest import WORDS


def test_a_checkpoint_is_as_far_back_as_asked_for_at_most(place, monkeypatch):
    saved = []
    monkeypatch.setattr(
        "turbrestore.runs.run_folder.save_checkpoint", lambda _, checkpoint, key: saved.append(len(checkpoint.records))
    )
    main([word.replace("every=8", "every=18") for word in WORDS])
    # The next block of eight would end 24 frames after the last checkpoint.
    assert saved == [16, 28]


def test_a_checkpoint_comes_back_bit_for_bit(tmp_path):
    rng = np.random.default_rng(0)
    for rank, shape in ((0, (5, 4)), (3, (5, 4, 3))):
        image = PixelGaussian(rng.normal(size=shape).astype(np.float32), rng.uniform(size=(5, 4)).astype(np.float32))
        flow = Gaussian(rng.normal(size=rank), 0.1 * np.eye(rank))
        records = tuple(FrameRecord(rng.normal(size=rank), 0.1 * k, np.nan, np.nan, 3.0) for k in range(4))
        state = FilterState(image, flow, *rng.normal(size=(2, 5, 4, 2)).astype(np.float32))
        checkpoint = FilterCheckpoint(state, records, 2 * image.mean)
        save_checkpoint(tmp_path / "c.npz", checkpoint, "key")
        found = load_checkpoint(tmp_path / "c.npz", "key")
        np.testing.assert_equal(astuple(found), astuple(checkpoint))
        assert found.reference.dtype == found.state.image.mean.dtype == np.float32
    with pytest.raises(DataError, match="other frames or settings"):
        load_checkpoint(tmp_path / "c.npz", "other")


class Recorder:
    """A store that keeps everything in memory, and starts from a part of it."""

    def __init__(self, results=(), start=None):
        self.results, self.start, self.checkpoints = dict(results), start, []

    def get(self, name, compute):
        if name not in self.results:
            self.results[name] = compute()
        return self.results[name]

    def has(self, name):
        return name in self.results

    def set_levels(self, levels):
        pass

    def filter_start(self):
        return self.start

    def checkpoint(self, state):
        self.checkpoints.append(state)


def test_from_every_point_the_library_ends_the_same():
    grey = make_sequence(seed=42, count=16, size=32, scene="camera", rms=0.6).frames
    frames = grey[..., None] * np.float32([1, 0.8, 0.6])
    params = RestoreParams(
        train=8,
        keep_best=0.6,
        centroid=CentroidParams(iterations=1),
        filter=FilterParams(block=4, image_drift=1e-5),
    )
    params = replace(params, deconvolution=replace(params.deconvolution, iterations=2))
    first = Recorder()
    expected = restore(frames, params, store=first)
    names = list(first.results)
    assert names == ["centroid", "dynamics", "filtered", "mean", "deblurred"]
    assert [len(state.records) for state in first.checkpoints] == [8, 12, 16]
    points = [Recorder([(name, first.results[name]) for name in names[:count]]) for count in range(1, len(names) + 1)]
    points += [Recorder([(name, first.results[name]) for name in names[:2]], state) for state in first.checkpoints]
    for store in points:
        found = restore(frames, params, store=store)
        assert np.array_equal(found.image, expected.image)
        assert np.array_equal(found.mean, expected.mean)
        assert np.array_equal(found.filtered.shares, expected.filtered.shares)
        assert found.decisions == expected.decisions
