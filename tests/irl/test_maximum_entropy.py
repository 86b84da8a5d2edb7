"""Learning a reward: derivatives, likelihoods, and weights that are known because demonstrators drove for them."""

from collections.abc import Callable
from dataclasses import replace

import gymnasium as gym
import jax
import numpy as np
import pytest
from jax import numpy as jnp
from scipy import stats

from ms_highway.envs import DEMONSTRATION_ID
from ms_highway.game.reward import COMFORT, FEATURES, OWN_FEATURES
from ms_highway.game.reward_model import NO_GRADIENT, RewardModel
from ms_highway.irl.learning import SIMULATED, best_controls, expected_features
from ms_highway.irl.maximum_entropy import FeatureDerivatives, differentiate, fit, log_likelihoods, most_likely
from ms_highway.irl.recordings.demonstrations import actions
from ms_highway.irl.recordings.demonstrators import DRIVER_WEIGHTS
from ms_highway.irl.recordings.drivers import TEMPERATURE
from ms_highway.irl.recordings.recording import Recording
from ms_highway.irl.recovery import recover
from ms_highway.irl.sampled_maximum_entropy import fit_sampled
from ms_highway.irl.windows import Windows, cut_windows, driver_game, features_along, regular, regular_windows
from ms_highway.runtime.compilation import jit_quickly

DENSITIES = ("sparse", "medium", "dense")


@pytest.fixture(scope="module")
def demonstrations() -> list[Recording]:
    """30 episodes of the maximum-entropy driver."""
    env, recordings = gym.make(DEMONSTRATION_ID), []
    for seed in range(30):
        env.reset(seed=seed, options={"config": {"density": DENSITIES[seed % 3]}})
        world = env.unwrapped
        states = [world.car_states]
        for action in actions("maxent", world, seed):
            *_, truncated, _ = env.step(action)
            states.append(world.car_states)
            if truncated:
                break
        recordings.append(recorded(np.where(world.present[:, None], states, np.nan), world.game.scene, f"seed {seed}"))
    return recordings


@pytest.fixture(scope="module")
def demonstrated(demonstrations) -> Windows:
    """Those of their windows that can be learned from."""
    return regular_windows(demonstrations, 5)


def recorded(states: np.ndarray, scene, name: str) -> Recording:
    sizes = np.tile(np.asarray(scene.car_size, dtype=float), (states.shape[1], 1))
    lanes, width = np.asarray(scene.lanes, dtype=float), float(scene.lane_width)
    return Recording(name, name, 0.1, states, np.array([0]), sizes, lanes, width, 20.0, measured=False)


