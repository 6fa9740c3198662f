"""The plugin of napari: what a clip becomes, and what the widget adds."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.core.errors import DataError
from turbrestore.io.video import open_frames, write_video
from turbrestore.pipeline import restore
from turbrestore.settings import RestoreParams
from turbrestore_napari.reader import get_reader
from turbrestore_napari.widget import clip_of, layers_of, restore_layer, vectors

FRAMES = make_sequence(seed=7, count=6, size=64, rms=0.8).frames
# napari weighs hundreds of megabytes, so no environment of the tests has it.
needs_napari = pytest.mark.skipif(
    importlib.util.find_spec("napari") is None, reason="napari is not installed: pip install 'turbrestore[napari]'"
)


class FakeLayer:
    """What the widget asks of a layer."""

    def __init__(self, data, rgb=False, **metadata):
        self.data, self.rgb, self.metadata, self.name = data, rgb, metadata, "clip"


@pytest.fixture(params=[".ser", ".mkv"])
def clip(tmp_path, request):
    path = tmp_path / f"clip{request.param}"
    write_video(path, FRAMES, 25, 16)
    return path


def test_a_clip_is_a_layer_whose_frames_are_read_when_they_are_asked_for(clip):
    ((data, settings, kind),) = get_reader(str(clip))(str(clip))
    assert (kind, settings["name"], settings["rgb"], data.shape) == ("image", "clip", False, FRAMES.shape)
    np.testing.assert_array_equal(data[4].compute(scheduler="synchronous"), open_frames(clip).read(4, 5)[0])


def test_what_is_no_clip_is_left_to_others():
    assert get_reader("notes.txt") is None and get_reader(["a.ser", "b.ser"]) is None
    assert get_reader("a.FITS") is get_reader("a.fits.gz") is not None


def test_frames_come_from_the_file_or_from_the_array(clip):
    ((data, settings, _),) = get_reader(str(clip))(str(clip))
    for layer in (FakeLayer(data, **settings["metadata"]), FakeLayer(open_frames(clip).read())):
        np.testing.assert_array_equal(clip_of(layer).read(), open_frames(clip).read())
    with pytest.raises(DataError, match="expected frames of shape"):
        clip_of(FakeLayer(np.zeros((64, 64, 3)), rgb=True))


def test_layers_of_a_restoration():
    found = restore(FRAMES, RestoreParams(until="filter", border="crop"))
    uncertainty, motion, result = layers_of(found, "clip", (10.0, 20.0))
    x, y = found.crop[:2]
    assert result[0] is found.image and result[1]["translate"] == uncertainty[1]["translate"] == (10 + y, 20 + x)
    assert uncertainty[0] is found.uncertainty and np.isfinite(uncertainty[1]["contrast_limits"]).all()
    assert motion[2] == "vectors" and motion[1]["translate"] == (0, 10, 20)


def test_arrows_begin_at_pixels_and_follow_the_flow():
    flows = np.random.default_rng(0).normal(size=(3, 80, 40, 2)).astype(np.float32)
    arrows = vectors(flows)
    assert arrows.shape == (3 * 40 * 20, 2, 3)
    for (t, y, x), (still, down, across) in arrows[::17]:
        assert still == 0 and (across, down) == tuple(flows[int(t), int(y), int(x)])


def test_the_manifest_names_what_there_is():
    manifest = Path(importlib.util.find_spec("turbrestore_napari").origin).with_name("napari.yaml").read_text()
    for name in ("reader:get_reader", "widget:restore_layer"):
        module, function = name.split(":")
        assert f"turbrestore_napari.{name}" in manifest
        assert callable(getattr(importlib.import_module(f"turbrestore_napari.{module}"), function))


@needs_napari
def test_without_a_window(clip, monkeypatch, request):
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    qtbot = request.getfixturevalue("qtbot")
    from napari.components import ViewerModel
    from napari.layers import Layer
    from npe2 import PluginManager

    PluginManager.instance().discover()
    viewer = ViewerModel()
    (layer,) = viewer.open(str(clip), plugin="turbrestore")
    worker, added = restore_layer(layer, remove_blur=False), []
    worker.returned.connect(added.extend)
    qtbot.waitUntil(lambda: len(added) > 0, timeout=60_000)
    layers = [viewer.add_layer(Layer.create(*data)) for data in added]
    assert [layer.name for layer in layers] == [f"clip, {name}" for name in ("uncertainty", "motion", "restored")]
    expected = restore(open_frames(clip), RestoreParams(until="filter")).image
    np.testing.assert_array_equal(layers[-1].data, expected)


@needs_napari
def test_in_the_window(clip, monkeypatch, request):
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    qtbot = request.getfixturevalue("qtbot")
    from qtpy.QtGui import QOpenGLContext

    if not QOpenGLContext().create():
        # Drivers of OpenGL and an X server (xvfb-run) belong to the system; no Python package brings them.
        pytest.skip("Qt has no OpenGL here, which the window of napari draws with")
    viewer = request.getfixturevalue("make_napari_viewer")()
    viewer.open(str(clip), plugin="turbrestore")
    _, widget = viewer.window.add_plugin_dock_widget("turbrestore", "Restore a clip")
    assert widget.clip.value is viewer.layers["clip"]
    widget.remove_blur.value = False
    widget()
    qtbot.waitUntil(lambda: len(viewer.layers) == 4, timeout=60_000)
