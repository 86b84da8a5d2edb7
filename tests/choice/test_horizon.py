"""Gains over the whole horizon."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.choice.quadratic import Switching, WholeHorizon, expand
from ms_highway.choice.rule import Outcome, decide, first_memory
from ms_highway.game.dynamics import keep_velocity, step
from ms_highway.game.features import reward
from ms_highway.game.game import swap_players, total_reward
from ms_highway.numerics.second_derivatives import response
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import ladder
from ms_highway.planning.plans import Plan
from ms_highway.runtime.compilation import jit_quickly

decide_quickly = jit_quickly(decide)


def made(kind, price=0.1, **numbers):
    rungs = ladder(("naive", "turn", "tom"))
    return jax.tree.map(jnp.asarray, kind(Costs(0.0, np.array([0.09, 0.17, 0.37])), price, rungs, **numbers))


def on(rule, rung=0):
    memory = first_memory(rule, 1)
    return memory._replace(rungs=memory.rungs + rung, step=np.ones((), np.int32))


def outcome(game, state, plan):
    """Of a step in which both follow a plan."""
    controls = jnp.stack([plan.robot[0], plan.humans[0, 0]]) * game.planner.control_scale
    after = step(game.dynamics, state, jnp.concatenate([controls, keep_velocity(game.dynamics, state[2:])]))
    return Outcome(state, after, plan.robot[0], plan.humans[:, 0], reward(game.scene, game.robot, after), plan)


def any_plan(steps, seed=0):
    drawn = np.random.default_rng(seed).normal(0, 0.2, (2, steps, 2))
    robot, human = jnp.asarray(drawn, dtype=jnp.float32)
    return Plan(robot, human[None])


def shortened(game):
    return replace(game, planner=replace(game.planner, horizon=1))


@pytest.mark.parametrize("influence", ["damped", pytest.param("exact", marks=pytest.mark.slow)])
def test_the_expansion_is_that_of_the_rewards_of_the_whole_plan(played, influence):
    game, state = played("merger", seed=2)
    game = replace(game, influence=influence)
    both = jnp.concatenate([part.ravel() for part in any_plan(5)])

    def robot_reward(both):
        return total_reward(game, state, both[:10].reshape(5, 2), both[10:].reshape(1, 5, 2))

    def human_reward(both):
        mirrored = both[10:].reshape(5, 2), both[:10].reshape(1, 5, 2)
        return total_reward(*swap_players(game, state), *mirrored)

    def derivatives(both):
        return jax.grad(robot_reward)(both), jax.hessian(robot_reward)(both), jax.hessian(human_reward)(both)

    expansion = jit_quickly(expand)(game, state, both[:10], both[10:])
    slope, bend, humans = (np.asarray(array) for array in jit_quickly(derivatives)(both))
    mixed = np.asarray(expansion.robot_human)
    found = np.block([[np.asarray(expansion.robot_robot), mixed], [mixed.T, np.asarray(expansion.human_human)]])
    np.testing.assert_allclose(found, bend, rtol=1e-3, atol=1e-4 * abs(bend).max())
    found = np.concatenate([expansion.robot, expansion.human])
    np.testing.assert_allclose(found, slope, rtol=1e-3, atol=1e-4 * abs(slope).max())
    human_bend = humans[10:, 10:] - np.diag(np.tile(np.asarray(game.humans.comfort), 5))
    expected = response(influence, jnp.asarray(human_bend), jnp.asarray(humans[10:, :10]))
    np.testing.assert_allclose(expansion.influence, expected, rtol=1e-2, atol=1e-3 * abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("rung", [0, 1, 2])
def test_over_a_horizon_of_one_step_the_gains_are_those_of_algorithm_1(played, rung):
    game, state = played("merger", seed=3)
    near, whole = made(Switching), made(WholeHorizon)
    for seed in range(5):
        seen = outcome(game, state, any_plan(1, seed))
        expected = decide_quickly(near, shortened(game), on(near, rung), seen)
        found = decide_quickly(whole, shortened(game), on(whole, rung), seen)
        assert np.isfinite(np.asarray(expected.gains)).any()
        np.testing.assert_allclose(found.gains, expected.gains, rtol=1e-3, atol=1e-3)
        jax.tree.map(np.testing.assert_array_equal, found.memory, expected.memory)


def test_a_gain_pays_for_a_plan_at_every_step_of_the_horizon(played):
    game, state = played("merger")
    seen = outcome(game, state, any_plan(5))
    rules = [made(WholeHorizon, price) for price in (0.0, 2.0)]
    free, priced = (decide_quickly(rule, game, on(rule), seen) for rule in rules)
    assert free.gains[0, 2] - priced.gains[0, 2] == pytest.approx(5 * 2.0 * (0.37 - 0.09), rel=1e-3)
