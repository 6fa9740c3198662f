import dataclasses
import json
import zipfile
from typing import get_type_hints

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.blur.estimation import BlurEstimate
from turbrestore.core.errors import ConfigurationError, DataError, InputNotFoundError, OutputError
from turbrestore.deconvolution.deconvolve import Deconvolution
from turbrestore.dynamics.flow_model import FlowDynamics
from turbrestore.io.images.image_files import write_image
from turbrestore.io.npy import write_npz
from turbrestore.pipeline import RestoreParams, restore
from turbrestore.registration.centroid import Centroid, CentroidParams
from turbrestore.registration.recentring import recentre
from turbrestore.runs.stage_fields import FIELDS, ArraySpec
from turbrestore.runs.stage_files import (
    KINDS,
    load_artifact,
    load_flows,
    load_guide,
    load_stage_image,
    save_artifact,
    save_flows,
)
from turbrestore.runtime.scratch import new_stack


@pytest.fixture(scope="module")
def restoration():
    frames = make_sequence(seed=21, count=6, size=64, rms=0.6, blur=2.0).frames
    return restore(frames, RestoreParams(centroid=CentroidParams(iterations=1)))


def test_an_image_is_read_from_artifacts_and_files(restoration, tmp_path):
    save_artifact(tmp_path / "a.npz", restoration.centroid)
    assert (load_stage_image(tmp_path / "a.npz") == restoration.centroid.image).all()
    write_image(tmp_path / "a.tif", restoration.centroid.image, 32)
    assert np.allclose(load_stage_image(tmp_path / "a.tif"), np.clip(restoration.centroid.image, 0, 1))
    save_artifact(tmp_path / "d.npz", restoration.dynamics)
    with pytest.raises(DataError, match="expected a stage file with an image, found a dynamics"):
        load_stage_image(tmp_path / "d.npz")


