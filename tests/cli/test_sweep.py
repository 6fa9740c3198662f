"""``deconvolve RUN --sweep``: one contact sheet of several widths from a kept run."""

import numpy as np
import pytest
from command_line import QUICK, fails

from conftest import SCENES, blurred
from turbrestore.deblurring.guards import GuardParams
from turbrestore.deconvolution.deconvolve import Deconvolution, DeconvolutionParams
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.runs.stage_files import load_artifact
from turbrestore.runtime.runtime import DEFAULT
from turbrestore_cli.deblurring import PART, contact_sheet, detailed_window


def test_widths_of_a_kept_run_stand_side_by_side(run, clip, tmp_path):
    kept = tmp_path / "run"
    assert run("restore", clip, tmp_path / "a.png", "--keep", kept, "--sigma", "1", *QUICK)[0] == 0
    quick = ("--deconvolution.iterations", "3")
    code, _, err = run("deconvolve", kept, "--sweep", "0.8,1.2", *quick)
    assert (code, err) == (0, f"turbrestore: {kept / 'sweep.png'}: 2 widths side by side\n")
    height, width = read_image(kept / "sweep.png").image.shape[:2]
    assert 2.5 < width / height < 3.2
    fails(run("deconvolve", kept, "--sweep", "0.8,1.2", *quick), 73, "--overwrite")
    fails(run("deconvolve", kept, tmp_path / "b.png", "--sweep", "1,wide"), 2, "--sweep: expected widths such as")
    fails(
        run("deconvolve", kept, tmp_path / "b.png", "--sweep", "1", "--sigma", "1"), 2, "--sweep: contradicts --sigma"
    )
    fails(run("deconvolve", kept, tmp_path / "b.png", "--sweep", "1,50"), 2, "--sweep: expected 0 to 10")
    fails(run("deconvolve", tmp_path, tmp_path / "b.png"), 2, "restore --keep")
    fails(run("deconvolve", kept), 2, "OUTPUT")
    fails(run("deconvolve", tmp_path / "other", "--sweep", "1"), 66, "no such file or folder")
    assert not (tmp_path / "b.png").exists()
    # Without a sweep the folder stands for its filtered image, guided by its centroid.
    words = ("--sigma", "1", *quick, "--quiet")
    assert run("deconvolve", kept, tmp_path / "of_run.png", *words)[0] == 0
    files = (kept / "filtered.npz", tmp_path / "of_files.png", "--guide", kept / "centroid.npz")
    assert run("deconvolve", *files, *words)[0] == 0
    one, other = (read_image(tmp_path / f"{name}.png").image for name in ("of_run", "of_files"))
    np.testing.assert_array_equal(one, other)


def test_an_image_has_its_sheet_beside_it(run, tmp_path):
    image = blurred(SCENES["chart"](96), 1.2, np.random.default_rng(0))
    write_image(tmp_path / "soft.png", image, 16)
    assert run("deconvolve", tmp_path / "soft.png", "--sweep", "1", "--deconvolution.iterations", "3")[0] == 0
    assert (tmp_path / "soft.sweep.png").exists()


def test_titles_say_what_the_guards_object_to():
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    image = blurred(SCENES["chart"](128), 1.2, np.random.default_rng(0))
    sheet = contact_sheet(image, image, (0.0, 1.0, 2.0), DeconvolutionParams(iterations=60), GuardParams(), DEFAULT)
    titles = [axes.get_title(loc="left") for axes in sheet.axes]
    assert titles[:3] == ["not deblurred", "0 px", "1 px"]
    assert titles[3] == "2 px: rings, overshoots"


def test_the_part_shown_is_the_one_with_edges():
    image = np.full((2 * PART, 3 * PART), 0.5, np.float32)
    image[PART + 40 : PART + 200, 2 * PART + 40 : 2 * PART + 200] = SCENES["chart"](160)
    rows, columns = detailed_window(image)
    assert rows.start <= PART + 40 and rows.stop >= PART + 200
    assert columns.start <= 2 * PART + 40 and columns.stop >= 2 * PART + 200


def test_a_kept_run_is_deblurred_by_the_width_that_it_removed(run, clip, tmp_path):
    kept = tmp_path / "run"
    assert run("restore", clip, tmp_path / "a.png", "--keep", kept, *QUICK)[0] == 0
    removed = load_artifact(kept / "deconvolution.npz", Deconvolution).sigma
    code, _, err = run("deconvolve", kept, tmp_path / "b.npz", "--deconvolution.iterations", "3")
    assert code == 0 and f"blur: {removed:.2f} pixels removed; as much as the run removed" in err
    assert removed > 0 and load_artifact(tmp_path / "b.npz", Deconvolution).sigma == removed
