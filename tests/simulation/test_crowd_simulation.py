"""Crowds in batches: the same on any devices, and what a plain loop of the same functions does."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from ms_highway.game.crowd_scenario import DENSE_MERGE, crowd_game, draw_crowd
from ms_highway.planning.crowd import NAIVE, TOM, TURN, CrowdPlan, plan_crowd, predict_human
from ms_highway.simulation.crowd import CrowdEpisodes, CrowdLoop, simulate_crowd

from ms_highway.control.fallback import BRAKING, PLANNED
from ms_highway.game.dynamics import step, within_grip
from ms_highway.game.features import features
from ms_highway.game.game import constant_velocity
from ms_highway.game.planning_settings import PlanningSettings
from ms_highway.simulation.devices import use_devices

HUMANS, STEPS = 2, 4
CROWD = crowd_game(DENSE_MERGE, HUMANS, planning=PlanningSettings(horizon=5))
LOOP = CrowdLoop(CROWD, way_out=False)  # which tests of ways out are about


def drawn(count, schedule):
    random = np.random.default_rng(3)
    starts, weights = zip(
        *(draw_crowd(DENSE_MERGE, HUMANS, random, CROWD.game.human) for _ in range(count)), strict=True
    )
    schedules = np.broadcast_to(np.asarray(schedule, np.int32), (count, STEPS, HUMANS))
    return CrowdEpisodes(np.array(starts), np.array(weights), np.arange(count), schedules)


@pytest.fixture(scope="module")
def episodes():
    return drawn(3, [[NAIVE, NAIVE], [TOM, TURN], [TOM, TOM], [TURN, NAIVE]])


@pytest.fixture(scope="module")
def records(episodes):
    return simulate_crowd(LOOP, episodes)


def same(one, other):
    return all(np.array_equal(first, second, equal_nan=True) for first, second in zip(one, other, strict=True))


def test_records_have_a_row_for_every_step_and_follow_the_schedule(episodes, records):
    assert records.states.shape == (3, STEPS, 1 + HUMANS, 4)
    assert (records.rungs == episodes.schedules).all()
    assert (records.status == PLANNED).all()
    assert not records.collision.any()
    assert np.isnan(records.gains).all()


def test_a_batch_gives_the_same_again_alone_and_on_any_number_of_devices(episodes, records):
    assert same(simulate_crowd(LOOP, episodes, use_devices()), records)
    last = jax.tree.map(lambda part: part[2:], episodes)
    assert same(simulate_crowd(LOOP, last), [part[2:] for part in records])


def test_a_batch_agrees_with_a_plain_loop_of_the_same_functions(episodes, records):
    game = CROWD.game
    plan, predict = jax.jit(plan_crowd), jax.jit(predict_human)
    truth, state = replace(CROWD, weights=episodes.weights[1]), jnp.asarray(episodes.starts[1], jnp.float32)
    kept = jax.vmap(partial(constant_velocity, game))(state)
    start = CrowdPlan(kept[0], kept[1:])
    for number in range(STEPS):
        planned = plan(CROWD, state, jnp.asarray(episodes.schedules[1, number]), start)
        start = jax.tree.map(lambda part: jnp.concatenate([part[..., 1:, :], part[..., -1:, :]], axis=-2), planned)
        controls = jnp.stack([planned.robot[0], *(predict(truth, state, human)[0] for human in range(HUMANS))])
        scaled = controls * game.planner.control_scale
        state = step(game.world, state, within_grip(game.world, jnp.float32(game.planner.grip), state[:, 3], scaled))
        earned = features(game.scene, game.robot, state) @ game.robot.weights
        np.testing.assert_allclose(records.states[1, number], state, rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(records.reward[1, number], earned, rtol=1e-3, atol=1e-3)


def test_humans_drive_by_their_own_rewards_and_not_by_those_that_the_robot_believes(episodes, records):
    careless = np.array(episodes.weights)
    careless[:, :, CROWD.game.human.names.index("collision_risk")] *= 0.01
    other = simulate_crowd(LOOP, replace(episodes, weights=careless))
    assert np.abs(other.states[:, -1, 1:] - records.states[:, -1, 1:]).max() > 1e-3


def test_a_robot_without_a_finite_plan_brakes_and_the_humans_drive_on(episodes):
    game = CROWD.game
    blind = replace(game, robot=replace(game.robot, weights=np.full_like(game.robot.weights, np.nan)))
    records = simulate_crowd(replace(LOOP, crowd=replace(CROWD, game=blind)), episodes)
    assert (records.status == BRAKING).all()
    assert (np.diff(records.states[:, :, 0, 3], axis=1) < 0).all()
    assert np.isfinite(records.states[:, :, 0]).all()


def test_collisions_of_humans_with_each_other_are_told_apart_from_the_robots():
    episodes = drawn(1, NAIVE)
    starts = np.array(episodes.starts)
    starts[:, 2, :2] = starts[:, 1, :2] - [2.0, 0.0]
    starts[:, 1:, 0] += 60.0
    records = simulate_crowd(LOOP, replace(episodes, starts=starts))
    assert records.humans_collision[0, 0]
    assert not records.collision.any()


def test_a_batch_without_an_episode_is_refused():
    with pytest.raises(ValueError, match="no episodes"):
        simulate_crowd(LOOP, drawn(3, NAIVE).__class__(*(np.zeros((0, 1)),) * 4))
