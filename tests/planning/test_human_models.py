"""Plans under the ladder of human models."""

from dataclasses import dataclass, replace

import jax
import numpy as np
import pytest
from driving import Brakes

import ms_highway
from ms_highway.game.game import swap_players, total_reward
from ms_highway.numerics.solvers import Ascent
from ms_highway.planning.compiled_plans import CompiledPlans, checked_state
from ms_highway.planning.human_models import TheoryOfMind
from ms_highway.planning.ladders import MODELS
from ms_highway.runtime.compilation import jit_quickly


def plan(model, game, state):
    return CompiledPlans(game, [model]).plan(checked_state(state), [0])[0].plan


def mirrored(game, state):
    """The game and the state seen in a mirror along the road."""
    scene = replace(
        game.scene, lanes=-game.scene.lanes, target_lane=-game.scene.target_lane
    )
    return replace(game, scene=scene), state * np.float32([1, -1, -1, 1])


@pytest.mark.parametrize("name", MODELS)
def test_mirrored_scenes_give_mirrored_plans(played, name):
    game, state = played("merger", seed=3)
    straight = plan(MODELS[name], game, state)
    mirror = plan(MODELS[name], *mirrored(game, state))
    scale = np.array([-1.0, 1.0])
    np.testing.assert_allclose(mirror.robot, straight.robot * scale, atol=2e-3)
    np.testing.assert_allclose(mirror.humans, straight.humans * scale, atol=2e-3)


@jit_quickly
def derivatives(game, state, robot, human):
    """The slopes of the robot's reward in both sides of a plan.

    And how the slope of the human's reward changes in both.
    """
    own, seen = swap_players(game, state)

    def slope(robot, human):
        return jax.grad(total_reward, argnums=2)(own, seen, human, robot[None])

    slopes = jax.grad(total_reward, argnums=(2, 3))(game, state, robot, human[None])
    return slopes, jax.jacfwd(slope, argnums=(0, 1))(robot, human)


def test_theory_of_mind_steps_along_the_total_derivative(played):
    """The first step is 0.03 (dR_R/du_R + J^T dR_R/du_H), with J = -H^-1 d2R_H/du_H
    du_R formed explicitly.

    The eigenvalues of H are damped.
    """
    game, state = played("merger")
    still = np.zeros((5, 2), np.float32)
    (slope_robot, slope_human), bends = derivatives(game, state, still, still)
    mixed, own = (np.asarray(bend, dtype=float).reshape(10, 10) for bend in bends)
    values, vectors = np.linalg.eigh(own)
    damped = (vectors * np.maximum(np.abs(values), 1.0)) @ vectors.T
    jacobian = np.linalg.solve(damped, mixed)
    expected = slope_robot + (jacobian.T @ np.ravel(slope_human)).reshape(5, 2)
    assert abs(expected - slope_robot).max() > 1e-3, "the influence should matter here"
    once = replace(game, planner=replace(game.planner, solver=Ascent(iterations=1)))
    np.testing.assert_allclose(
        plan(TheoryOfMind(), once, state).robot, 0.03 * expected, rtol=1e-2, atol=1e-4
    )


def test_theory_of_mind_but_not_naive_makes_the_human_yield(played):
    """In plans for Merger, the human brakes for a robot that counts on it, and the
    robot steers in.
    """
    game, state = played("merger")
    naive = plan(MODELS["naive"], game, state)
    tom = plan(MODELS["tom"], game, state)
    assert tom.humans[0, :, 1].mean() < naive.humans[0, :, 1].mean()
    assert tom.robot[0, 0] < naive.robot[0, 0] < 0  # to the left, and more so


def test_a_prediction_that_limits_cut_gives_a_warning(
    played,
):
    game, state = played("merger")
    humans = plan(Brakes(50.0), game, state).humans
    acceleration = humans[..., 1] * game.planner.control_scale[1]
    friction = 0.2 * state[1, 3]
    np.testing.assert_allclose(acceleration, friction - 50.0, rtol=1e-5)

    limited, _ = played("merger", control_limit=(0.2, 8.0))
    with pytest.warns(
        UserWarning,
        match=r"'brakes' predicts an acceleration of -46 m/s\^2.*limits.*to -8",
    ):
        CompiledPlans(limited, [Brakes(50.0)]).warm_up(checked_state(state))


@dataclass(frozen=True)
class Says(ms_highway.PredictedHuman):
    name = "says"
    what: object = None

    def predict(self, game, state, start=None):
        return self.what


@pytest.mark.parametrize(
    ("what", "told"),
    [(None, "None"), (((0.0, -4.0),) * 3, r"an array of shape \(3, 2\)")],
)
def test_an_invalid_prediction_is_refused_with_shape_and_units(played, what, told):
    game, state = played("merger")
    with pytest.raises(
        ValueError,
        match=(
            rf"model 'says' predicts {told}.*; predict numbers \(5, 2\): curvature"
            r" \[1/m"
        ),
    ):
        plan(Says(what), game, state)
