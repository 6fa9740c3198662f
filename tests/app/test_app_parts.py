"""What the app is made of, without a browser."""

import asyncio
import doctest
import shlex
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.blur.posterior import BlurPosterior
from turbrestore.core.decision import Decision
from turbrestore.core.errors import ConfigurationError, DataError, OutputError
from turbrestore.core.verdict import CheckKind
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve
from turbrestore.footage.levels import Levels
from turbrestore.io.video import write_video
from turbrestore.registration.centroid import CentroidParams
from turbrestore.settings import RestoreParams
from turbrestore.wording import write_check
from turbrestore_app import folders, job, restoring, stage_memory, tuning
from turbrestore_app.clip import open_clip
from turbrestore_app.folders import Folders
from turbrestore_app.guard import Guard
from turbrestore_app.job import Bar, Job, one_line
from turbrestore_app.pictures import Pictures
from turbrestore_app.restoring import Order, preview_order, restore_order
from turbrestore_app.saving import Outputs, check_outputs, command_line, save
from turbrestore_app.several import Row, inputs_of, plan_several
from turbrestore_app.tab import Tab
from turbrestore_app.tuning import impressions, part_around, tuned_params
from turbrestore_app.views.elements import labelled
from turbrestore_app.views.progress_view import ProgressView
from turbrestore_app.views.several_view import SeveralView
from turbrestore_cli.__main__ import main
from turbrestore_cli.options import Selection

from .conftest import ended

QUICK = RestoreParams(centroid=CentroidParams(iterations=1), deconvolution=DeconvolutionParams(sigma=1.0, iterations=5))


def test_stages_are_shown_at_the_levels_of_the_clip():
    shown = []
    memory = stage_memory.StageMemory(lambda name, image: shown.append((name, image)))
    memory.set_levels(Levels(0.25, 2.0))
    kept = memory.get("mean", lambda: np.full((2, 2), 0.5, np.float32))
    assert shown[0][0] == "mean" and (shown[0][1] == 0.5).all() and (kept == 0.5).all()
    memory.set_levels(Levels(0.3, 10.0))
    memory.get("mean", lambda: None)
    np.testing.assert_allclose(shown[1][1], 0.35)


@pytest.fixture(scope="module")
def restored(folder):
    return ended(Job(lambda job: restore_order(Order(folder / "clip.mkv", params=QUICK), job))).result


class TestFolders:
    def test_only_what_lies_below(self, folder, tmp_path):
        (folder / "out").unlink(missing_ok=True)
        (folder / "out").symlink_to(tmp_path)
        folders = Folders(folder)
        assert folders.locate("clip.mkv") == folders.locate(str(folder / "below/../clip.mkv")) == folder / "clip.mkv"
        for name in ("../x.mkv", "/etc/passwd", str(tmp_path / "x.mkv"), "out/x.mkv", "~/x.mkv"):
            for find in (folders.locate, folders.output):
                with pytest.raises(ConfigurationError, match="lies outside the folder"):
                    find(name)
        for name in ("", " ", "a\0b"):
            with pytest.raises(ConfigurationError, match="expected the name of a file"):
                folders.locate(name)

    def test_what_the_command_line_allows(self, folder, tmp_path):
        clip = tmp_path / "named" / "clip.mkv"
        folders = Folders(folder, (tmp_path / "more",), (clip,))
        assert folders.locate(str(clip)) == clip
        assert folders.output(str(tmp_path / "more" / "a.png")) == tmp_path / "more" / "a.png"
        with pytest.raises(ConfigurationError):
            folders.output(str(clip))
        assert (folders.shown(folder / "a.png"), folders.shown(clip)) == (Path("a.png"), clip)

    def test_a_list_shows_folders_and_clips(self, folder):
        names = [entry.name for entry in Folders(folder).listing(folder)]
        assert [name for name in names if name != "out/"] == ["below/", "clip.mkv"]
        assert [entry.name for entry in Folders(folder).listing(folder / "below")] == [".."]


