"""Plans under the ladder of human models."""

from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
import pytest
from jax import numpy as jnp

import ms_highway
from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.game import swap_players, total_reward
from ms_highway.game.scenarios import MERGER, MERGER_V1
from ms_highway.planning.compiled_plans import CompiledPlans, checked_state
from ms_highway.planning.human_models import TheoryOfMind
from ms_highway.planning.ladders import MODELS
from ms_highway.runtime.compilation import jit_quickly


def plan(model, game, state):
    return CompiledPlans(game, [model]).plan(checked_state(state), [0])[0]


def mirrored(game, state):
    """The game and the state seen in a mirror along the road."""
    flip = jnp.array([1.0, -1.0])
    scene = game.scene
    scene = replace(scene, lanes=-scene.lanes, obstacles=scene.obstacles * flip, target_lane=-scene.target_lane)
    return replace(game, scene=scene), state * jnp.array([1.0, -1.0, -1.0, 1.0])


@pytest.mark.parametrize("name", MODELS)
def test_mirrored_scenes_give_mirrored_plans(played, name):
    game, state = played("merger", seed=3)
    straight, mirror = plan(MODELS[name], game, state), plan(MODELS[name], *mirrored(game, state))
    scale = np.array([-1.0, 1.0])
    np.testing.assert_allclose(mirror.robot, straight.robot * scale, atol=2e-3)
    np.testing.assert_allclose(mirror.humans, straight.humans * scale, atol=2e-3)


slopes = jit_quickly(jax.grad(total_reward, argnums=(2, 3)))


def after_one_step(game):
    return replace(game, planner=replace(game.planner, iterations=1))


@pytest.mark.parametrize("influence", ["exact", "damped"])
def test_theory_of_mind_steps_along_the_total_derivative(played, influence):
    """The first step is 0.03 (dR_R/du_R + J^T dR_R/du_H), with J = -H^-1 d2R_H/du_H du_R formed explicitly."""
    game, state = played("merger")
    game = replace(game, influence=influence)
    still = jnp.zeros((5, 2))
    mirrored, mirrored_state = swap_players(game, state)

    def human_reward(robot, human):
        return total_reward(mirrored, mirrored_state, human, robot[None])

    slope_robot, slope_human = slopes(game, state, still, still[None])
    mixed, own = jit_quickly(jax.jacfwd(jax.grad(human_reward, argnums=1), argnums=(0, 1)))(still, still)
    own = np.asarray(own, dtype=float).reshape(10, 10)
    if influence == "damped":
        values, vectors = np.linalg.eigh(own)
        own = -(vectors * np.maximum(np.abs(values), 1.0)) @ vectors.T
    jacobian = -np.linalg.solve(own, np.asarray(mixed, dtype=float).reshape(10, 10))
    expected = slope_robot + (jacobian.T @ np.asarray(slope_human).reshape(10)).reshape(5, 2)
    assert abs(expected - slope_robot).max() > 1e-3, "the influence should matter here"
    step = plan(TheoryOfMind(), after_one_step(game), state).robot
    np.testing.assert_allclose(step, 0.03 * expected, rtol=1e-2, atol=1e-4)


def test_theory_of_mind_makes_the_human_yield_and_naive_does_not(played):
    """In plans for Merger, the human brakes for a robot that counts on it, and the robot steers in."""
    game, state = played("merger")
    naive, tom = plan(MODELS["naive"], game, state), plan(MODELS["tom"], game, state)
    assert tom.humans[0, :, 1].mean() < naive.humans[0, :, 1].mean()
    assert tom.robot[0, 0] < naive.robot[0, 0] < 0  # to the left, and more so


@dataclass(frozen=True)
class Told(ms_highway.PredictedHuman):
    name = "told"
    acceleration: float = 0.0

    def predict(self, game, state, start=None):
        control = keep_velocity(game.dynamics, state[1]) + jnp.array([0.0, self.acceleration])
        return [control] * game.planner.horizon  # a list also says it


@pytest.mark.parametrize("humans", [1, 2])
def test_a_registered_model_predicts_in_si_units(played, humans):
    game, state = played("merger", humans=humans)
    braking = Told(acceleration=-4.0)
    planned = CompiledPlans(game, [braking]).plan(checked_state(state), [0] * humans)[0]
    expected = 0.2 * state[1, 3] - 4.0  # friction is made up for
    np.testing.assert_allclose(planned.humans[..., 1] * game.planner.control_scale[1], expected, rtol=1e-5)


def test_there_is_a_warning_if_limits_cut_a_prediction(played):
    game, state = played(MERGER_V1, semantics="physical")
    state = checked_state(state)
    with pytest.warns(UserWarning, match=r"'told' predicts an acceleration of -396 m/s\^2.*limits.*to -3.99"):
        CompiledPlans(game, [Told(acceleration=-400.0)]).warm_up(state)


@dataclass(frozen=True)
class Says(ms_highway.PredictedHuman):
    name = "says"
    what: Any = None

    def predict(self, game, state, start=None):
        return self.what


@pytest.mark.parametrize("humans", [1, 2])
@pytest.mark.parametrize(
    ("what", "told"),
    [
        (None, "None"),
        (((0.0, -4.0),) * 3, r"an array of shape \(3, 2\)"),
        (((0.0, 1j),) * 5, "an array .* and type complex64"),
    ],
)
def test_an_invalid_prediction_is_refused_with_the_shape_and_the_units(played, humans, what, told):
    game, state = played("merger", humans=humans)
    plans = CompiledPlans(game, [Says(what=what)])
    with pytest.raises(ValueError, match=rf"model 'says' predicts {told}.*; predict numbers \(5, 2\): curvature \[1/m"):
        plans.plan(checked_state(state), [0] * humans)


def test_the_prediction_of_every_model_is_what_its_plan_expects(played):
    game, state = played("merger")
    for model in MODELS.values():
        predicted, counted_on = jit_quickly(model.predict)(game, state), plan(model, game, state).humans[0]
        np.testing.assert_allclose(counted_on * game.planner.control_scale, predicted, atol=1e-4)


@pytest.mark.parametrize(
    ("numbers", "told"),
    [
        ({"lanes": (-0.1, 0.0)}, r"lanes at \(-0.1, 0.0\).*2.5 to 6 m apart.*metres"),
        ({"cars": ((-10.0, 0.0), (0.0, 30.0))}, r"a car at \(0.0, 30.0\), beside all lanes"),
        ({"humans": 2}, "humans=2 and 0 streams; streams say where"),
        ({"cones": ((10.0, float("nan")),)}, r"a cone at \(10.0, nan\)"),
    ],
)
def test_impossible_scenarios_are_refused(numbers, told):
    with pytest.raises(ValueError, match=f"scenario 'merger' has {told}"):
        replace(MERGER, **numbers)
