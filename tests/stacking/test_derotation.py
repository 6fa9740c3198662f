"""A planet is turned back: the geometry of an ellipsoid, the disc, the direction, and a synthetic clip."""

import cv2
import numpy as np
import pytest

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.io.source import FrameSource
from turbrestore.io.video import write_video
from turbrestore.registration.warp import sample_linear
from turbrestore.stacking.derotation import Disc, Rotation, derotated, find_disc, read_rotation, rotation_flow

SIZE, RADIUS = (160, 176), 58.0
JUPITER = read_rotation("jupiter")


def rendered(seconds, angle=12.0, way=1):
    """Jupiter seen from its equator: a texture over longitude and latitude, drawn twice as large and averaged down."""
    rng, (height, width) = np.random.default_rng(0), (360, 720)
    noise = np.tile(rng.standard_normal((height, width)), (1, 3))
    spots = sum(scale * cv2.GaussianBlur(noise, (0, 0), scale) for scale in (2.5, 5))[:, width : 2 * width]
    texture = (0.6 + 0.12 * spots / spots.std() + 0.08 * np.sin(np.linspace(0, 22, height))[:, None]).astype(np.float32)
    y, x = np.mgrid[: 2 * SIZE[0], : 2 * SIZE[1]]
    x, y = (x + 0.5 - SIZE[1]) / (2 * RADIUS), (y + 0.5 - SIZE[0]) / (2 * RADIUS)
    turn, q = np.radians(angle), 1 - JUPITER.flattening
    u, v = np.cos(turn) * x + np.sin(turn) * y, (np.sin(turn) * x - np.cos(turn) * y) / q
    depth = np.sqrt(np.clip(1 - u**2 - v**2, 0, 1))
    longitude = np.arctan2(u, depth) - way * 2 * np.pi * seconds / (3600 * JUPITER.period)
    place = longitude / (2 * np.pi) % 1 * width, (np.arcsin(np.clip(v, -1, 1)) / np.pi + 0.5) * (height - 1)
    image = cv2.remap(
        texture, *(axis.astype(np.float32) for axis in place), cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP
    )
    shaded = np.where(u**2 + v**2 < 1, image * (0.4 + 0.6 * depth), 0).astype(np.float32)
    return cv2.resize(shaded, SIZE[::-1], interpolation=cv2.INTER_AREA)


def psnr(image, truth):
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    within = np.hypot(x - (SIZE[1] - 1) / 2, y - (SIZE[0] - 1) / 2) < 0.8 * RADIUS
    return -10 * np.log10(np.mean(np.square((image - truth)[within])))


def clip(way=1, count=15, minutes=2.5, noise=0.01):
    rng, times = np.random.default_rng(1), np.linspace(-30 * minutes, 30 * minutes, count)
    frames = np.stack([rendered(time, way=way) + rng.normal(0, noise, SIZE) for time in times])
    rate = (count - 1) / (60 * minutes)
    return FrameSource.from_array(np.clip(frames, 0, 1).astype(np.float32), fps=rate)


def test_a_sphere_moves_its_middle_by_the_angle_and_its_limb_not_at_all():
    disc, rotation = Disc(50.0, 50.0, 40.0, 0.0), Rotation(10.0, 0.0)
    flow = rotation_flow((101, 101), disc, rotation, 100.0)
    turned = 2 * np.pi * 100 / 36000
    assert flow[50, 50] == pytest.approx([40 * np.sin(turned), 0], abs=1e-4)
    # A point at 30 degrees of longitude goes on along its parallel.
    assert flow[50, 70, 0] == pytest.approx(40 * (np.sin(np.arcsin(0.5) + turned) - 0.5), abs=1e-4)
    assert not flow[5, 5].any()
    assert np.abs(flow[50, 9]).max() < 0.1
    quarter = rotation_flow((101, 101), Disc(50.0, 50.0, 40.0, np.pi / 2), rotation, 100.0)
    assert quarter[50, 50] == pytest.approx([0, 40 * np.sin(turned)], abs=1e-4)