class TestGuard:
    @pytest.mark.parametrize(
        ("path", "headers", "status"),
        [
            ("/key/", {}, 200),
            ("/key/_nicegui/x", {"origin": "http://127.0.0.1:80"}, 200),
            ("/key", {"host": "localhost:80"}, 200),
            ("/kex/", {}, 404),
            ("", {}, 404),
            ("/key/", {"host": "127.0.0.1"}, 403),
            ("/key/", {"host": "a.example:80"}, 403),
            ("/key/", {"origin": "http://a.example"}, 403),
            ("/key/", {"origin": "null"}, 403),
            ("/key/", {"content-length": "100"}, 200),
            ("/key/", {"content-length": "101"}, 413),
            ("/key/", {"content-length": "-1"}, 411),
            ("/key/", {"transfer-encoding": "chunked"}, 411),
        ],
    )
    @pytest.mark.parametrize("kind", ["http", "websocket"])
    def test_who_may_come_in(self, path, headers, status, kind):
        sent = []

        async def app(scope, receive, send):
            await send({"type": "http.response.start", "status": 200})

        async def receive():
            return {}

        async def send(message):
            sent.append(message)

        pairs = [(name.encode(), value.encode()) for name, value in {"host": "127.0.0.1:80", **headers}.items()]
        scope = {"type": kind, "path": path, "headers": pairs}
        asyncio.run(Guard(app, "key", 80, 100)(scope, receive, send))
        if kind == "http" or status == 200:
            assert sent[0]["status"] == status
        else:
            assert sent == [{"type": "websocket.close", "code": 1008}]
        assert (status != 200) or any(name == b"content-security-policy" for name, _ in sent[0]["headers"])


class TestJob:
    def test_it_says_what_it_does(self, restored, folder):
        job = ended(Job(lambda job: restore_order(Order(folder / "clip.mkv", params=QUICK), job)))
        assert job.state == "done"
        assert list(job.bars) == ["read", "centroid", "filter", "deconvolve"]
        assert all(bar.share == 1 for bar in job.bars.values())
        assert list(job.images) == ["frame", "centroid", "filtered", "mean", "deblurred"]
        assert tuple(job.decisions) == job.result.restoration.decisions
        assert (job.result.restoration.image == restored.restoration.image).all()

    def test_it_stops_at_its_next_step(self, folder):
        begun = threading.Event()

        def work(job):
            begun.set()
            while True:
                job.progress("filter", 1, 2)

        job = Job(work)
        begun.wait(10)
        job.stop()
        assert (ended(job).state, job.result) == ("stopped", None)

    def test_failures_are_one_line(self, tmp_path, capsys):
        job = ended(Job(lambda job: restore_order(Order(tmp_path / "none.mkv"), job)))
        assert (job.state, job.message) == ("failed", f"{tmp_path / 'none.mkv'}: no such file or folder")
        assert one_line(MemoryError()).startswith("out of memory")
        assert capsys.readouterr().err == ""
        assert one_line(ValueError("a\nb")) == "this is a bug (ValueError: a b); the terminal shows where"
        assert "ValueError" in capsys.readouterr().err


class TestOrders:
    def test_another_deconvolution_alone_takes_over_the_rest(self, restored):
        order = replace(restored.order, params=replace(QUICK, deconvolution=DeconvolutionParams(method="tv", sigma=2)))
        job = ended(Job(lambda job: restore_order(order, job, restored)))
        assert list(job.bars) == ["read", "deconvolve"]
        again = job.result.restoration
        assert again.filtered is restored.restoration.filtered
        anew = ended(Job(lambda job: restore_order(order, job))).result.restoration
        assert (again.image == anew.image).all()
        assert (again.image != restored.restoration.image).any()

    def test_what_is_taken_over(self, restored):
        order = restored.order
        assert order.shares_filter_with(replace(order, params=replace(QUICK, border="crop")))
        assert not order.shares_filter_with(replace(order, selection=Selection(frames="0:5")))
        assert not order.shares_filter_with(replace(order, params=replace(QUICK, train=3)))

    def test_a_preview_is_the_middle_of_the_region(self):
        order = Order(Path("a.mkv"), Selection(frames="10:90:2", roi="100,50,400,100"))
        selection = preview_order(order, (200, 480, 640)).selection
        assert (selection.frames, selection.roi) == ("10:58:2", "220,50,160,100")
        selection = preview_order(Order(Path("a.mkv")), (9, 100, 64)).selection
        assert (selection.frames, selection.roi) == ("0:9", "0,0,64,100")
        order = Order(Path("a.ser"), Selection(crop_to_object=True))
        assert preview_order(order, (99, 100, 640)).selection == Selection(frames="0:24", crop_to_object=True)
        order = Order(Path("a.ser"), Selection(derotate="mars"), RestoreParams(reference="b.png", scale=2))
        part = preview_order(order, (99, 100, 640))
        assert (part.selection.roi, part.params) == (None, RestoreParams(scale=2))