def quickly(function: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """The function of many at once, compiled."""
    return jit_quickly(jax.vmap(function))


def test_slopes_of_features_also_of_ones_own_are_those_of_automatic_differentiation(demonstrated, monkeypatch):
    monkeypatch.setitem(OWN_FEATURES, "crowd", lambda scene, own, others: jnp.sum(jnp.cos((own.x - others.x) / 20)))
    computed = (*FEATURES, "crowd", *COMFORT)
    names = RewardModel(tuple(name for name in computed[:-1] if name not in NO_GRADIENT), {COMFORT[1]: 0.1}).names
    places = np.array([computed.index(name) for name in names])
    few = demonstrated.of(np.arange(len(demonstrated)) % 40 == 0)
    slopes, game = differentiate(few, names), driver_game(few, {}, names)
    single = jax.tree.map(lambda numbers: jnp.asarray(numbers, dtype=jnp.float32), few)

    def along(window, controls):
        return features_along(game, window, controls.reshape(-1, 2))[places]

    controls = (single.controls / game.planner.control_scale).reshape(len(few), -1)
    np.testing.assert_allclose(slopes.features, quickly(along)(single, controls), rtol=1e-5, atol=1e-6)
    first = quickly(jax.jacrev(along, argnums=1))(single, controls)
    np.testing.assert_allclose(slopes.gradients, first, rtol=1e-4, atol=1e-5 * np.abs(first).max())
    second = quickly(jax.jacfwd(jax.jacfwd(along, argnums=1), argnums=1))(single, controls)
    np.testing.assert_allclose(slopes.hessians, second, rtol=1e-3, atol=1e-5 * np.abs(second).max())


def test_the_likelihood_of_a_driver_after_comfort_alone_is_that_of_a_normal_distribution():
    random = np.random.default_rng(0)
    uneasy = random.normal(size=(7, 6))
    hessians = np.broadcast_to(-np.eye(6), (7, 1, 6, 6))
    slopes = FeatureDerivatives(-np.sum(uneasy**2, axis=-1, keepdims=True) / 2, -uneasy[:, None], hessians)
    with jax.enable_x64(True):
        found = log_likelihoods(slopes, np.array([2.0]), 0.5, 1e-3)
    np.testing.assert_allclose(found, stats.norm.logpdf(uneasy, scale=0.5).sum(axis=-1), rtol=1e-12)


@pytest.mark.slow
def test_weights_that_demonstrators_drove_for_are_recovered(demonstrated):
    found = fit(differentiate(demonstrated, SIMULATED.names), SIMULATED)
    assert found.converged
    assert found.temperature == pytest.approx(TEMPERATURE, rel=0.15)
    for place, name in enumerate(SIMULATED.learned):
        ratio = found.weights[name] / DRIVER_WEIGHTS[name]
        assert 1 / 1.25 < ratio < 1.25, name
        assert abs(np.log(ratio)) < 3.5 * np.sqrt(found.covariance[place, place]), name

    sampled = fit_sampled(demonstrated, found)
    for name in SIMULATED.learned:
        assert sampled.weights[name] == pytest.approx(found.weights[name], rel=0.15), name

    human = dict(zip(SIMULATED.names, differentiate(demonstrated, SIMULATED.names).features.mean(axis=0), strict=True))
    model = dict(zip(SIMULATED.names, expected_features(demonstrated, found), strict=True))
    for name in ("speed", "lane_alignment", "comfort_steering", "comfort_acceleration"):
        assert model[name] == pytest.approx(human[name], rel=0.1), name


@pytest.mark.slow
def test_recovery_tells_how_far_off_weights_are_and_what_that_costs(demonstrations):
    rows = recover(demonstrations, [20, 4], held_out=8)
    assert list(rows["demonstrations"].unique()) == [4, 20]
    assert list(rows["weight"].unique()) == list(SIMULATED.learned)
    assert rows["identifiable"].all()
    np.testing.assert_allclose(rows["log_ratio"], np.log(rows["learned"] / rows["true"]))
    many = rows[rows["demonstrations"] == 20]
    assert (abs(many["log_ratio"]) < np.log(1.25)).all()
    assert 0 <= many["regret"].iloc[0] < 0.01
    assert (rows["log_likelihood"] < rows["log_likelihood_true"] + 0.1).all()
    with pytest.raises(ValueError, match="takes 38: record more"):
        recover(demonstrations, [30], held_out=8)


@pytest.mark.slow
def test_the_best_controls_of_a_window_earn_more_than_what_was_done(demonstrated):
    few = demonstrated.of(np.arange(len(demonstrated)) % 20 == 0)
    weights = {name: weight / TEMPERATURE for name, weight in DRIVER_WEIGHTS.items()}
    best = replace(few, controls=best_controls(few, weights))
    theta = np.array([weights[name] for name in SIMULATED.names])
    gain = (differentiate(best, SIMULATED.names).features - differentiate(few, SIMULATED.names).features) @ theta
    assert (gain > -0.01).all()
    assert np.median(gain) == pytest.approx(10 / 2, rel=0.5)  # half a unit of log p for each of ten noisy controls


def test_drivers_that_tell_nothing_about_a_weight_leave_its_prior(demonstrated):
    few = demonstrated.of(np.arange(len(demonstrated)) < 40)
    model = RewardModel((*SIMULATED.learned, "gap"), SIMULATED.given)  # there is no leader to keep a gap to
    found = fit(differentiate(few, model.names), model)
    assert np.sqrt(found.covariance[3, 3]) == pytest.approx(4.0, rel=1e-3)
    assert found.weights["gap"] == pytest.approx(1.0, rel=1e-2)


def test_windows_at_a_kink_or_at_a_limit_are_not_learned_from(demonstrated):
    off_road = replace(demonstrated, start=demonstrated.start + np.array([0, 30.0, 0, 0]) * [0, 1, 0, 0])
    off_road = replace(off_road, start=np.where(np.arange(4) == 2, 0.0, off_road.start))
    assert not regular(replace(off_road, controls=np.zeros_like(off_road.controls))).any()
    assert not regular(replace(demonstrated, controls=demonstrated.controls + np.array([0.0, 60.0]))).any()


@pytest.mark.parametrize(
    ("learned", "given", "message"),
    [
        (("sped",), {"comfort_acceleration": 0.1}, "'sped' cannot be learned"),
        (("collision",), {"comfort_acceleration": 0.1}, "'collision' cannot be learned"),
        (("speed", "speed"), {"comfort_acceleration": 0.1}, "named twice"),
        (("speed",), {"speed": 1.0, "comfort_acceleration": 0.1}, "named twice"),
        (("speed",), {}, "sets the scale"),
    ],
)
def test_an_impossible_model_is_refused(learned, given, message):
    with pytest.raises(ValueError, match=message):
        RewardModel(learned, given)


def test_weights_that_diverge_and_features_that_are_not_finite_are_refused(demonstrated):
    def worthless(data, theta, temperature):
        return data * jnp.nan * theta[0]

    with pytest.raises(ValueError, match="the weights diverge"):
        most_likely(worthless, np.ones(3), SIMULATED)
    broken = demonstrated.of(np.arange(len(demonstrated)) < 3)
    broken.start[1, 3] = np.nan
    with pytest.raises(ValueError, match="window 1 have no finite derivatives"):
        differentiate(broken, SIMULATED.names)


def test_recordings_that_are_too_short_or_sampled_otherwise_are_refused(played):
    scene = played("merger")[0].scene
    short = recorded(np.zeros((3, 2, 4)), scene, "a short one")
    with pytest.raises(ValueError, match="seen for 6 samples on end"):
        cut_windows([short], 5)
    with pytest.raises(ValueError, match=r"a short one has a time step of 0\.2 s"):
        cut_windows([replace(short, time_step=0.2)], 2)
    aside = np.tile([[0.0, 40.0, 0.0, 20.0], [0.0, 0.0, 0.0, 20.0]], (9, 1, 1))
    with pytest.raises(ValueError, match="nothing can be learned from the 1 recordings"):
        regular_windows([recorded(aside, scene, "off the road")], 5)
    with pytest.raises(ValueError, match="no lanes"):
        replace(short, lanes=np.empty(0))
    states = np.zeros((9, 2, 4))
    states[4, 0, 3] = np.nan
    with pytest.raises(ValueError, match="car 0 at step 4 is not finite"):
        recorded(states, scene, "a hole")
