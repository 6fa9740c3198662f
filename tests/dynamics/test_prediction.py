"""One-step prediction against brute force, and against systems whose best prediction is known."""

import numpy as np
import pytest

from turbrestore.core.errors import DataError
from turbrestore.display.spectra import plot_prediction
from turbrestore.dynamics.dynamic_texture import DynamicsParams, identify
from turbrestore.dynamics.flow_model import predict_flow, project_deviation
from turbrestore.dynamics.prediction import flow_error, prediction_error, study_prediction


def simulated(count, radius=0.95, angle=0.6, noise=0.3, seed=0):
    """Flows of two turning states with process noise, in a random plane, around a mean."""
    rng = np.random.default_rng(seed)
    modes = np.linalg.qr(rng.normal(size=(6 * 5 * 2, 2)))[0]
    turn = radius * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    states = [np.array([5.0, 0.0])]
    for _ in range(count - 1):
        states.append(turn @ states[-1] + noise * rng.normal(size=2))
    flows = 0.2 + (modes @ np.array(states).T).T + 0.01 * rng.normal(size=(count, 60))
    return flows.reshape(count, 6, 5, 2).astype(np.float32)


def test_the_error_is_that_of_the_predicted_flows():
    flows = simulated(40)
    model = identify(flows[:30], DynamicsParams(rank=2))
    predicted = [predict_flow(model, project_deviation(model, flow - model.mean_flow)) for flow in flows[29:-1]]
    assert prediction_error(model, flows[29:]) == pytest.approx(flow_error(np.array(predicted), flows[30:]), rel=1e-4)


def test_a_long_training_reaches_the_noise_of_the_process():
    flows = simulated(400)
    study = study_prediction(flows, DynamicsParams(rank=2))
    # Two states with noise of 0.3 in 60 components, and 0.01 in each.
    best = np.sqrt(2 * 0.3**2 / 60 + 0.01**2)
    assert study.ranks.tolist() == [1, 2]
    assert study.errors[-1, 1] == pytest.approx(best, rel=0.15)
    assert study.errors[-1, 1] < 0.7 * min(study.errors[-1, 0], study.repeated, study.mean)
    assert np.abs(study.eigenvalues[-1][1]) == pytest.approx([0.95, 0.95], abs=0.03)


def test_only_flows_before_the_predicted_ones_train():
    """Figure 7a: as many states as flows allow repeat the training, and the last flows do not help them."""
    flows = simulated(24)
    study = study_prediction(flows, DynamicsParams(rank=17))
    assert study.count == 6
    assert study.lengths[-1] == 18
    assert np.abs(study.eigenvalues[-1][-1]) == pytest.approx(np.ones(17), abs=1e-3)
    changed = flows.copy()
    changed[-1] += 1
    again = study_prediction(changed, DynamicsParams(rank=17))
    assert all(np.array_equal(*pair) for pair in zip(study.eigenvalues[-1], again.eigenvalues[-1], strict=True))
    assert (again.errors[-1] > study.errors[-1]).all()


def test_where_states_are_as_many_as_flows_there_is_no_model():
    study = study_prediction(simulated(32), DynamicsParams(rank=12))
    assert study.errors.shape == (5, 4)
    assert np.isnan(study.errors[0]).tolist() == [rank >= 3 for rank in study.ranks]
    assert [len(found) for found in study.eigenvalues] == np.isfinite(study.errors).sum(axis=1).tolist()


def test_still_flows_are_predicted():
    study = study_prediction(np.ones((5, 4, 4, 2), np.float32))
    assert study.repeated == study.mean == 0
    assert np.nanmax(study.errors) == 0


@pytest.mark.parametrize("flows", [np.zeros((4, 4, 4, 2)), np.zeros((4, 4, 2))])
def test_too_few_flows_are_refused(flows):
    with pytest.raises(DataError, match="expected at least 5"):
        study_prediction(flows)


def test_the_picture_has_a_curve_for_each_number_of_states_and_a_panel_for_each_training():
    study = study_prediction(simulated(32), DynamicsParams(rank=4))
    baselines = {"flow before": study.repeated, "mean flow": study.mean}
    figure = plot_prediction(study.lengths, study.ranks, study.errors, study.eigenvalues, baselines)
    curves, *panels = figure.axes
    assert len(curves.get_lines()) == len(study.ranks) + 2
    assert len(panels) == len(study.lengths)
    assert panels[-1].get_title(loc="left") == f"τ = {study.lengths[-1]}, n = 4"
