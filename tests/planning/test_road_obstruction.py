"""What lies in the robot's lane and cannot move, and plans that go round it."""

from dataclasses import replace

import numpy as np
import pytest
from roads import PLANNING, WEIGHTS, coming, scene_of, wrecked

from ms_highway.control.road import plan_of
from ms_highway.game.road import KNOTS, LANES, TRAFFIC
from ms_highway.planning.road.obstruction import obstruction_of
from ms_highway.planning.road.plan import no_plan
from ms_highway.runtime.compilation import jit_quickly

ACROSS = np.pi / 2
seen = jit_quickly(lambda scene: obstruction_of(scene, WEIGHTS))


def country_road(*cars, speed=8.0):
    """A road of one lane for each direction: nobody but who goes round something drives on the left."""
    scene = scene_of(robot=(0.0, 0.0, 0.0, speed), cars=cars, limit=10.0)
    paved = np.tile(np.array([[-6.0], [2.0]], np.float32), KNOTS)
    is_open = np.zeros((LANES, KNOTS), bool)
    is_open[1] = True
    return replace(scene, open=is_open, edges=np.clip(paved, -2.0, 2.0), paved=paved)


def planned(scene):
    planning = replace(PLANNING, desired_speed=10.0)
    return plan_of(scene, planning, WEIGHTS, np.zeros(TRAFFIC, np.int32), no_plan(PLANNING))


@pytest.mark.parametrize(
    ("lanes", "heading", "sides", "ends"),
    [
        ([0], 0.0, (-3.0, 3.0), (22.5, 27.5)),
        ([0], ACROSS, (-4.5, 4.5), (24.0, 26.0)),
        ([0, 1], 0.0, (-3.0, 7.0), (22.5, 27.5)),
        ([0, -1], ACROSS, (-8.5, 4.5), (24.0, 26.0)),
    ],
)
def test_what_lies_in_the_lane_is_passed_a_metre_away_and_so_is_what_leaves_no_room_beside_it(
    lanes, heading, sides, ends
):
    scene = scene_of(cars=[(25.0, lane, 0.0) for lane in lanes])
    for car in range(len(lanes)):
        wrecked(scene, car, heading)
    found = seen(scene)
    assert found.exists
    np.testing.assert_allclose(found.sides, sides, atol=1e-3)
    np.testing.assert_allclose([found.begin, found.end], ends, atol=1e-3)


@pytest.mark.parametrize("place", [(25.0, 1), (-12.0, 0), (90.0, 0)])
def test_what_lies_beside_the_lane_behind_or_far_ahead_is_no_obstruction(place):
    assert not seen(wrecked(scene_of(cars=[(*place, 0.0)]), 0)).exists


def test_a_car_that_stands_and_may_drive_on_is_no_obstruction():
    assert not seen(scene_of(cars=[(25.0, 0, 0.0)])).exists


def test_a_plan_goes_round_a_wreck_over_the_lane_of_those_who_come_where_nobody_comes():
    plan = planned(wrecked(country_road((26.0, 0, 0.0)), 0))
    x, y = np.asarray(plan.path)[:, :2].T
    assert y.min() < -2.0
    assert not plan.broken
    assert x[-1] > 20.0


def test_a_plan_waits_behind_a_wreck_while_somebody_comes_and_leaves_room_to_go_round_it():
    plan = planned(coming(wrecked(country_road((26.0, 0, 0.0), (48.0, -1, 8.0)), 0), 1))
    x, y = np.asarray(plan.path)[:, :2].T
    assert abs(y).max() < 1.0
    assert not plan.broken
    assert x[-1] + 2.5 < 26.0 - 2.5 - 4.0


def test_a_plan_does_not_leave_its_road_for_a_queue_that_will_drive_on():
    plan = planned(country_road((20.0, 0, 0.0)))
    assert abs(np.asarray(plan.path)[:, 1]).max() < 0.5
