"""Plans under the ladder of human models."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.game import swap_players, total_reward
from ms_highway.numerics.second_derivatives import response
from ms_highway.planning.compiled_plans import CompiledPlans, checked_state
from ms_highway.planning.human_models import MODELS, TheoryOfMind
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
    """In Merger the human brakes for a robot that counts on it, and the robot steers in; seen in the plans."""
    game, state = played("merger")
    naive, tom = plan(MODELS["naive"], game, state), plan(MODELS["tom"], game, state)
    assert tom.humans[0, :, 1].mean() < naive.humans[0, :, 1].mean()
    assert tom.robot[0, 0] < naive.robot[0, 0] < 0  # to the left, and more so


def test_the_damped_response_always_ascends():
    random = np.random.default_rng(0)
    for _ in range(20):
        hessian = random.normal(0, 3, (10, 10)).astype(np.float32)
        hessian = hessian + hessian.T
        push = random.normal(size=10).astype(np.float32)
        damped = response("damped", hessian, push)
        assert damped @ push > 0
        assert np.linalg.norm(damped) <= np.linalg.norm(push) * 1.001
