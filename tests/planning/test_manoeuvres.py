"""Manoeuvres into gaps, and starts of plans whose horizon is several seconds long."""

import numpy as np
import pytest
from driving import dense_merge

from ms_highway.game.dynamics import coast
from ms_highway.game.game import constant_velocity, discomfort, move, move_all
from ms_highway.planning.manoeuvres import into_gaps
from ms_highway.planning.plans import RESTART, best_start, cold_start
from ms_highway.runtime.compilation import jit_quickly

SPEED = 20.0  # m/s
GAME = dense_merge(2)
TARGET = float(GAME.scene.target_lane)


def traffic(*offsets, pace=SPEED):
    """The robot in its lane, far before the cones, and humans in the target lane, so
    far ahead of it [m].
    """
    robot = [-60.0, 0.0, 0.0, SPEED]
    humans = [[offset - 60.0, TARGET, 0.0, pace] for offset in offsets]
    return np.float32([robot, *humans])


@jit_quickly
def ways(state):
    """Six seconds of the ways into gaps."""
    others = coast(GAME.dynamics, state[1:], 60)
    return into_gaps(GAME, state[0], others).states


@jit_quickly
def start(state, usual, humans):
    others = move_all(GAME, state[1:], humans)
    return best_start(GAME, state[0], usual, others)


@jit_quickly
def earned(state, robot):
    """What the robot's plan earns where others keep their velocity."""
    steady = constant_velocity(GAME, state[1:])
    others = move_all(GAME, state[1:], steady)
    path = move(GAME, state[0], robot)
    reward = GAME.payoff.total(path, others)
    return reward - discomfort(GAME, state[0], robot)


def test_a_car_ends_in_the_gap_that_it_drives_into():
    """There is a gap ahead of each car, and one behind the last of each lane."""
    state = traffic(-14.0, 2.0, pace=21.0)
    last, first = state[1:, 0] + 6.0 * 21.0
    ends = np.asarray(ways(state))[:, -1]  # [gaps, 4]
    x, y, _, speed = ends.T
    assert abs(y[:3] - TARGET).max() < 0.1
    assert abs(speed[:3] - 21.0).max() < 1.0
    ahead_of_last, ahead_of_all, behind_all, _ = x
    assert last + 5.0 < ahead_of_last < first - 5.0
    assert ahead_of_all > first + 5.0
    assert behind_all < last - 5.0
    # In the own lane, nobody drives.
    np.testing.assert_allclose([y[3], speed[3]], [0.0, SPEED], atol=0.01)


def test_a_plan_starts_from_a_manoeuvre_that_is_much_better():
    """One that is good enough is kept; one that collides or is not finite is not."""
    state = traffic(-30.0, 30.0)
    kept, humans = cold_start(GAME, state)
    first = start(state, kept, humans)  # it changes lanes
    assert earned(state, first) > earned(state, kept) + RESTART.margin
    np.testing.assert_array_equal(start(state, first, humans), first)

    blocked = state.copy()
    blocked[1] = [-30.0, 0.0, 0.0, 5.0]
    assert earned(blocked, kept) < -100
    freed = start(blocked, kept, constant_velocity(GAME, blocked[1:]))
    assert earned(blocked, freed) > 0

    lost = np.full_like(kept, np.nan)
    lost_humans = np.full_like(humans, np.nan)
    assert np.isfinite(start(state, lost, humans)).all()
    assert np.isnan(start(state, lost, lost_humans)).all()


def test_a_standing_car_leaves_its_lane_before_an_obstacle():
    """At standstill, steering costs no comfort: a curve without speed is none."""
    before = float(GAME.scene.obstacles[:, 0].min()) - 8.0
    gone = [before + 167.0, TARGET, 0.0, SPEED]
    state = np.float32([[before, 0.0, 0.0, 0.0], gone, gone])
    usual, humans = cold_start(GAME, state)
    begin = start(state, usual, humans)
    path = np.asarray(move(GAME, state[0], begin))
    assert path[1, -1] < TARGET / 2
    assert path[4, -1] > 5.0


def test_a_car_stays_in_its_lane_until_beside_the_gap():
    state = traffic(-17.0, -6.0)
    into = np.asarray(ways(state))[0]
    times = 0.1 * np.arange(1, 61)
    middle = SPEED * times - 60.0 - 11.5
    is_beside = abs(into[:, 0] - middle) < 2.5
    beside = int(np.argmax(is_beside))
    assert beside > 5
    assert abs(into[:beside, 1]).max() < 0.1
    assert into[-1, 1] == pytest.approx(TARGET, abs=0.1)