class TestTuning:
    def test_it_starts_from_the_shape_that_was_removed(self, restored):
        width = np.array([1.0, 1.2, 1.4])
        posterior = BlurPosterior(1.1, 1.37, *[width] * 5, air=1.0, edge_limited=False)
        found = replace(restored.restoration, posterior=posterior)
        assert tuned_params(replace(restored, restoration=found)).exponent == 1.37

    def test_the_last_impression_is_the_method_itself(self, restored):
        params = replace(tuned_params(restored), sigma=1.5, fidelity=500.0, iterations=100)
        part = part_around((64, 64), 0, 40, side=32)
        assert part == (slice(24, 56), slice(0, 32))
        first, last = impressions(restored, params, part, lambda: False)
        found = restored.restoration
        expected = deconvolve(found.filtered.image[part], 1.5, params, found.centroid.image[part]).image
        assert (last == expected).all()
        assert np.abs(first - last).mean() < 0.05
        assert len(list(impressions(restored, replace(params, method="wiener"), part, lambda: False))) == 1

    def test_nobody_waits_for_what_is_not_wanted(self, restored):
        assert list(impressions(restored, tuned_params(restored), part_around((64, 64), 0, 0), lambda: True)) == []


class TestSaving:
    def test_the_command_gives_the_same_files(self, restored, folder, tmp_path, monkeypatch):
        outputs = Outputs(tmp_path / "a.png", 16, report=True)
        written = save(restored, outputs, Path("clip.mkv"), Path("a.png"))
        assert written == [tmp_path / name for name in ("a.png", "a.png.toml", "a.png.html")]
        command = command_line(restored.order, 16, folder / "clip.mkv", tmp_path / "b.png")
        monkeypatch.chdir(tmp_path)
        assert main([*shlex.split(command)[1:], "--quiet"]) == 0
        for suffix in (".png", ".png.toml"):
            assert Path(f"a{suffix}").read_bytes() == Path(f"b{suffix}").read_bytes()
        assert "turbrestore restore clip.mkv a.png" in Path("a.png.html").read_text()

    def test_nothing_is_replaced_unasked(self, restored, folder, tmp_path):
        (tmp_path / "a.png.html").touch()
        outputs = Outputs(tmp_path / "a.png", report=True)
        with pytest.raises(OutputError, match="a.png.html"):
            save(restored, outputs, Path("clip.mkv"), Path("a.png"))
        assert not (tmp_path / "a.png").exists()
        order = Order(folder / "clip.mkv", params=RestoreParams(static_mask=str(tmp_path / "mask.png")))
        check_outputs(replace(outputs, overwrite=True), order)
        (tmp_path / "clip.png").hardlink_to(folder / "clip.mkv")
        (tmp_path / "mask.png").touch()
        for name in ("clip.png", "mask.png"):
            with pytest.raises(OutputError):
                check_outputs(Outputs(tmp_path / name, overwrite=True), order)


class TestTab:
    def test_uploads_have_plain_names_and_go_in_the_end(self, folder):
        tab = Tab(Folders(folder))
        place = tab.place_for("../../.a/b\\c.mkv")
        assert place.name == "c.mkv"
        place.write_bytes((folder / "clip.mkv").read_bytes())
        assert tab.open(place).name == Path("c.mkv")
        for name in ("a.exe", "", "..", ".mkv"):
            with pytest.raises(DataError):
                tab.place_for(name)
        job = tab.run(Order(place, params=replace(QUICK, deconvolution=DeconvolutionParams(sigma=1, tolerance=0))))
        tab.close()
        assert ended(job).state == "stopped"
        assert not place.parent.exists()

    def test_another_clip_ends_the_run(self, folder):
        tab = Tab(Folders(folder))
        tab.open(folder / "clip.mkv")
        job = tab.run(Order(folder / "clip.mkv", params=QUICK))
        tab.open(folder / "clip.mkv")
        assert ended(job).state in ("stopped", "done")
        assert (tab.restored, tab.job) == (None, None)

    def test_nothing_can_be_run_while_a_clip_is_read(self, folder, monkeypatch):
        tab, busy = Tab(Folders(folder)), []
        monkeypatch.setattr("turbrestore_app.tab.open_clip", lambda *_: busy.append(tab.busy))
        tab.open(folder / "clip.mkv")
        assert (busy, tab.busy) == ([True], False)
        monkeypatch.undo()
        with pytest.raises(DataError):
            tab.open(folder / "notes.txt")
        assert not tab.busy