def test_flows_of_two_times_join_to_that_of_their_sum_on_a_tilted_ellipsoid():
    disc, rotation = Disc(60.0, 55.0, 45.0, 0.3), Rotation(10.0, 0.1, None, 20.0)
    first, second, both = (rotation_flow((111, 121), disc, rotation, time) for time in (200.0, 150.0, 350.0))
    joined = first + sample_linear(cv2.split(second), first)
    y, x = np.mgrid[:111, :121]
    within = np.hypot(x - 60, y - 55) < 33
    assert np.abs(joined - both)[within].max() < 0.01
    # The pole that is turned to the observer stays, at v = q cos β along the axis, and what is near it turns.
    v = 45 * 0.9 * np.cos(np.radians(20))
    row, column = round(55 - np.cos(0.3) * v), round(60 + np.sin(0.3) * v)
    assert np.linalg.norm(both[row, column]) < 0.1
    assert np.linalg.norm(both[row + 8, column]) > 0.3


def test_the_disc_is_where_it_was_drawn():
    disc = find_disc(rendered(0.0), JUPITER)
    assert (disc.x, disc.y) == pytest.approx(((SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2), abs=0.6)
    assert disc.radius == pytest.approx(RADIUS, rel=0.03)
    assert np.degrees(disc.angle) == pytest.approx(12, abs=4)


@pytest.mark.parametrize("way", [1, -1])
def test_the_mean_of_two_and_a_half_minutes_of_jupiter_gains_three_decibels(way):
    source = clip(way)
    turned = derotated(source, JUPITER)
    assert "turned back by 1.51°" in turned.warnings[-1]
    truth = rendered(0.0, way=way)
    before, after = source.read().mean(axis=0), turned.read().mean(axis=0)
    assert psnr(after, truth) > psnr(before, truth) + 3
    # A part of the frames is turned as the whole is.
    part = turned.select(roi=(40, 30, 64, 48)).read()
    assert np.abs(part - turned.read()[:, 30:78, 40:104])[:, 6:-6, 6:-6].max() < 0.02


# Degrees a day: of system II for Jupiter, system III for Saturn, and of Mars (Archinal et al. 2018).
@pytest.mark.parametrize(("planet", "rate"), [("jupiter", 870.27), ("saturn", 810.7939), ("mars", 350.89198)])
def test_planets_turn_by_their_sidereal_periods(planet, rate):
    assert read_rotation(planet).period == pytest.approx(24 * 360 / rate, rel=5e-5)


def test_what_cannot_be_turned_is_refused():
    assert read_rotation("9.9h") == Rotation(9.9, 0.0)
    assert read_rotation("Mars, -20, 8") == Rotation(24.6229, 0.0059, -20.0, 8.0)
    for text in ("pluto", "-3", "jupiter,1,2,3", "mars,x", "mars,0,95"):
        with pytest.raises(ConfigurationError, match="derotate: expected jupiter"):
            read_rotation(text)
    with pytest.raises(DataError, match="times of its frames"):
        derotated(FrameSource.from_array(np.zeros((3, 32, 32), np.float32)), JUPITER)
    with pytest.raises(DataError, match="expected a bright disc"):
        derotated(FrameSource.from_array(np.full((3, 32, 32), 0.5, np.float32), fps=1), JUPITER)


def test_the_command_turns_a_clip_back_and_a_kept_run_knows(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = clip(count=6)
    write_video("a.ser", source.read(), source.fps, 16)
    quick = ("--centroid.iterations", "1", "--filter.inner-iterations", "1", "--until", "filter", "--keep", "kept")
    code, _, err = run("restore", "a.ser", "o.png", "--derotate", "jupiter", *quick)
    assert code == 0 and "turned back by" in err
    code, _, err = run("restore", "a.ser", "p.png", *quick, "--resume")
    assert code == 0 and "starts again at the centroid" in err
