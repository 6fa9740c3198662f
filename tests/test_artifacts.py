import dataclasses
import json

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.artifacts import load_artifact, load_flows, load_stage_image, save_artifact, save_flows
from turbrestore.centroid import Centroid, CentroidParams
from turbrestore.deconvolution import Deconvolution
from turbrestore.errors import ConfigurationError, DataError, InputNotFoundError, OutputError
from turbrestore.flow_model import FlowDynamics
from turbrestore.images import write_image
from turbrestore.pipeline import RestoreParams, restore


@pytest.fixture(scope="module")
def restoration():
    frames = make_sequence(seed=21, count=6, size=64, rms=0.6).frames
    return restore(frames, RestoreParams(centroid=CentroidParams(iterations=1)))


@pytest.mark.parametrize("stage", ["centroid", "dynamics", "filtered", "deconvolution"])
def test_a_result_comes_back_as_it_was(restoration, stage, tmp_path):
    result = getattr(restoration, stage)
    path = tmp_path / f"{stage}.npz"
    save_artifact(path, result)
    again = load_artifact(path, type(result))
    for item in dataclasses.fields(result):
        before, after = getattr(result, item.name), getattr(again, item.name)
        assert type(before) is type(after), item.name
        assert np.array_equal(before, after), item.name


def test_an_image_is_read_from_artifacts_and_files(restoration, tmp_path):
    save_artifact(tmp_path / "a.npz", restoration.centroid)
    assert (load_stage_image(tmp_path / "a.npz") == restoration.centroid.image).all()
    write_image(tmp_path / "a.tif", restoration.centroid.image, 32)
    assert np.allclose(load_stage_image(tmp_path / "a.tif"), np.clip(restoration.centroid.image, 0, 1))
    save_artifact(tmp_path / "d.npz", restoration.dynamics)
    with pytest.raises(DataError, match="expected an artifact with an image, found a dynamics"):
        load_stage_image(tmp_path / "d.npz")


def test_flows_come_back(restoration, tmp_path):
    save_flows(tmp_path / "f.npy", restoration.centroid.flows)
    assert (load_flows(tmp_path / "f.npy") == restoration.centroid.flows).all()
    save_artifact(tmp_path / "c.npz", restoration.centroid)
    assert (load_flows(tmp_path / "c.npz") == restoration.centroid.flows).all()


def test_existing_files_and_other_suffixes_are_refused(restoration, tmp_path):
    path = tmp_path / "c.npz"
    save_artifact(path, restoration.centroid)
    with pytest.raises(OutputError, match="exists already"):
        save_artifact(path, restoration.centroid)
    save_artifact(path, restoration.centroid, overwrite=True)
    with pytest.raises(ConfigurationError, match=r"ends in \.npz"):
        save_artifact(tmp_path / "c.zip", restoration.centroid)
    with pytest.raises(ConfigurationError, match=r"ends in \.npy"):
        save_flows(tmp_path / "f.npz", restoration.centroid.flows)


def test_damage_and_other_kinds_are_told_apart(restoration, tmp_path):
    path = tmp_path / "c.npz"
    save_artifact(path, restoration.centroid)
    with pytest.raises(DataError, match="expected a dynamics artifact, found a centroid"):
        load_artifact(path, FlowDynamics)
    data = path.read_bytes()
    (tmp_path / "cut.npz").write_bytes(data[: len(data) // 2])
    (tmp_path / "text.npz").write_text("not an artifact")
    np.savez(tmp_path / "plain.npz", a=np.zeros(3))
    np.savez(tmp_path / "pickled.npz", header=np.array({"kind": "centroid"}, dtype=object))
    for name in ("cut", "text", "plain", "pickled"):
        with pytest.raises(DataError, match="expected an artifact of turbrestore"):
            load_artifact(tmp_path / f"{name}.npz", Centroid)
    with pytest.raises(InputNotFoundError):
        load_artifact(tmp_path / "none.npz", Centroid)


def test_another_layout_or_missing_field_is_refused(restoration, tmp_path):
    for name, header in (
        ("newer", {"kind": "deconvolution", "schema": 99, "fields": {}}),
        ("unknown", {"kind": "hologram", "schema": 1, "fields": {}}),
        ("partial", {"kind": "deconvolution", "schema": 1, "fields": {}}),
    ):
        np.savez(tmp_path / f"{name}.npz", header=np.array(json.dumps(header)))
        with pytest.raises(DataError, match="expected"):
            load_artifact(tmp_path / f"{name}.npz", Deconvolution)


def test_flows_of_another_shape_are_refused(tmp_path):
    np.save(tmp_path / "f.npy", np.zeros((4, 4, 2)))
    with pytest.raises(DataError, match="shape"):
        load_flows(tmp_path / "f.npy")
    (tmp_path / "t.npy").write_text("text")
    with pytest.raises(DataError, match="found something else"):
        load_flows(tmp_path / "t.npy")