def test_only_a_centroid_follows_the_geometry_of_a_filtered_image(restoration, tmp_path):
    centroid, flow = restoration.centroid, np.full_like(restoration.filtered.mean_flow, 0.5)
    save_artifact(tmp_path / "c.npz", centroid)
    save_artifact(tmp_path / "f.npz", dataclasses.replace(restoration.filtered, mean_flow=flow))
    moved = load_guide(tmp_path / "c.npz", tmp_path / "f.npz")
    assert (moved == recentre(centroid.image, flow)).all()
    assert not (moved == centroid.image).all()
    assert (load_guide(tmp_path / "c.npz", tmp_path / "c.npz") == centroid.image).all()
    assert (load_guide(tmp_path / "f.npz", tmp_path / "f.npz") == restoration.filtered.image).all()
    small = dataclasses.replace(restoration.filtered, image=np.zeros((8, 8), np.float32), mean_flow=flow[:8, :8])
    save_artifact(tmp_path / "s.npz", dataclasses.replace(small, variance=np.ones((8, 8), np.float32)))
    with pytest.raises(DataError, match=r"c\.npz: expected the size of .*s\.npz, \(8, 8\), found"):
        load_guide(tmp_path / "c.npz", tmp_path / "s.npz")


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
    with pytest.raises(DataError, match="expected a dynamics stage file, found a centroid"):
        load_artifact(path, FlowDynamics)
    data = path.read_bytes()
    (tmp_path / "cut.npz").write_bytes(data[: len(data) // 2])
    (tmp_path / "text.npz").write_text("not a stage file")
    np.savez(tmp_path / "plain.npz", a=np.zeros(3))
    np.savez(tmp_path / "pickled.npz", header=np.array({"kind": "centroid"}, dtype=object))
    for name in ("cut", "text", "plain", "pickled"):
        with pytest.raises(DataError, match="expected a stage file of turbrestore"):
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
        told = "missing required field `image`" if name == "partial" else "expected a stage file of layout 1, found"
        with pytest.raises(DataError, match=told):
            load_artifact(tmp_path / f"{name}.npz", Deconvolution)


def test_flows_of_another_shape_are_refused(tmp_path):
    np.save(tmp_path / "f.npy", np.zeros((4, 4, 2)))
    with pytest.raises(DataError, match="shape"):
        load_flows(tmp_path / "f.npy")
    (tmp_path / "t.npy").write_text("text")
    with pytest.raises(DataError, match="found something else"):
        load_flows(tmp_path / "t.npy")


def test_every_array_of_every_kind_has_its_shape_and_range():
    for kind, cls in KINDS.items():
        others = {name for name, hint in get_type_hints(cls).items() if hint in (bool, int, float, tuple[str, ...])}
        arrays = {name for name, wanted in FIELDS[kind].items() if isinstance(wanted, ArraySpec)}
        assert arrays == {item.name for item in dataclasses.fields(cls)} - others


def text_of(array):
    return array.astype("U8")


def short(array):
    return array[:-1]


def spoilt(value, place=0):
    def change(array):
        changed = array.copy()
        changed.flat[place] = value
        return changed

    return change


DOCTORED = [
    *[("centroid", "flows", change) for change in (np.sum, short, text_of, spoilt(np.nan), np.float64)],
    *[("centroid", "image", change) for change in (np.ravel, spoilt(np.inf), text_of, lambda image: image[..., None])],
    ("centroid", "mean_flow_sizes", lambda sizes: sizes[:0]),
    *[("dynamics", field, text_of) for field in ("A", "C", "Q", "mean_flow", "states")],
    *[("dynamics", field, text_of) for field in ("residual_variance", "singular_values")],
    *[("dynamics", field, short) for field in ("A", "C", "residual_variance", "singular_values")],
    *[("dynamics", "mean_flow", spoilt(value)) for value in (np.nan, 1e30)],
    *[("dynamics", "states", change) for change in (spoilt(np.nan), lambda states: states[:, :1])],
    *[("dynamics", "Q", change) for change in (np.negative, spoilt(1e6, 1), spoilt(np.nan))],
    *[("dynamics", "residual_variance", change) for change in (spoilt(np.nan), spoilt(-1.0))],
    *[("filtered", "variance", change) for change in (spoilt(np.nan), spoilt(-1.0), short)],
    *[("filtered", "gains", change) for change in (text_of, short, spoilt(np.nan))],
    ("filtered", "innovations", spoilt(np.inf)),
    ("deconvolution", "recorded", np.float64),
    ("deconvolution", "objective", short),
]


@pytest.mark.parametrize(("stage", "field", "change"), DOCTORED)
def test_arrays_that_no_stage_makes_are_refused_by_name(restoration, tmp_path, stage, field, change):
    result = getattr(restoration, stage)
    changed = np.asarray(change(getattr(result, field)))
    if stage == "centroid" and field == "flows" and changed.dtype == np.float32 and changed.ndim == 4:
        # Any number of flows is right; of rows, those of the image.
        changed = changed[:, :-1] if np.isfinite(changed).all() else changed
    path = tmp_path / "a.npz"
    save_artifact(path, dataclasses.replace(result, **{field: changed}))
    with pytest.raises(DataError, match=rf"a\.npz: expected {field} .*found") as caught:
        load_artifact(path, type(result))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("stage", "field", "value"),
    [
        ("dynamics", "R", -5.0),
        ("dynamics", "R", float("nan")),
        ("dynamics", "R", "one"),
        ("dynamics", "R", 10**400),
        ("dynamics", "energy_share", True),
        ("dynamics", "notes", [1]),
        ("dynamics", "notes", "text"),
        ("dynamics", "overfitted", 1),
        ("filtered", "image_noise", float("inf")),
        ("deconvolution", "iterations", 1.5),
    ],
)
def test_figures_that_no_stage_makes_are_refused_by_name(restoration, tmp_path, stage, field, value):
    result = getattr(restoration, stage)
    save_artifact(tmp_path / "a.npz", dataclasses.replace(result, **{field: value}))
    told = f"Number out of range in {field}" if value == 10**400 else rf"expected {field}\b.*found"
    with pytest.raises(DataError, match=rf"a\.npz: {told}"):
        load_artifact(tmp_path / "a.npz", type(result))


@pytest.mark.parametrize(
    "header",
    [
        "[" * 100_000,
        "9" * 6000,
        '{"kind": "blur", "schema": true, "fields": {"sigma": 1}}',
        '{"kind": "blur", "schema": 1.0, "fields": {"sigma": 1}}',
        '{"kind": ["blur"], "schema": 1, "fields": {"sigma": 1}}',
        '{"kind": "blur", "schema": 1, "fields": [1]}',
        '{"kind": "blur", "schema": 1, "fields": {}, "levels": [0, 0]}',
        '{"kind": "blur", "schema": 1, "fields": {}, "levels": [NaN, 2]}',
        '{"kind": "blur", "schema": 1, "fields": {}, "levels": 2}',
    ],
)
def test_odd_headers_are_refused(tmp_path, header):
    np.savez(tmp_path / "a.npz", header=np.array(header))
    with pytest.raises(DataError, match=r"a\.npz: expected a stage file of"):
        load_artifact(tmp_path / "a.npz", BlurEstimate)


@pytest.mark.parametrize(
    "view",
    [
        lambda stack: stack,
        lambda stack: stack.T,
        lambda stack: stack[:, 1:-1, 2:],
        lambda stack: stack[::-1],
        lambda stack: stack[:0],
    ],
)
def test_mapped_arrays_are_written_part_by_part_as_numpy_writes_them(tmp_path, monkeypatch, view):
    stack = new_stack((5, 6, 7), tmp_path)
    stack[...] = np.arange(210).reshape(5, 6, 7)
    monkeypatch.setattr("turbrestore.runtime.scratch._PART", 20)
    largest = []
    monkeypatch.setattr("turbrestore.runtime.scratch.drop_pages", lambda part: largest.append(part.size))
    with (tmp_path / "a.npz").open("wb") as stream:
        write_npz(stream, {"x": view(stack)})
    np.savez(tmp_path / "b.npz", x=view(np.asarray(stack)))
    contents = [zipfile.ZipFile(tmp_path / name).read("x.npy") for name in ("a.npz", "b.npz")]
    assert contents[0] == contents[1]
    assert max(largest, default=0) <= 42
