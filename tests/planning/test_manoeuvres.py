"""Manoeuvres into gaps, and starts of plans for seconds."""

import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.dynamics import coast
from ms_highway.game.game import constant_velocity, discomfort, move, move_all
from ms_highway.game.scenario import build_game
from ms_highway.game.scenarios import DENSE_MERGE
from ms_highway.planning.manoeuvres import into_gaps
from ms_highway.planning.plans import RESTART_MARGIN, best_start, cold_start
from ms_highway.runtime.compilation import jit_quickly

SPEED = 20.0  # m/s


@pytest.fixture(scope="module")
def game():
    return build_game(DENSE_MERGE, control_limit=DENSE_MERGE.control_limit, grip=DENSE_MERGE.grip, humans=2)


def traffic(game, offsets, pace=SPEED):
    """The robot in its lane, far before the cones, and humans in the target lane, so far ahead of it [m]."""
    robot, target = np.array([[-60.0, 0.0, 0.0, SPEED]]), float(game.scene.target_lane)
    humans = np.array([[offset - 60.0, target, 0.0, pace] for offset in offsets])
    return jnp.asarray(np.concatenate([robot, humans]), jnp.float32)


@pytest.fixture(scope="module")
def ways(game):
    return jit_quickly(lambda state: into_gaps(game, state[0], coast(game.dynamics, state[1:], 60)))


@pytest.fixture(scope="module")
def start(game):
    return jit_quickly(lambda state, last, humans: best_start(game, state[0], last, move_all(game, state[1:], humans)))


def test_a_car_ends_in_the_gap_ahead_of_each_car_and_behind_the_last_of_each_lane(game, ways):
    state = traffic(game, [-14.0, 2.0], pace=21.0)
    _, states = ways(state)
    last, first = np.asarray(coast(game.dynamics, state[1:], 60).x[:, -1])
    target = float(game.scene.target_lane)
    ahead_of_last, ahead_of_all, behind_all, own_lane = np.asarray(states[:, -1])
    for end in (ahead_of_last, ahead_of_all, behind_all):
        assert end[1] == pytest.approx(target, abs=0.1)
        assert end[3] == pytest.approx(21.0, abs=1.0)
    assert last + 5.0 < ahead_of_last[0] < first - 5.0
    assert ahead_of_all[0] > first + 5.0
    assert behind_all[0] < last - 5.0
    np.testing.assert_allclose(own_lane[[1, 3]], [0.0, SPEED], atol=0.01)  # where nobody drives


def earned(game, state, robot):
    """What the robot's plan earns where others keep their velocity."""
    others = move_all(game, state[1:], constant_velocity(game, state[1:]))
    return game.payoff.total(move(game, state[0], robot), others) - discomfort(game, state[0], robot)


def test_a_plan_that_is_good_enough_is_kept_and_one_that_collides_is_replaced(game, start):
    state = traffic(game, [-30.0, 30.0])
    kept = cold_start(game, state).robot
    humans = constant_velocity(game, state[1:])

    first = start(state, kept, humans)
    assert earned(game, state, first) > earned(game, state, kept) + RESTART_MARGIN  # it changes lanes
    np.testing.assert_array_equal(start(state, first, humans), first)

    blocked = state.at[1].set(jnp.array([-30.0, 0.0, 0.0, 5.0]))
    assert earned(game, blocked, kept) < -100
    other = start(blocked, kept, constant_velocity(game, blocked[1:]))
    assert earned(game, blocked, other) > 0


def test_a_manoeuvre_replaces_a_plan_that_is_not_finite_and_without_a_finite_one_there_is_no_plan(game, start):
    state = traffic(game, [-30.0, 30.0])
    lost = jnp.full((20, 2), jnp.nan)
    assert np.isfinite(start(state, lost, constant_velocity(game, state[1:]))).all()
    assert np.isnan(start(state, lost, jnp.full((2, 20, 2), jnp.nan))).all()


def test_a_car_that_stands_before_an_obstacle_leaves_its_lane_once_the_other_is_free(game, start):
    """At standstill, steering costs no comfort: a curve without speed is none."""
    unit = float(game.scene.length_unit)
    before = float(game.scene.obstacles[:, 0].min()) - 8.0
    humans = [[before + 5 * unit, float(game.scene.target_lane), 0.0, SPEED]] * 2
    state = jnp.asarray([[before, 0.0, 0.0, 0.0], *humans], jnp.float32)
    left = start(state, cold_start(game, state).robot, constant_velocity(game, state[1:]))
    path = np.asarray(move(game, state[0], left))
    assert path[1, -1] < float(game.scene.target_lane) / 2
    assert path[4, -1] > 5.0


def test_a_car_stays_in_its_lane_until_its_place_in_a_narrow_gap_is_beside_it(game, ways):
    _, states = ways(traffic(game, [-17.0, -6.0]))
    into = np.asarray(states[0])
    middle = SPEED * 0.1 * np.arange(1, 61) - 60.0 - 11.5
    beside = int(np.argmax(np.abs(into[:, 0] - middle) < 2.5))
    assert beside > 5
    assert np.abs(into[:beside, 1]).max() < 0.1
    assert into[-1, 1] == pytest.approx(float(game.scene.target_lane), abs=0.1)
