import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.dynamics.dynamic_texture import DynamicsParams, identify
from turbrestore.registration.centroid import CentroidParams
from turbrestore.registration.flow import DisParams, FlowParams
from turbrestore.synthesis.dynamic_texture import DynamicTextureParams, continue_flows, synthesize_like
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

QUICK = DynamicTextureParams(
    flow=FlowParams(dis=DisParams(finest_scale=1, refinements=2)), centroid=CentroidParams(iterations=2)
)


@pytest.fixture(scope="module")
def training():
    """Flows whose first states hold about 95 % of the motion."""
    return smooth_flows(120, 32, 32, np.random.default_rng(0), SmoothFlowParams(correlation_length=10.0))


@pytest.fixture(scope="module")
def clip():
    rng = np.random.default_rng(3)
    return distort(resolution_chart(64, 64), smooth_flows(16, 64, 64, rng), rng, blur=1.0, noise=0.01)


def seeded(training, count, seed=1, **settings):
    return continue_flows(training, count, np.random.default_rng(seed), DynamicTextureParams(**settings))


def pixel_variance(flows):
    """Variance of every displacement over the sequence, without making the flows."""
    return np.einsum("xi,ij,xj->x", flows.modes, np.cov(flows.states), flows.modes, optimize=True)


def test_every_pixel_moves_as_far_as_in_training(training):
    flows, dynamics = seeded(training, 20_000)
    assert dynamics.energy_share < 0.98
    ratio = pixel_variance(flows) / training.reshape(len(training), -1).var(axis=0, ddof=1)
    # States with a correlation of 0.9 from frame to frame leave 2,000 independent values of 20,000: 3 % of deviation
    # where a single one moves a pixel; the furthest of 2,048 pixels lies about three deviations off.
    assert ratio.min() > 0.9
    assert ratio.max() < 1.1
    assert ratio.mean() == pytest.approx(1.0, abs=0.03)


def test_without_the_residual_the_flows_are_those_of_the_modes(training):
    flows, dynamics = seeded(training, 50, residual="drop")
    assert flows.modes.shape[1] == dynamics.rank
    kept, _ = seeded(training, 50)
    assert np.allclose(kept.states[: dynamics.rank], flows.states)
    outside = kept[7] - flows[7]
    assert np.abs(dynamics.C.T @ outside.reshape(-1)).max() < 1e-3 * np.linalg.norm(outside)
    assert np.linalg.norm(outside) > 0.05 * np.linalg.norm(kept[7])


@pytest.mark.long
def test_eigenvalues_are_found_again(training):
    flows, dynamics = seeded(training, 2000)
    again = identify([*flows], DynamicsParams(rank=dynamics.rank))
    distances = np.abs(dynamics.eigenvalues[:, None] - again.eigenvalues[None])
    pairs = linear_sum_assignment(distances)
    # An autoregression of order one is known to √((1 − φ²) / 2000) = 0.013; eigenvalues of coupled states to a few
    # times that.
    assert dynamics.rank > 5
    assert np.abs(dynamics.eigenvalues).max() < 0.97
    assert distances[pairs].max() < 0.1
    assert distances[pairs].mean() < 0.04


def test_residual_keeps_its_memory(training):
    flows, dynamics = seeded(training, 4000)
    rest = flows.states[dynamics.rank :]
    wanted = identify(training, DynamicsParams(rank=len(training))).states[dynamics.rank :]

    def memory(states):
        return np.sum(states[:, 1:] * states[:, :-1]) / np.sum(states**2)

    assert memory(rest) == pytest.approx(memory(wanted), abs=0.03)
    assert memory(wanted) > 0.5


def test_nothing_drifts_over_two_thousand_frames(training):
    flows, _ = seeded(training, 2000)
    deviation = training.std()
    quarters = np.array([np.mean([np.square(flows[k]).mean() for k in part]) for part in np.split(np.arange(2000), 4)])
    # Twenty-odd states over 500 frames: the energy of a quarter is known to about 7 %.
    assert quarters == pytest.approx(quarters.mean(), rel=0.25)
    first, last = (np.mean([flows[k] for k in part], axis=0) for part in (range(500), range(1500, 2000)))
    # A mean over 500 frames of correlation 0.8 has a deviation of √(9 / 500) = 0.13 of one frame's; so has the last.
    assert np.sqrt(np.mean((last - first) ** 2)) < 0.35 * deviation


