"""Learning a reward: derivatives, likelihoods, and weights that are known because demonstrators drove for them."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy import stats

from ms_highway.game.reward import RewardModel
from ms_highway.irl import TEMPERATURE
from ms_highway.irl.demonstrations import load_demonstrations, record
from ms_highway.irl.demonstrator import DRIVER_WEIGHTS
from ms_highway.irl.learning import SIMULATED, expected_features
from ms_highway.irl.maximum_entropy import FeatureDerivatives, differentiate, fit_weights, log_likelihoods
from ms_highway.irl.recording import Recording
from ms_highway.irl.segments import cut_segments


def test_if_comfort_alone_is_rewarded_controls_have_a_normal_or_a_student_distribution():
    controls = np.random.default_rng(0).normal(size=(7, 6))
    hessians = np.broadcast_to(-np.eye(6), (7, 1, 6, 6))
    derivatives = FeatureDerivatives(-np.sum(controls**2, axis=-1, keepdims=True) / 2, -controls[:, None], hessians)
    with jax.enable_x64(True):
        normal, student = (log_likelihoods(derivatives, np.array([2.0]), 0.5, 1e-3, tails) for tails in (None, 3.0))
    np.testing.assert_allclose(normal, stats.norm.logpdf(controls, scale=0.5).sum(axis=-1), rtol=1e-12)
    np.testing.assert_allclose(student, stats.multivariate_t.logpdf(controls, shape=np.eye(6) / 4, df=3), rtol=1e-12)


def test_the_weights_of_a_demonstrator_are_recovered_and_one_without_information_keeps_its_prior(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    assert list(record("maxent", 12, "maxent-v0"))
    demonstrated = cut_segments(load_demonstrations("maxent-v0"), 5)
    model = RewardModel((*SIMULATED.learned, "gap"), SIMULATED.given)  # there is no leader to keep a gap to
    derivatives = differentiate(demonstrated, model.names)
    found = fit_weights(derivatives, model)
    assert found.temperature == pytest.approx(TEMPERATURE, rel=0.15)
    *deviations, prior, _ = np.sqrt(found.covariance.diagonal())
    for name, deviation in zip(SIMULATED.learned, deviations, strict=True):
        error = abs(np.log(found.weights[name] / DRIVER_WEIGHTS[name]))
        assert error < min(np.log(1.25), 3.5 * deviation), name
    assert (found.weights["gap"], prior) == (pytest.approx(1.0, rel=1e-2), pytest.approx(4.0, rel=1e-3))
    human, expected = derivatives.features.mean(axis=0), expected_features(demonstrated, found)
    compared = [name not in ("collision_risk", "off_road") for name in model.names]
    np.testing.assert_allclose(expected[compared], human[compared], rtol=0.1)


def test_recordings_from_which_nothing_can_be_learned_are_refused():
    off_road = np.tile([0.0, 40.0, 0.0, 20.0], (11, 1, 1))
    road = np.array([0]), np.array([[5.0, 2.5]]), np.zeros(1), 3.3, 20.0
    recording = Recording("made", "made", off_road, *road, measured=False)
    with pytest.raises(ValueError, match="nothing can be learned from the 1 recordings"):
        cut_segments([recording], 5)
    off_road[4, 0, 3] = np.nan
    with pytest.raises(ValueError, match="car 0 is finite at 10 steps, not at two or more without a gap"):
        replace(recording)
