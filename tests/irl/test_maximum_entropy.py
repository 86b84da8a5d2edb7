"""Learning a reward: derivatives, likelihoods, and weights that are known because
demonstrators drove for them.
"""

from dataclasses import replace
from functools import partial
from itertools import accumulate

import jax
import numpy as np
import pytest
from scipy import stats

from ms_highway.game.dynamics import step
from ms_highway.game.reward import RewardModel
from ms_highway.game.scenario import PAPER_DYNAMICS
from ms_highway.irl import TEMPERATURE
from ms_highway.irl.demonstrations import load_demonstrations, record
from ms_highway.irl.demonstrator import DRIVER_WEIGHTS
from ms_highway.irl.learning import REAL, SIMULATED, expected_features, learn_reward
from ms_highway.irl.maximum_entropy import (
    FeatureDerivatives,
    differentiate,
    fit_weights,
    log_likelihoods,
)
from ms_highway.irl.recording import Recording
from ms_highway.irl.segments import cut_segments


def test_controls_are_normal_or_student_if_comfort_alone_is_rewarded():
    controls = np.random.default_rng(0).normal(size=(7, 6))
    hessians = np.broadcast_to(-np.eye(6), (7, 1, 6, 6))
    features = -np.sum(controls**2, axis=-1, keepdims=True) / 2
    derivatives = FeatureDerivatives(features, -controls[:, None], hessians)
    theta = np.array([2.0])
    with jax.enable_x64(True):
        normal = log_likelihoods(derivatives, theta, 0.5, 1e-3, None)
        student = log_likelihoods(derivatives, theta, 0.5, 1e-3, 3.0)
    expected = stats.norm.logpdf(controls, scale=0.5).sum(axis=-1)
    np.testing.assert_allclose(normal, expected, rtol=1e-12)
    expected = stats.multivariate_t.logpdf(controls, shape=np.eye(6) / 4, df=3)
    np.testing.assert_allclose(student, expected, rtol=1e-12)


def test_the_weights_of_a_demonstrator_are_recovered(tmp_path, monkeypatch):
    """A weight without information, here of a gap to nobody, keeps its prior."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    assert list(record("maxent", 12, "maxent-v0"))
    demonstrated = cut_segments(load_demonstrations("maxent-v0"), 5)
    model = RewardModel((*SIMULATED.learned, "gap"), SIMULATED.given)
    derivatives = differentiate(demonstrated, model.names)
    found = fit_weights(derivatives, model)
    assert found.temperature == pytest.approx(TEMPERATURE, rel=0.15)
    *deviations, prior, _ = np.sqrt(found.covariance.diagonal())
    for name, deviation in zip(SIMULATED.learned, deviations, strict=True):
        error = abs(np.log(found.weights[name] / DRIVER_WEIGHTS[name]))
        assert error < min(np.log(1.25), 3.5 * deviation), name
    assert found.weights["gap"] == pytest.approx(1.0, rel=1e-2)
    assert prior == pytest.approx(4.0, rel=1e-3)
    human = derivatives.features.mean(axis=0)
    expected = expected_features(demonstrated, found)
    compared = [name not in ("collision_risk", "off_road") for name in model.names]
    np.testing.assert_allclose(expected[compared], human[compared], rtol=0.1)


def test_recordings_from_which_nothing_can_be_learned_are_refused():
    off_road = np.tile([0.0, 40.0, 0.0, 20.0], (11, 1, 1))
    road = np.array([0]), np.array([[5.0, 2.5]]), np.zeros(1), 3.3, 20.0
    recording = Recording("made", "made", off_road, *road, measured=False)
    with pytest.raises(
        ValueError, match="nothing can be learned from the 1 recordings"
    ):
        cut_segments([recording], 5)
    off_road[4, 0, 3] = np.nan
    with pytest.raises(
        ValueError,
        match="car 0 is finite at 10 steps, not at two or more without a gap",
    ):
        replace(recording)


def driven(*controls):
    """A recording of cars in two lanes, one behind the other, that are driven by
    controls [steps, 2].
    """
    drive = partial(step, PAPER_DYNAMICS)
    starts = [
        np.array([20.0 * car, 3.5 * (car % 2) + 0.3, 0.0, 10.0 * own[0].any()])
        for car, own in enumerate(controls)
    ]
    states = [
        np.stack([*accumulate(own, drive, initial=start)])
        for own, start in zip(controls, starts, strict=True)
    ]
    road = np.array([0.0, 3.5]), 3.5, 20.0
    cars = np.arange(len(states)), np.tile([5.0, 2.0], (len(states), 1))
    return Recording(
        "made", "made", np.stack(states, axis=1), *cars, *road, measured=False
    )


def test_weights_do_not_diverge_if_a_driver_stands():
    random = np.random.default_rng(0)
    noise = random.normal(size=(3, 60, 2)) * [0.002, 0.5]
    friction = 2.0  # m/s^2, which the acceleration makes up for
    swerving = np.array([0.0, friction]) + noise
    standing = np.where(np.arange(60)[:, None] < 45, 0.0, [0.001, 1.0])
    with pytest.warns(
        UserWarning,
        match=(
            r"9 of 48 segments are left out, .* does not change at all \(car 3 of"
            r" made\)"
        ),
    ):
        found = learn_reward([driven(*swerving, standing)], REAL, 5, "made")
    alone = learn_reward([driven(*swerving)], REAL, 5, "made")
    assert found.weights["comfort_steering"] == pytest.approx(
        alone.weights["comfort_steering"], rel=0.5
    )
    assert "car 3 of made" in found.provenance["left_out"]
    assert "left_out" not in alone.provenance
