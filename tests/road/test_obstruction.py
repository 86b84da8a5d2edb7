"""Obstacles in the robot's lane, and plans that pass them."""

from dataclasses import replace

import numpy as np
import pytest
from roads import (
    ONE_LANE,
    PLANNING,
    WEIGHTS,
    coming,
    country_road,
    execute,
    scene_of,
    wrecked,
)

from ms_highway.perception.scene import TRAFFIC
from ms_highway.road.driver import plan_of
from ms_highway.road.plan import no_plan

SLOW = replace(PLANNING, desired_speed=10.0)


def planned(scene, last=None):
    return plan_of(scene, SLOW, WEIGHTS, np.zeros(TRAFFIC, np.int32), last or no_plan(PLANNING))


@pytest.mark.parametrize("side", [-1, 1])
def test_the_robot_passes_an_obstacle_in_a_bend_on_the_shorter_side_and_returns_to_its_lane(side):
    scene = wrecked(scene_of(bend=1 / 60, robot=(0.0, 0.0, 0.0, 8.0), cars=[(24.0, -0.5 * side, 0.0)], limit=10.0), 0)
    states, last = [], no_plan(PLANNING)
    for _ in range(30):
        plan = planned(replace(scene, open=ONE_LANE), last)
        assert not plan.broken
        states.append(scene.robot)
        moved, _ = execute(scene, SLOW, np.asarray(plan.controls)[:1])
        scene, last = replace(scene, robot=np.asarray(moved)[0]), plan.rest()
    s, d, *_ = np.array(states).T
    assert max(d, key=abs) == pytest.approx(side * 1.0, abs=0.2)
    assert s[-1] > 40.0
    assert abs(d[-1]) < 0.3


def test_a_plan_waits_behind_a_wreck_for_an_oncoming_car_and_leaves_room_to_turn_round_the_wreck():
    plan = planned(coming(wrecked(country_road((26.0, 0, 0.0), (48.0, -1, 8.0)), 0), 1))
    x, y = np.asarray(plan.path)[:, :2].T
    assert abs(y).max() < 1.0
    assert not plan.broken
    assert x[-1] + 2.5 < 26.0 - 2.5 - 4.0


def test_a_plan_does_not_leave_its_road_for_a_queue_that_will_drive_on():
    plan = planned(country_road((20.0, 0, 0.0)))
    assert abs(np.asarray(plan.path)[:, 1]).max() < 0.5
