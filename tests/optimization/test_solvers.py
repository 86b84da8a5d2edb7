"""Solvers: derivatives, Newton steps, limits, and rewards that they reach."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.experiments.runner import episode, make_environment
from ms_highway.game.game import move, total_reward, trajectory_reward
from ms_highway.game.scenario import PHYSICAL_LIMIT
from ms_highway.optimization.second_derivatives import second_order_expansion
from ms_highway.optimization.solvers import Planner, optimize_controls
from ms_highway.planning.human_models import MODELS
from ms_highway.runtime.compilation import jit_quickly


@pytest.mark.parametrize("scenario", ["merger", pytest.param("stay_back", marks=pytest.mark.slow)])
def test_the_chain_rule_gives_the_hessian_of_the_whole_plan(played, scenario):
    game, state = played(scenario, seed=1)
    controls = jnp.asarray(np.random.default_rng(0).normal(0, 0.2, (2, 5, 2)), dtype=jnp.float32)
    human = move(game, state[1], controls[1])

    @jit_quickly
    def both(robot):
        expansion = second_order_expansion(
            partial(move, game, state[0]), lambda robot: trajectory_reward(game, state, robot, human), robot
        )
        objective = partial(total_reward, game, state, human=controls[1])
        return expansion, jax.grad(objective)(robot), jax.hessian(objective)(robot)

    expansion, gradient, hessian = both(controls[0])
    scale = abs(hessian).max()
    np.testing.assert_allclose(expansion.gradient, gradient.ravel(), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(expansion.hessian, hessian.reshape(10, 10), rtol=1e-3, atol=1e-5 * scale)


def test_newton_climbs_a_steep_hill_that_gradient_steps_overshoot():
    top = jnp.array([[0.5, -0.2], [0.1, 0.3]])
    steep = jnp.array([400.0, 1.0])

    def hill(path):
        return -jnp.sum(steep * (path[:2].T - top) ** 2)

    def path(controls):
        return jnp.concatenate([controls.T, jnp.zeros((3, len(controls)))])

    def free(controls):
        return 0.0 * jnp.sum(controls)

    unlimited = jnp.full(2, jnp.inf)
    reached = {
        solver: optimize_controls(
            Planner(jnp.ones(2), unlimited, solver=solver), path, hill, free, jnp.zeros((2, 2)), lambda u: u
        )
        for solver in ("gradient", "newton")
    }
    assert not abs(reached["gradient"]).max() < 10  # it has left the hill
    np.testing.assert_allclose(reached["newton"][:, 0], top[:, 0], atol=1e-4)
    assert hill(path(reached["newton"])) > -0.02


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("solver", ["gradient", "newton"])
def test_no_plan_leaves_its_limits_or_the_finite_numbers_from_wild_starts(played, name, solver):
    """Overlapping cars, reversing cars, cars across the road: a batch of states far outside the scenario's noise."""
    limit = np.array([0.2, 30.0])
    game, state = played("merger", control_limit=tuple(limit), solver=solver)
    random = np.random.default_rng(0)
    wild = np.asarray(state) + random.normal(0, [10, 4, 0.6, 10], (32, *state.shape))
    wild[::4, 0] = wild[::4, 1]  # the robot within the human
    plans = jit_quickly(jax.vmap(partial(MODELS[name].plan, game)))(jnp.asarray(wild, dtype=jnp.float32))
    for controls in plans:
        assert np.isfinite(controls).all()
    assert (abs(plans.robot * game.planner.control_scale) <= limit * 1.0001).all()


@pytest.mark.slow
def test_newton_passes_the_cones_of_stay_back_where_gradient_steps_collide():
    """Seeds 39 and 94 are those of the first hundred in which gradient steps collide."""
    seeds = (0, 39, 94)
    collisions, rewards = {}, {}
    for solver in ("gradient", "newton"):
        env = make_environment("stay_back", "turn", solver=solver, human_reward="published")
        steps = [[(step["collision"], step["reward"]) for step in episode(env, seed)] for seed in seeds]
        collisions[solver], rewards[solver] = np.moveaxis(np.array(steps, dtype=float), -1, 0)
    assert collisions["gradient"].any()
    assert not collisions["newton"].any()
    assert rewards["newton"].mean() > max(2.6, rewards["gradient"].mean())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["naive", "tom"])
def test_plans_within_the_grip_keep_to_the_friction_circle_and_do_not_reverse(played, name):
    game, state = played("merger", control_limit=PHYSICAL_LIMIT)
    tyres = replace(game, planner=replace(game.planner, grip=np.float32(8.0)))
    state = np.asarray(state) * [1, 1, 1, 0.05] + [0, 0, 0.3, 0]  # slow, and across the road
    free, held = (MODELS[name].plan(each, jnp.asarray(state, dtype=jnp.float32)) for each in (game, tyres))
    for car, plan in enumerate(held if name == "tom" else held[:1]):
        controls = np.asarray(plan) * np.asarray(game.planner.control_scale)
        speed = [state[car, 3]]
        for _, acceleration in controls:
            speed.append(speed[-1] + 0.1 * (acceleration - 0.2 * speed[-1]))
        assert np.hypot(np.square(speed[:-1]) * controls[:, 0], np.diff(speed) / 0.1).max() <= 8.1
        assert min(speed) > -1e-3
    assert abs(np.asarray(free.robot) * np.asarray(game.planner.control_scale))[:, 1].max() > 8.1
