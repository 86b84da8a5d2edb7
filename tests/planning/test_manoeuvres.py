"""Manoeuvres into gaps, and starts of plans for seconds."""

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
    humans = ([offset - 60.0, TARGET, 0.0, pace] for offset in offsets)
    return np.float32([[-60.0, 0.0, 0.0, SPEED], *humans])


@jit_quickly
def ways(state):
    """Six seconds of the ways into gaps."""
    return into_gaps(GAME, state[0], coast(GAME.dynamics, state[1:], 60))[1]


@jit_quickly
def start(state, last, humans):
    return best_start(GAME, state[0], last, move_all(GAME, state[1:], humans))


@jit_quickly
def earned(state, robot):
    """What the robot's plan earns where others keep their velocity."""
    others = move_all(GAME, state[1:], constant_velocity(GAME, state[1:]))
    return GAME.payoff.total(move(GAME, state[0], robot), others) - discomfort(
        GAME, state[0], robot
    )


def test_a_car_ends_in_the_gap_ahead_of_each_car_and_behind_the_last_of_each_lane():
    state = traffic(-14.0, 2.0, pace=21.0)
    last, first = state[1:, 0] + 6.0 * 21.0
    x, y, _, speed = np.asarray(ways(state))[:, -1].T
    assert abs(y[:3] - TARGET).max() < 0.1
    assert abs(speed[:3] - 21.0).max() < 1.0
    ahead_of_last, ahead_of_all, behind_all, _ = x
    assert last + 5.0 < ahead_of_last < first - 5.0
    assert ahead_of_all > first + 5.0
    assert behind_all < last - 5.0
    np.testing.assert_allclose(
        [y[3], speed[3]], [0.0, SPEED], atol=0.01
    )  # in the own lane, where nobody drives


def test_a_plan_that_is_good_enough_is_kept_and_one_that_collides_or_is_not_finite_is_replaced():
    state = traffic(-30.0, 30.0)
    kept, humans = cold_start(GAME, state)
    first = start(state, kept, humans)
    assert (
        earned(state, first) > earned(state, kept) + RESTART.margin
    )  # it changes lanes
    np.testing.assert_array_equal(start(state, first, humans), first)

    blocked = state.copy()
    blocked[1] = [-30.0, 0.0, 0.0, 5.0]
    assert earned(blocked, kept) < -100
    assert (
        earned(blocked, start(blocked, kept, constant_velocity(GAME, blocked[1:]))) > 0
    )

    lost = np.full_like(kept, np.nan)
    assert np.isfinite(start(state, lost, humans)).all()
    assert np.isnan(start(state, lost, np.full_like(humans, np.nan))).all()


def test_a_car_that_stands_before_an_obstacle_leaves_its_lane_once_the_other_is_free():
    """At standstill, steering costs no comfort: a curve without speed is none."""
    before = float(GAME.scene.obstacles[:, 0].min()) - 8.0
    state = np.float32(
        [[before, 0.0, 0.0, 0.0], *[[before + 167.0, TARGET, 0.0, SPEED]] * 2]
    )
    path = np.asarray(move(GAME, state[0], start(state, *cold_start(GAME, state))))
    assert path[1, -1] < TARGET / 2
    assert path[4, -1] > 5.0


def test_a_car_stays_in_its_lane_until_its_place_in_a_narrow_gap_is_beside_it():
    into = np.asarray(ways(traffic(-17.0, -6.0)))[0]
    middle = SPEED * 0.1 * np.arange(1, 61) - 60.0 - 11.5
    beside = int(np.argmax(abs(into[:, 0] - middle) < 2.5))
    assert beside > 5
    assert abs(into[:beside, 1]).max() < 0.1
    assert into[-1, 1] == pytest.approx(TARGET, abs=0.1)
