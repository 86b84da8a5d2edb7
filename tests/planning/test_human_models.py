"""Plans under the ladder of human models."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.game import constant_velocity, swap_players, total_reward
from ms_highway.game.reward import PAPER_FEATURES
from ms_highway.optimization.second_derivatives import response
from ms_highway.optimization.solvers import Planner, projected_ascent
from ms_highway.planning.compiled_plans import CompiledPlans, checked_state
from ms_highway.planning.human_models import MODELS, TheoryOfMind, Turn, ladder
from ms_highway.planning.plans import Plan, plan_against
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


@pytest.mark.parametrize("name", MODELS)
def test_a_plan_earns_more_than_doing_nothing(scenario, played, name):
    if (name == "tom" and scenario == "stay_back") or scenario in ("dense_merge", "crossing_crowd"):
        pytest.skip("the ladder in Stay Back ends at turn; plans of several humans start from keeping the velocity")
    game, state = played(scenario)
    joint = plan(MODELS[name], game, state)
    assert total_reward(game, state, *joint) > total_reward(game, state, jnp.zeros((5, 2)), joint.humans)


def test_naive_expects_the_human_to_keep_its_velocity(played):
    game, state = played("merger")
    joint = plan(MODELS["naive"], game, state)
    np.testing.assert_allclose(joint.humans[0], constant_velocity(game, state[1]), rtol=1e-6)
    assert float(joint.humans[0, 0, 1]) == pytest.approx(0.2 * float(state[1, 3]) * 3 / 100, rel=1e-5)


def test_turn_expects_what_a_human_who_ignores_the_robot_would_plan(played):
    game, state = played("give_way")
    expected = plan(MODELS["naive"], *swap_players(game, state)).robot
    np.testing.assert_allclose(plan(Turn(), game, state).humans[0], expected, atol=1e-5)


slopes = jit_quickly(jax.grad(total_reward, argnums=(2, 3)))


def after_one_step(game):
    return replace(game, planner=replace(game.planner, iterations=1))


def test_theory_of_mind_without_influence_steps_like_turn(played):
    """Where the human's reward does not depend on the robot, ToM's step is Turn's against the same human controls."""
    game, state = played("merger")
    weights = jnp.asarray(game.humans.weights).at[:, PAPER_FEATURES.index("collision_risk")].set(0.0)
    game = after_one_step(replace(game, humans=replace(game.humans, weights=weights)))
    still = jnp.zeros((5, 2))  # where both start
    slope_robot, slope_human = slopes(game, state, still, still[None])
    assert abs(slope_human).max() > 1e-3, "the human should matter to the robot here"
    turn_step = plan_against(game, state, still[None]).robot
    np.testing.assert_allclose(plan(TheoryOfMind(), game, state).robot, turn_step, atol=1e-6)
    np.testing.assert_allclose(turn_step, 0.03 * slope_robot, atol=1e-6)


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


def test_the_exact_response_is_the_newton_step_and_the_damped_one_always_ascends():
    random = np.random.default_rng(0)
    for _ in range(20):
        hessian = random.normal(0, 3, (10, 10)).astype(np.float32)
        hessian = hessian + hessian.T
        push = random.normal(size=10).astype(np.float32)
        np.testing.assert_allclose(hessian @ response("exact", hessian, push), -push, atol=2e-2)
        damped = response("damped", hessian, push)
        assert damped @ push > 0
        assert np.linalg.norm(damped) <= np.linalg.norm(push) * 1.001


def test_damping_leaves_a_stiff_concave_human_as_it_is():
    hessian = -np.diag([2.0, 5.0, 1.0]).astype(np.float32)
    push = np.array([1.0, -2.0, 3.0], dtype=np.float32)
    np.testing.assert_allclose(response("damped", hessian, push), response("exact", hessian, push), rtol=1e-5)


def test_controls_stay_within_their_limits(played):
    limit = (0.02, 2.0)
    game, state = played("stay_back", control_limit=limit)
    joint = plan(Turn(), game, state.at[:, 0].add(15.0))
    physical = np.abs(joint.robot * game.planner.control_scale)
    assert (physical <= np.array(limit) * 1.0001).all()
    assert (physical >= np.array(limit) * 0.9999).any(), "the limit should bind in this situation"


def test_ascent_climbs_a_concave_hill_to_its_top():
    planner = Planner(jnp.ones(2), jnp.full(2, jnp.inf), step_size=0.4, iterations=60)
    top = jnp.array([[1.0, -2.0], [3.0, 0.5]])
    reached = projected_ascent(
        planner,
        lambda plan: Plan(top - plan.robot, top - plan.humans),
        Plan(jnp.zeros((2, 2)), jnp.zeros((2, 2))),
        lambda plan: plan,
    )
    np.testing.assert_allclose(reached.robot, top, atol=1e-4)


def test_plans_work_under_vmap(played):
    game, _ = played("stay_back")
    states = jnp.stack([played("stay_back", seed)[1] for seed in range(2)])
    together = jax.jit(jax.vmap(partial(Turn().plan, game)))(states)
    np.testing.assert_allclose(together.robot[1], plan(Turn(), game, states[1]).robot, atol=1e-3)


@pytest.mark.parametrize("names", [[], ["tom", "naive"], ["naive", "naive"], ["naive", "oracle"]])
def test_an_impossible_ladder_is_refused(names):
    with pytest.raises(ValueError, match=r"ladder|unknown human model 'oracle'"):
        ladder(names)