def test_errors_name_the_fields_of_the_page():
    assert labelled("a.png: exists already; choose another name or pass overwrite=True").endswith(
        "choose another name or tick Replace existing files"
    )
    assert labelled("--frames: expected start:stop, found '1'") == "Frames: expected start:stop, found '1'"
    assert labelled("--roi: expected 4 numbers") == "Region: expected 4 numbers"
    # The page counts the last frame in.
    assert labelled("one is in --frames 0:9, the other in --frames 9:20") == (
        "one is in Frames 0 to 8, the other in Frames 9 to 19"
    )


@pytest.mark.parametrize("kind", CheckKind)
def test_remedies_name_the_fields_of_the_page(kind):
    assert "--" not in labelled(write_check(kind, 1.0, 1.0, 1.0).remedy)


def test_what_a_run_tells_names_the_fields_of_the_page():
    told = f"Verdict: 8 frames; check: {write_check(CheckKind.UNSEEN, '4 %')}."
    decision = Decision("two states", "", "--frames 0:9 shows one", CheckKind.TWO_STATES)
    job = SimpleNamespace(kind="restore", state="done", bars={}, decisions=[decision], seconds=1.0, message=told)
    tab = SimpleNamespace(job=job, busy=False, rows=[Row("a.mkv", "done", told)])
    progress, several = ProgressView(tab, "restore"), SeveralView(tab, None, None)
    progress._starters = ()
    progress._stages = SimpleNamespace(clear=lambda: None)
    progress._stop, progress._state, progress._decided, several._rows = (SimpleNamespace(content="") for _ in range(4))
    several._progress = progress
    several.follow()
    assert progress._state.text.endswith("(Border of the image: crop what few frames show).")
    assert "Frames 0 to 8 shows one" in progress._decided.content
    assert "Border of the image: crop" in several._rows.content


