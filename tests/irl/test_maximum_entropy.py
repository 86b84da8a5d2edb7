"""Learning a reward: derivatives, likelihoods, and weights that are known because demonstrators drove for them."""

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

NAME = "ms-highway/maxent-v0"


def recorded(states):
    road = np.array([[5.0, 2.5]]), np.zeros(1), 3.3, 20.0
    return Recording("made", "made", states, np.array([0]), *road, measured=False)


@pytest.fixture
def demonstrate(tmp_path, monkeypatch):
    """A function that returns the segments of episodes of the maximum-entropy driver."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))

    def segments_of(episodes):
        assert list(record("maxent", episodes, NAME))
        return cut_segments(load_demonstrations(NAME), 5)

    return segments_of


def test_if_comfort_alone_is_rewarded_controls_have_a_normal_or_a_student_distribution():
    controls = np.random.default_rng(0).normal(size=(7, 6))
    hessians = np.broadcast_to(-np.eye(6), (7, 1, 6, 6))
    derivatives = FeatureDerivatives(-np.sum(controls**2, axis=-1, keepdims=True) / 2, -controls[:, None], hessians)
    with jax.enable_x64(True):
        normal, student = (log_likelihoods(derivatives, np.array([2.0]), 0.5, 1e-3, tails) for tails in (None, 3.0))
    np.testing.assert_allclose(normal, stats.norm.logpdf(controls, scale=0.5).sum(axis=-1), rtol=1e-12)
    np.testing.assert_allclose(student, stats.multivariate_t.logpdf(controls, shape=np.eye(6) / 4, df=3), rtol=1e-12)


@pytest.mark.slow
def test_the_weights_of_a_demonstrator_are_recovered(demonstrate):
    demonstrated = demonstrate(30)
    derivatives = differentiate(demonstrated, SIMULATED.names)
    found = fit_weights(derivatives, SIMULATED)
    assert found.temperature == pytest.approx(TEMPERATURE, rel=0.15)
    for place, name in enumerate(SIMULATED.learned):
        ratio = found.weights[name] / DRIVER_WEIGHTS[name]
        assert 1 / 1.25 < ratio < 1.25, name
        assert abs(np.log(ratio)) < 3.5 * np.sqrt(found.covariance[place, place]), name
    human, model = derivatives.features.mean(axis=0), expected_features(demonstrated, found)
    for place, name in enumerate(SIMULATED.names):
        if name not in ("collision_risk", "off_road"):
            assert model[place] == pytest.approx(human[place], rel=0.1), name


def test_a_weight_about_which_driving_carries_no_information_keeps_its_prior(demonstrate):
    model = RewardModel((*SIMULATED.learned, "gap"), SIMULATED.given)  # there is no leader to keep a gap to
    found = fit_weights(differentiate(demonstrate(6), model.names), model)
    assert np.sqrt(found.covariance[3, 3]) == pytest.approx(4.0, rel=1e-3)
    assert found.weights["gap"] == pytest.approx(1.0, rel=1e-2)


def test_recordings_from_which_nothing_can_be_learned_are_refused():
    off_road = np.tile([0.0, 40.0, 0.0, 20.0], (9, 1, 1))
    with pytest.raises(ValueError, match="nothing can be learned from the 1 recordings"):
        cut_segments([recorded(off_road)], 5)
    off_road[4, 0, 3] = np.nan
    with pytest.raises(ValueError, match="car 0 is finite at 8 steps, not at two or more without a gap"):
        recorded(off_road)
