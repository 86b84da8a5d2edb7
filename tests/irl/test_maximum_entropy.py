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
from ms_highway.irl.maximum_entropy import (
    FeatureDerivatives,
    differentiate,
    fit_weights,
    log_likelihoods,
)
from ms_highway.irl.recording import Recording
from ms_highway.irl.segments import cut_segments

NAME = "ms-highway/maxent-v0"


def recorded(states):
    sizes, lanes = np.tile([5.0, 2.5], (states.shape[1], 1)), np.arange(3) * 10 / 3
    return Recording("made", "made", states, np.array([0]), sizes, lanes, 10 / 3, 20.0, measured=False)


@pytest.fixture(scope="module")
def demonstrate(tmp_path_factory):
    """A function that returns segments that can be learned from, of episodes of the maximum-entropy driver."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))

        def of(episodes):
            assert list(record("maxent", episodes, NAME))
            return cut_segments(load_demonstrations(NAME), 5)

        yield of


@pytest.fixture(scope="module")
def demonstrated(demonstrate):
    return demonstrate(6)


def test_the_likelihood_of_a_driver_after_comfort_alone_is_that_of_a_normal_or_a_student_distribution():
    uneasy = np.random.default_rng(0).normal(size=(7, 6))
    hessians = np.broadcast_to(-np.eye(6), (7, 1, 6, 6))
    slopes = FeatureDerivatives(-np.sum(uneasy**2, axis=-1, keepdims=True) / 2, -uneasy[:, None], hessians)
    with jax.enable_x64(True):
        normal, student = (log_likelihoods(slopes, np.array([2.0]), 0.5, 1e-3, tails) for tails in (None, 3.0))
    np.testing.assert_allclose(normal, stats.norm.logpdf(uneasy, scale=0.5).sum(axis=-1), rtol=1e-12)
    np.testing.assert_allclose(student, stats.multivariate_t.logpdf(uneasy, shape=np.eye(6) / 4, df=3), rtol=1e-12)


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


def test_drivers_that_tell_nothing_about_a_weight_leave_its_prior(demonstrated):
    model = RewardModel((*SIMULATED.learned, "gap"), SIMULATED.given)  # there is no leader to keep a gap to
    found = fit_weights(differentiate(demonstrated, model.names), model)
    assert np.sqrt(found.covariance[3, 3]) == pytest.approx(4.0, rel=1e-3)
    assert found.weights["gap"] == pytest.approx(1.0, rel=1e-2)


def test_recordings_of_which_nothing_can_be_learned_are_refused():
    aside = np.tile([[0.0, 40.0, 0.0, 20.0], [0.0, 0.0, 0.0, 20.0]], (9, 1, 1))
    with pytest.raises(ValueError, match="nothing can be learned from the 1 recordings"):
        cut_segments([recorded(aside)], 5)
    aside[4, 0, 3] = np.nan
    with pytest.raises(ValueError, match="car 0 is finite at 8 steps, not at two or more on end"):
        recorded(aside)