class TestSeveral:
    @pytest.fixture
    def tab(self, folder, tmp_path):
        for name in ("a.mkv", "b.mkv"):
            (tmp_path / name).write_bytes((folder / "clip.mkv").read_bytes())
        (tmp_path / "bad.mkv").write_bytes(b"no video")
        return Tab(Folders(tmp_path))

    def plan(self, tab, *names, overwrite=False):
        start = tab.folders.start
        like = Order(start / "a.mkv", Selection(frames="0:3"), QUICK, "fast")
        return plan_several([start / name for name in names], "out", like, overwrite, tab.folders)

    def test_a_clip_that_fails_is_a_row(self, tab, tmp_path):
        job = ended(tab.restore_all(self.plan(tab, "bad.mkv", "a.mkv", "b.mkv")))
        assert (job.state, job.result, next(iter(job.images))) == ("done", None, "frame")
        assert [row.state for row in tab.rows] == ["failed", "done", "done"]
        assert tab.rows[0].words.startswith("cannot be opened as a video")
        assert tab.rows[1].words.startswith("out/a.png (") and "frames" in tab.rows[1].words
        # The frames of the clip that is open are not those of others.
        command = command_line(
            Order(tmp_path / "b.mkv", params=QUICK, preset="fast"), None, tmp_path / "b.mkv", tmp_path / "b.png"
        )
        assert main([*shlex.split(command)[1:], "--quiet"]) == 0
        for suffix in (".png", ".png.toml"):
            assert (tmp_path / f"out/b{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()

        ended(tab.restore_all(self.plan(tab, "a.mkv")))
        assert tab.rows[0].state == "failed" and "a.png: exists already" in tab.rows[0].words
        ended(tab.restore_all(self.plan(tab, "a.mkv", overwrite=True)))
        assert tab.rows[0].state == "done"

    def test_a_stop_ends_them_all(self, tab, tmp_path, held):
        job = tab.restore_all(self.plan(tab, "a.mkv", "b.mkv"))
        tab.stop()
        held.set()
        assert ended(job).state == "stopped"
        assert [row.state for row in tab.rows] == ["stopped", "stopped"]
        assert list((tmp_path / "out").iterdir()) == []

    def test_what_cannot_be_planned(self, tab, tmp_path):
        with pytest.raises(ConfigurationError, match="expected at least one"):
            self.plan(tab)
        with pytest.raises(ConfigurationError, match="lies outside"):
            plan_several([tmp_path / "a.mkv"], "../elsewhere", Order(tmp_path / "a.mkv"), False, tab.folders)
        assert not (tmp_path.parent / "elsewhere").exists()

    def test_what_turbrestore_has_written_is_no_input(self, tab, tmp_path):
        (tmp_path / "a.steady.mp4").touch()
        (tmp_path / "a.steady.mp4.toml").touch()
        entries = tab.folders.listing(tmp_path)
        assert "a.steady.mp4" in [entry.name for entry in entries]
        assert [entry.name for entry in inputs_of(entries)] == ["a.mkv", "b.mkv", "bad.mkv"]


def test_a_clip_has_the_numbers_of_its_file(tmp_path):
    frames = make_sequence(seed=6, count=6, size=64).frames
    frames[3] = frames[2]
    write_video(tmp_path / "clip.mkv", frames, fps=25)
    clip = open_clip(tmp_path / "clip.mkv", Path("clip.mkv"))
    assert (clip.size, len(clip.source), clip.facts["usable_frames"]) == ((64, 64), 6, 5)
    assert clip.remarks == ("1 duplicated: frame 3 left out",)
    assert clip.quality().shape == (6, 3)
    assert np.abs(clip.frame(5) - frames[5]).max() < 1 / 255


def test_the_seconds_that_are_left_are_told_from_the_second_step_on():
    assert Bar(1, 10).left is None
    assert Bar(2, 10, time.monotonic() - 4000).left == pytest.approx(16_000, abs=500)


@pytest.mark.parametrize("module", [folders, job, restoring, stage_memory, tuning])
def test_examples(module):
    assert doctest.testmod(module).failed == 0


def test_only_the_newest_pictures_of_each_kind_are_kept():
    pictures = Pictures("pictures/key")
    image = np.zeros((4, 4), np.float32)
    addresses = [pictures.put(image) for _ in range(20)] + [pictures.put(image, kind="frame") for _ in range(20)]
    found = [pictures.get(address.rpartition("/")[2]) is not None for address in addresses]
    assert found == ([False] * 4 + [True] * 16) * 2


def test_pages_of_one_tab_leave_in_any_order(monkeypatch, tmp_path):
    from nicegui import app, ui

    from turbrestore_app import server
    from turbrestore_app.views import page

    async def nothing(*_):
        """Stand in for what needs a browser."""

    shown, tabs, left, on_their_way, emptied = {}, set(), [], [], []
    monkeypatch.setattr(page, "add_styles_and_scripts", lambda: None)
    monkeypatch.setattr(page, "Page", lambda _: SimpleNamespace(show=nothing))
    monkeypatch.setattr(app, "clients", lambda _: on_their_way)

    async def show(client_id):
        empty = partial(emptied.append, client_id)
        client = SimpleNamespace(
            tab_id="tab", id=client_id, connected=nothing, on_delete=left.append, remove_all_elements=empty
        )
        monkeypatch.setattr(ui, "context", SimpleNamespace(client=client))
        await server._show(shown, tabs, Folders(tmp_path), None)

    async def come_and_leave():
        await show("first")
        before = set(tabs)
        on_their_way.append(SimpleNamespace(has_socket_connection=False))
        leaving = asyncio.create_task(left[0]())
        await asyncio.sleep(0)
        await show("second")
        on_their_way.clear()
        await leaving
        # A page that is loaded slowly finds its tab again, and the one before goes no further.
        assert (tabs, emptied) == (before, ["first"])
        for leave in reversed(left):
            await leave()
        assert not shown and not tabs

    asyncio.run(come_and_leave())
