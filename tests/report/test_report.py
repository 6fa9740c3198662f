"""The report and the folder it can be made from later: what is in them, and what is kept out."""

import base64
import dataclasses
import hashlib
import html
import json
import math
import shlex
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.blind.guards import GuardReading
from turbrestore.core.arrays import from_unit
from turbrestore.core.decision import Decision
from turbrestore.core.errors import ConfigurationError, DataError, InputNotFoundError, OutputError
from turbrestore.display.plots import plot_convergence, plot_eigenvalues, plot_filter, plot_flow
from turbrestore.io.source import FrameSource
from turbrestore.io.video import write_video
from turbrestore.pipeline import RestoreParams, restore
from turbrestore.registration.centroid import CentroidParams
from turbrestore.report import check_report, facts, pictures, render_report, write_report
from turbrestore.report.alignment import align_curves, align_map, take_title
from turbrestore.report.vector import inline_svg
from turbrestore.runs.run_files import MEAN, RUN_FILES, load_run, save_run
from turbrestore.runs.run_record import RunRecord, describe_run
from turbrestore.runtime.memory_size import MemorySize
from turbrestore.runtime.scratch import new_stack
from turbrestore_cli.__main__ import main
from turbrestore_cli.application import build
from turbrestore_cli.options import Machine, Selection, known_sigma
from turbrestore_cli.output import repeating_command, settings_record

EVIL = "<script>alert(1)</script>\"'&.mkv"
QUICK = RestoreParams(centroid=CentroidParams(iterations=1))


@pytest.fixture(scope="module")
def frames():
    return make_sequence(seed=41, count=6, size=64, rms=0.8, blur=2.0).frames


@pytest.fixture(scope="module")
def whole(frames):
    found = restore(frames, QUICK)
    return dataclasses.replace(found, decisions=(Decision("rank", "3 states", "95 % of the <motion>"),))


@pytest.fixture(scope="module")
def run(frames):
    return dataclasses.replace(
        describe_run(FrameSource.from_array(frames, EVIL, fps=25.0), QUICK, ("turbrestore", "restore", EVIL, "o.png")),
        warnings=("alpha channel <ignored>",),
    )


@pytest.fixture(scope="module")
def page(whole, run):
    return render_report(whole, run)


def mapped(array, folder):
    """Copy an array to a file and map it."""
    copy = new_stack(array.shape, folder)
    copy[...] = array
    return copy


def test_a_report_of_images_in_files_is_the_same(whole, run, page, tmp_path):
    centroid = dataclasses.replace(
        whole.centroid, image=mapped(whole.centroid.image, tmp_path), flows=mapped(whole.centroid.flows, tmp_path)
    )
    filtered = dataclasses.replace(whole.filtered, image=mapped(whole.filtered.image, tmp_path))
    result, mean = mapped(whole.image, tmp_path), mapped(whole.mean, tmp_path)
    in_files = dataclasses.replace(whole, image=result, mean=mean, centroid=centroid, filtered=filtered)
    assert render_report(in_files, run) == page