def test_the_same_seed_gives_the_same_bytes(clip):
    first, again, other = (synthesize_like(clip, 5, np.random.default_rng(seed), QUICK) for seed in (5, 5, 6))
    for a, b, c in zip(first.flows, again.flows, other.flows, strict=True):
        assert a.tobytes() == b.tobytes()
        assert a.tobytes() != c.tobytes()
    assert first.scene.tobytes() == again.scene.tobytes()


def test_flows_can_be_run_through_again(training):
    flows, _ = seeded(training, 6)
    assert len(flows) == len([*flows]) == 6
    first = [*flows]
    for index in range(6):
        assert flows[index].dtype == np.float32
        assert (flows[index] == first[index]).all()
    with pytest.raises(IndexError):
        flows[6]


def test_frames_can_be_made_at_once(clip):
    texture = synthesize_like(clip, 7, np.random.default_rng(0), QUICK)
    frames = distort(texture.scene, texture.flows, np.random.default_rng(1), noise=0.01)
    assert frames.shape == (7, 64, 64)
    assert np.abs(frames - texture.scene).mean() > 0.01
    assert len(texture.eigenvalues) == texture.dynamics.rank


@pytest.mark.parametrize("size", [(20, 21), (32, 32), (45, 70), (31, 100), (100, 15)])
def test_mirrored_flows_keep_their_pixels(training, size):
    rng = np.random.default_rng(0)
    plain, _ = continue_flows(training, 1, np.random.default_rng(0))
    fitted, _ = continue_flows(training, 1, rng, size=size)
    flow, whole = fitted[0], plain[0]
    assert flow.shape == (*size, 2)
    top, left = ((want - 32) // 2 for want in size)
    for y, x in rng.integers(0, size, (20, 2)):
        # Whole, mirrored, whole: a period of twice the size.
        source = [(v % 64) if (v % 64) < 32 else 63 - v % 64 for v in (y - top, x - left)]
        assert (flow[y, x] == whole[tuple(source)]).all()


def test_stretched_flows_grow_with_the_scene(training):
    plain, _ = continue_flows(training, 1, np.random.default_rng(0))
    wide, _ = continue_flows(training, 1, np.random.default_rng(0), DynamicTextureParams(fit="stretch"), size=(32, 96))
    assert wide[0].shape == (32, 96, 2)
    # Every third pixel centre falls on one of the smaller grid.
    assert wide[0][:, 1::3, 0] == pytest.approx(3 * plain[0][..., 0], abs=1e-4)
    assert wide[0][:, 1::3, 1] == pytest.approx(plain[0][..., 1], abs=1e-4)


def test_colour_scenes_of_another_size_are_taken(clip):
    scene = np.random.default_rng(4).random((50, 90, 3), dtype=np.float32)
    texture = synthesize_like(clip, 2, np.random.default_rng(0), QUICK, scene=scene)
    assert texture.scene.shape == (50, 90, 3)
    assert texture.flows[1].shape == (50, 90, 2)


def test_a_still_clip_gives_still_flows():
    flows, dynamics = continue_flows(np.zeros((4, 8, 8, 2)), 3, np.random.default_rng(0))
    assert dynamics.rank == 0
    assert not np.any([*flows])


def test_the_mean_flow_is_left_out(training):
    flows, dynamics = seeded(training + np.float32(3.0), 400)
    assert dynamics.mean_flow.mean() > 2
    assert abs(np.mean([*flows])) < 0.3


def test_bad_parameters_are_refused(clip, training):
    rng = np.random.default_rng(0)
    for count in (0, -3):
        with pytest.raises(ConfigurationError, match="^count: expected"):
            synthesize_like(clip, count, rng)
        with pytest.raises(ConfigurationError, match="^count: expected"):
            continue_flows(training, count, rng)
    with pytest.raises(DataError, match=r"^flows: expected .* at least 3 flows"):
        continue_flows(training[:2], 5, rng)
    with pytest.raises(DataError, match="^scene: expected shape"):
        synthesize_like(clip, 5, rng, scene=np.zeros(3))
    with pytest.raises(DataError, match="^scene: expected contrast, found one colour"):
        synthesize_like(clip, 5, rng, scene=np.full((64, 64), 0.5))
    with pytest.raises(DataError, match="^scene: expected at least 16×16 pixels, found 1×1"):
        synthesize_like(clip, 5, rng, scene=np.ones((1, 1)))
    with pytest.raises(DataError, match="^frames: expected"):
        synthesize_like(clip[:1], 5, rng)