class Elements(HTMLParser):
    """All elements with their attributes, and the text of those named."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.found, self.open, self.text = [], [], {}
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        self.open.append(tag)

    def handle_endtag(self, tag):
        while self.open.pop() != tag:
            continue

    def handle_data(self, data):
        if self.open:
            self.text.setdefault(self.open[-1], []).append(data)

    def values(self, name):
        return [attributes[name] for _, attributes in self.found if name in attributes]


class TestPage:
    def test_everything_it_needs_is_in_it(self, page):
        elements = Elements(page)
        for address in elements.values("src") + elements.values("href"):
            assert address.startswith(("data:image/", "#"))
        assert "url(#" in page
        assert page.count("url(") == page.count("url(#")
        assert not {"link", "iframe", "object", "base", "form"} & {tag for tag, _ in elements.found}
        assert "http:" not in page
        assert "https:" not in page

    def test_policy_allows_its_own_style_and_script_only(self, page):
        (policy,) = (a["content"] for t, a in Elements(page).found if t == "meta" and a.get("http-equiv"))
        rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
        assert rules["default-src"] == "'none'"
        assert rules["img-src"] == "data:"
        for tag in ("style", "script"):
            text = page.split(f"<{tag}>")[1].split(f"</{tag}>")[0]
            digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
            assert rules[f"{tag}-src"] == f"'sha256-{digest}'"
            assert page.count(f"<{tag}") == 1
        assert not Elements(page).values("style")
        assert not [name for _, attributes in Elements(page).found for name in attributes if name.startswith("on")]

    def test_names_are_text(self, page):
        elements = Elements(page)
        assert elements.text["title"] == [f"{EVIL} – turbrestore"]
        assert "".join(elements.text["h1"]) == EVIL
        assert "alpha channel <ignored>" in elements.text["li"]
        assert "95 % of the <motion>" in elements.text["td"]
        assert shlex.split("".join(elements.text["code"][:1])) == ["turbrestore", "restore", EVIL, "o.png"]

    def test_ids_are_unique_and_references_meet_them(self, page):
        elements = Elements(page)
        ids = elements.values("id")
        assert len(ids) == len(set(ids))
        wanted = [address[1:] for address in elements.values("href") if address.startswith("#")]
        wanted += [value[5:-1] for value in elements.values("clip-path")]
        assert wanted
        assert set(wanted) <= set(ids)

    def test_whole_run(self, page, whole):
        text = html.unescape(page)
        for word in ("Frame 3", "Mean", "Centroid", "Filtered", "Result", "3 states", "Blur by all witnesses", "numpy"):
            assert word in text
        assert f"{whole.posterior.width[1]:.2f} px" in text and f"{whole.posterior.removed:.2f} px removed" in text
        labels = [a["aria-label"] for tag, a in Elements(page).found if tag == "svg" and "aria-label" in a]
        assert len(labels) == 11 + bool(whole.deconvolution.recorded.size)
        for stage in whole.seconds.values():
            assert f"{stage:.2f} s" in text

    @pytest.mark.parametrize("until", ["centroid", "identify", "filter"])
    def test_part_of_a_run(self, frames, run, until):
        params = dataclasses.replace(QUICK, until=until)
        part = restore(frames, params)
        text = html.unescape(render_report(part, run))
        assert ("Flow model" in text) == (until != "centroid")
        assert ("Effective frames" in text) == (until == "filter")
        assert "Estimated blur" not in text
        images = [a["alt"] for tag, a in Elements(text).found if tag == "img"]
        last = ["Centroid"] if until == "filter" else []
        assert images == ["Frame 3", "Mean", *last, "Result"]

    def test_colour(self, frames):
        tinted = np.stack([frames, 0.5 * frames, 1 - frames], axis=-1)
        restoration = restore(tinted, dataclasses.replace(QUICK, until="centroid"))
        found = Elements(render_report(restoration, RunRecord("c.mkv", tinted[3]))).found
        (address,) = (a["src"] for tag, a in found if tag == "img" and a["alt"] == "Result")
        assert (decoded(address) == from_unit(restoration.image, 8)).all()

    def test_what_the_image_does_not_tell_is_said(self, whole):
        blur = dataclasses.replace(whole.blur, sigma=0.0, uncertainty=math.inf, widths=np.zeros(0), costs=np.zeros(0))
        unknown = dataclasses.replace(whole, blur=blur, posterior=None)
        (fact,) = (fact for fact in facts.findings(unknown) if fact.name == "Estimated blur")
        assert (fact.value, fact.note, fact.doubtful) == ("0.00 px", "cannot be measured", True)
        assert "could not be estimated" in [fact.note for fact in facts.headline(unknown)]

    def test_doubts_stand_at_the_top(self, whole, run):
        sure = render_report(dataclasses.replace(whole, guard_readings=()), run)
        doubted = dataclasses.replace(run, warnings=("1 duplicated: frame 3 left out",))
        page = render_report(whole, doubted)
        assert page.index("frame 3 left out") < page.index('<dl class="headline">')
        assert page.count("frame 3 left out") == 1
        assert "times as sharp as the mean of 6 frames" in sure
        assert facts.verdict(whole, doubted).checks[0] == doubted.warnings[0]

    def test_settings_that_differ_are_marked(self, run):
        found = facts.settings(run)
        assert [setting.name for setting in found if setting.changed] == ["centroid.iterations"]
        values = {setting.name: setting.value for setting in found}
        assert (values["train"], values["flow.global-shift"]) == ("automatic", "true")

    def test_frames_that_count(self, whole):
        shares = np.array([0.5, 0.25, 0.25])
        filtered = dataclasses.replace(whole.filtered, shares=shares, innovations=np.array([1, np.nan, 3]))
        uneven = dataclasses.replace(whole, filtered=filtered)
        found = {fact.name: fact.value for fact in facts.findings(uneven)}
        assert found["Effective frames"] == "2.7 of 3"
        assert found["Innovation"] == "2.00 px"

    def test_guards_that_object_stand_out(self, whole):
        readings = (GuardReading(2.0, 0.25, 0.125, 7.0, False), GuardReading(1.7, 0.05, 0.02, 3.0, True))
        found = facts.findings(dataclasses.replace(whole, guard_readings=readings))
        guards = [fact for fact in found if fact.name.startswith("Guards")]
        assert [fact.doubtful for fact in guards] == [True, False]
        assert guards[0].name == "Guards at 2.00 px"
        assert guards[0].value == "25% of edges ring, 12% of pixels near them overshoot, noise ×7.0"

    def test_laps_follow_each_other(self, whole):
        laps = facts.laps(whole)
        assert [lap.start for lap in laps[1:]] == pytest.approx([lap.start + lap.share for lap in laps[:-1]])
        assert sum(lap.share for lap in laps) == pytest.approx(100)


def decoded(address):
    data = base64.b64decode(address.partition(",")[2])
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return pixels if pixels.ndim == 2 else pixels[..., ::-1]


class TestPictures:
    def test_all_are_lossless_or_none(self, monkeypatch):
        noise = np.random.default_rng(0).uniform(size=(120, 90)).astype(np.float32)
        images = {"frame": noise, "mean": noise**2, "result": np.zeros_like(noise)}
        exact = pictures.encode_gallery(images, 7)
        assert "lossless" in exact.encoding
        for picture, image in zip(exact.pictures, images.values(), strict=True):
            pixels = decoded(picture.address)
            assert (np.atleast_3d(pixels)[..., 0] == from_unit(image, 8)).all()
            assert (picture.width, picture.height) == (90, 120)
        assert [picture.title for picture in exact.pictures] == ["Frame 7", "Mean", "Result"]
        total = sum(len(picture.address) * 3 // 4 for picture in exact.pictures)
        monkeypatch.setattr(pictures, "_LOSSLESS_BYTES", total // 2)
        coarse = pictures.encode_gallery(images, 7)
        assert "quality 95" in coarse.encoding
        assert sum(len(picture.address) * 3 // 4 for picture in coarse.pictures) < total
        assert not (np.atleast_3d(decoded(coarse.pictures[0].address))[..., 0] == from_unit(noise, 8)).all()

    def test_all_show_what_a_cropped_result_shows(self, whole, run):
        cropped = dataclasses.replace(whole, image=whole.image[5:45, 3:53], crop=(3, 5, 50, 40))
        images = pictures.stages(cropped, run.frame)
        assert list(images) == ["frame", "mean", "centroid", "filtered", "result"]
        assert {image.shape for image in images.values()} == {(40, 50)}
        assert (images["mean"] == whole.mean[5:45, 3:53]).all()
        (fact,) = (fact for fact in facts.headline(cropped) if fact.name == "Sharpness")
        assert fact.value.startswith("×")

    def test_huge_images_are_reduced(self):
        gallery = pictures.encode_gallery({"result": np.zeros((30, 4096), np.float32)}, 0)
        assert (gallery.pictures[0].width, gallery.pictures[0].height) == (2048, 15)
        assert "reduced to 2048" in gallery.encoding

    def test_clips_that_use_a_small_part_of_the_scale_are_not_shown_black(self):
        ramp = np.tile(np.linspace(0.1, 0.11, 50, dtype=np.float32), (40, 1))
        gallery = pictures.encode_gallery({"mean": ramp, "result": ramp}, 0)
        assert "black is 0.09" in gallery.encoding and "white 0.11" in gallery.encoding
        assert pictures.encode_gallery({"result": 50 * ramp - 4.9}, 0).encoding == "8 bits, lossless"
        # A dark scene keeps its black, so that a background of zero stays black.
        assert "black is 0 and white 0.3" in pictures.encode_gallery({"result": 30 * ramp - 3}, 0).encoding

    def test_shadows_are_lifted_only_where_most_of_the_scene_lies_in_them(self):
        ramp = np.tile(np.linspace(0, 1, 256, dtype=np.float32), (40, 1))
        night = np.where(ramp > 0.98, np.float32(1), 0.12 * ramp)
        plain, dark = (pictures.encode_gallery({"result": image}, 0).stretch for image in (ramp, night))
        assert plain.exponent == 1.0
        # Of a ramp that reaches from .2 to .7 both ends become full.
        level = pictures.encode_gallery({"result": 0.2 + 0.5 * ramp}, 0).stretch
        assert level.slope * 0.2 + level.intercept == pytest.approx(0, abs=0.02)
        assert level.slope * 0.7 + level.intercept == pytest.approx(1, abs=0.02)
        # A bright disc on black is no scene in shadows.
        disc = np.where(ramp > 0.9, np.float32(0.8), np.float32(0))
        assert pictures.encode_gallery({"result": disc}, 0).stretch.exponent == 1.0
        assert 0.45 <= dark.exponent < 1

    def test_result_stands_once(self, whole, run):
        assert list(pictures.stages(whole, run.frame)) == ["frame", "mean", "centroid", "filtered", "result"]
        kept = dataclasses.replace(whole, image=whole.filtered.image.copy())
        assert list(pictures.stages(kept, run.frame)) == ["frame", "mean", "centroid", "result"]


def test_axes_of_all_figures_line_up():
    curves = [
        plot_convergence([0.8, 0.2], 0.1),
        plot_filter([1.0, 0.5], [0.2, 1200.0]),
        plot_eigenvalues(np.array([0.5 + 0.5j, 0.5 - 0.5j])),
    ]
    maps = [plot_flow(np.full((24, 32, 2), size)) for size in (1.0, 1e-3)]
    for figures, align in ((curves, align_curves), (maps, align_map)):
        for figure in figures:
            assert "\n" not in take_title(figure)
            align(figure)
            figure.draw_without_rendering()
        boxes = [axes.get_window_extent() for figure in figures for axes in (figure.axes[-1], figure.axes[0])]
        heights = {figure.get_size_inches()[1] for figure in figures}
        assert len(heights) == 1
        assert len({round(box.x0, 3) for box in boxes[1::2]}) == len({round(box.y0, 3) for box in boxes[::2]}) == 1


def test_svg_has_no_styles_and_scoped_names():
    svg = inline_svg(plot_flow(np.ones((24, 32, 2)), np.zeros((24, 32))), "map", 'say "<this>"')
    assert svg.startswith('<svg role="img" aria-label="say &quot;&lt;this&gt;&quot;" viewBox=')
    elements = Elements(svg)
    assert not {"style", "metadata"} & {tag for tag, _ in elements.found}
    assert not elements.values("style")
    assert all(name.startswith("map-") for name in elements.values("id"))
    assert all(address.startswith(("#map-", "data:image/")) for address in elements.values("href"))
    assert "Displacement of one frame, pixels" in elements.text["text"]
    assert svg == inline_svg(plot_flow(np.ones((24, 32, 2)), np.zeros((24, 32))), "map", 'say "<this>"')


class TestFiles:
    def test_written_whole_or_not_at_all(self, whole, run, tmp_path, monkeypatch):
        monkeypatch.setattr("turbrestore.report.page.render_report", lambda restoration, run: f"{run.name} ±")
        path = tmp_path / "r.html"
        write_report(path, whole, run)
        assert path.read_text("utf-8") == f"{EVIL} ±"
        with pytest.raises(OutputError, match="exists already"):
            write_report(path, whole, run)
        write_report(path, whole, run, overwrite=True)
        with pytest.raises(ConfigurationError, match=r"\.html"):
            write_report(tmp_path / "r.pdf", whole, run)
        assert [item.name for item in tmp_path.iterdir()] == ["r.html"]

    @pytest.mark.parametrize("package", ["jinja2", "matplotlib"])
    def test_missing_package_is_told_before_the_work(self, tmp_path, monkeypatch, package):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(ConfigurationError, match=r"pip install 'matplotlib.*' 'jinja2.*'$"):
            check_report(tmp_path / "r.html")

    def test_packages_are_loaded_only_when_they_are_used(self, tmp_path):
        code = (
            "import sys; from turbrestore.report import check_report; check_report('r.html'); "
            "print(*{'matplotlib', 'jinja2'} & set(sys.modules))"
        )
        done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
        assert done.stdout == "\n"

    def test_a_run_comes_back(self, whole, run, tmp_path):
        save_run(tmp_path / "kept", whole, run)
        assert {path.name for path in (tmp_path / "kept").iterdir()} == set(RUN_FILES) - {MEAN}
        restoration, record = load_run(tmp_path / "kept")
        same(restoration, whole)
        same(record, run)

    def test_what_an_earlier_run_left_goes(self, frames, whole, run, tmp_path):
        save_run(tmp_path, whole, run)
        part = restore(frames, dataclasses.replace(QUICK, until="centroid"))
        save_run(tmp_path, part, run)
        same(load_run(tmp_path)[0], part)
        assert not (tmp_path / "filtered.npz").exists()

    def test_maps_and_gaps_come_back(self, whole, run, tmp_path):
        blur = dataclasses.replace(whole.blur, uncertainty=math.inf)
        filtered = dataclasses.replace(whole.filtered, innovations=np.full(6, np.nan))
        share = np.full(whole.image.shape[:2], 0.25, np.float32)
        found = dataclasses.replace(whole, blur=blur, filtered=filtered, disagreement=share)
        save_run(tmp_path, found, run)
        same(load_run(tmp_path)[0], found)
        assert "Detail taken from the mean" in render_report(dataclasses.replace(whole, disagreement=share), run)

    def test_names_need_not_be_text(self, whole, run, tmp_path):
        odd = dataclasses.replace(run, name="bad\udcff.mkv", command=("turbrestore", "restore", "bad\udcff.mkv"))
        save_run(tmp_path, whole, odd)
        write_report(tmp_path / "r.html", *load_run(tmp_path))
        assert "bad?.mkv" in (tmp_path / "r.html").read_text("utf-8")


def same(found, expected):
    """Equal, field by field, down to every array."""
    assert type(found) is type(expected)
    if dataclasses.is_dataclass(expected):
        for item in dataclasses.fields(expected):
            same(getattr(found, item.name), getattr(expected, item.name))
    elif isinstance(expected, np.ndarray):
        assert found.dtype == expected.dtype
        assert np.array_equal(found, expected, equal_nan=expected.dtype.kind == "f")
    else:
        assert found == expected


def spoil(key, value):
    def change(folder):
        path = folder / "run.json"
        record = json.loads(path.read_text())
        part = record
        *above, last = key.split(".")
        for name in above:
            part = part[name]
        part[last] = value
        path.write_text(json.dumps(record))

    return change


def cut(name):
    def change(folder):
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: len(data) // 2])

    return change


def swap_image(folder):
    with np.load(folder / "images.npz") as archive:
        arrays = dict(archive)
    np.savez(folder / "images.npz", **{**arrays, "frame": arrays["frame"][:-3]})


def swap_share(folder):
    with np.load(folder / "images.npz") as archive:
        arrays = dict(archive)
    np.savez(folder / "images.npz", **arrays, disagreement=np.full(arrays["image"].shape[:2], 1.5, np.float32))


DAMAGE = {
    "no record": (lambda folder: (folder / "run.json").unlink(), InputNotFoundError),
    "no folder": (lambda folder: folder.rename(folder.with_name("gone")), InputNotFoundError),
    "cut record": (cut("run.json"), DataError),
    "binary record": (lambda folder: (folder / "run.json").write_bytes(b"\xff\xfe\x00"), DataError),
    "nested record": (lambda folder: (folder / "run.json").write_text("[" * 100_000), DataError),
    "list": (lambda folder: (folder / "run.json").write_text("[]"), DataError),
    "newer": (spoil("schema", 99), DataError),
    "no part": (spoil("run", None), DataError),
    "number for text": (spoil("run.name", 3), DataError),
    "flag for number": (spoil("restoration.train", True), DataError),
    "text for time": (spoil("restoration.seconds", {"filter": "long"}), DataError),
    "schema is a flag": (spoil("schema", True), DataError),
    "no section of settings": (spoil("run.settings.centroid", None), DataError),
    "text in a setting": (spoil("run.settings.centroid", {"tolerance": "small"}), DataError),
    "more than a number holds": (spoil("restoration.seconds", {"filter": 10**400}), DataError),
    "reading is no record": (spoil("restoration.guard_readings", [1]), DataError),
    "verdict of a guard is no flag": (
        spoil("restoration.guard_readings", [{"sigma": 1, "ringing": 0, "overshoot": 1, "noise_gain": 1, "passed": 1}]),
        DataError,
    ),
    "half a decision": (spoil("restoration.decisions", [{"subject": "blur"}]), DataError),
    "unknown result": (spoil("restoration.results", ["centroid", "hologram"]), DataError),
    "no centroid": (spoil("restoration.results", []), DataError),
    "path for result": (spoil("restoration.results", ["centroid", "../dynamics"]), DataError),
    "cut images": (cut("images.npz"), DataError),
    "no images": (lambda folder: (folder / "images.npz").unlink(), InputNotFoundError),
    "sizes": (swap_image, DataError),
    "more than the whole": (swap_share, DataError),
    "lost stage": (lambda folder: (folder / "filtered.npz").unlink(), InputNotFoundError),
    "cut stage": (cut("centroid.npz"), DataError),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_damage_is_one_line(whole, run, tmp_path, capsys, case):
    folder = tmp_path / "kept"
    save_run(folder, whole, run)
    change, error = DAMAGE[case]
    change(folder)
    with pytest.raises(error):
        load_run(folder)
    assert main(["report", str(folder), str(tmp_path / "r.html")]) == error.exit_code
    message = capsys.readouterr().err
    assert message.startswith("turbrestore: ")
    assert message.count("\n") == 1
    assert not (tmp_path / "r.html").exists()


@pytest.fixture(scope="module")
def clip(tmp_path_factory, frames):
    path = tmp_path_factory.mktemp("clip") / "a clip's $name.mkv"
    write_video(path, frames, 25)
    return path


class TestCommand:
    def test_restore_and_report_write_the_same(self, clip, tmp_path, capsys):
        words = [
            "restore",
            str(clip),
            str(tmp_path / "o.png"),
            "--until=centroid",
            "--centroid.iterations=1",
            "--quiet",
        ]
        files = {name: tmp_path / name for name in ("r.html", "kept", "again.html")}
        assert main([*words, "--report", str(files["r.html"]), "--keep", str(files["kept"])]) == 0
        assert main(["report", str(files["kept"]), str(files["again.html"]), "--quiet"]) == 0
        assert files["r.html"].read_bytes() == files["again.html"].read_bytes()
        assert main(["report", str(files["kept"])]) == 0
        assert (files["kept"] / "report.html").read_bytes() == files["r.html"].read_bytes()
        assert capsys.readouterr().err.endswith(f"report of {clip.name}\n")
        assert main(["report", str(files["kept"])]) == OutputError.exit_code
        page = files["r.html"].read_text("utf-8")
        # The command needs the folder; nothing else does.
        assert html.unescape(page).count(str(clip.parent)) == 1
        command = shlex.split(html.unescape(page.split('<pre tabindex="0"><code>')[1].split("</code>")[0]))
        assert command == ["turbrestore", *words[:5]]

    @pytest.mark.parametrize(("name", "code"), [("r.txt", 2), ("none/r.html", 73), ("there.html", 73)])
    def test_a_report_that_cannot_be_written_stops_at_once(self, clip, tmp_path, capsys, name, code):
        (tmp_path / "there.html").touch()
        words = ["restore", str(clip), str(tmp_path / "o.png"), "--report", str(tmp_path / name)]
        assert main(words) == code
        assert capsys.readouterr().err.count("\n") == 1
        assert [path.name for path in tmp_path.iterdir()] == ["there.html"]

    def test_the_command_says_what_differs(self, tmp_path):
        params = RestoreParams(
            train=7,
            keep_best=0.5,
            centroid=CentroidParams(mode="single", tolerance=0.1 + 0.2),
            deconvolution=dataclasses.replace(QUICK.deconvolution, sharpen_guide=False, sigma=1e-7),
        )
        selection = Selection(frames=":30:2", roi="0,0,64,48")
        machine = Machine(threads=3)
        record = settings_record(params, selection, 16, machine, MemorySize("2GB"))
        words = repeating_command(tmp_path / "-in put.mkv", tmp_path / "o.png", record)
        assert len(words) == 4 + 11
        _, bound, _ = build().parse_args(words[1:], exit_on_error=False, print_error=False)
        read = bound.arguments["params"]
        deconvolution = known_sigma(bound.arguments["sigma"], read.deconvolution)
        assert dataclasses.replace(read, deconvolution=deconvolution) == params
        assert "--sigma=1e-07" in words
        assert bound.arguments["selection"] == selection
        assert bound.arguments["machine"] == machine
        assert bound.arguments["memory_limit"] == 2e9
        assert bound.arguments["bit_depth"] == 16
        assert bound.arguments["input"] == tmp_path / "-in put.mkv"

    def test_names_that_look_like_flags_stay_names(self, tmp_path):
        words = repeating_command(
            Path("-x.mkv"), Path("o.png"), settings_record(RestoreParams(), Selection(), None, Machine(), None)
        )
        assert words == ("turbrestore", "restore", "./-x.mkv", "o.png")
