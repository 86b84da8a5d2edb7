"""What follows plans on roads, and the room that they keep to cars ahead."""

from dataclasses import replace

import numpy as np
from roads import NOBODY, PLANNING, PLANS, coming, now_in, proposals_of, scene_of

from ms_highway.perception.scene import KNOTS, TRAFFIC
from ms_highway.road.constants import IDM
from ms_highway.road.plan import no_plan
from ms_highway.road.proposals import ALL
from ms_highway.road.terminal_value import missing_room, speed_lost
from ms_highway.runtime.compilation import jit_quickly

MEMORY = no_plan(PLANNING)
CLOSING_UP, KEEPING_SPEED = (
    [plan[:5] for plan in ALL].index((1, 1.0, 0.0, closes, closes)) for closes in (True, False)
)  # in the own lane

lost_after = jit_quickly(lambda now, rollouts: speed_lost(now, rollouts, PLANS.lane)[0])
room_missing = jit_quickly(missing_room)


def proposed(scene):
    return proposals_of(scene, PLANNING, np.full(TRAFFIC, IDM, np.int32), MEMORY)


def lost(scene):
    """Loss of speed after each proposal [m/s]."""
    return np.asarray(lost_after(now_in(scene), proposed(scene).driven))


def missing(scene):
    goals = np.float32([-4.0, 0.0, 4.0])[PLANS.lane]
    return np.asarray(room_missing(now_in(scene), proposed(scene).driven, goals))


def test_behind_a_wall_of_slow_cars_more_speed_is_lost_than_behind_a_single_one():
    wall = scene_of(robot=(0.0, 0.0, 0.0, 24.0), cars=[(80.0, lane, 18.0) for lane in (-1, 0, 1)])
    single = scene_of(robot=(0.0, 0.0, 0.0, 24.0), cars=[(80.0, 0, 18.0)])
    assert lost(wall)[CLOSING_UP] > lost(single)[CLOSING_UP] + 3.0


def test_who_comes_after_a_plan_is_in_the_way_and_then_has_passed_unlike_who_stands_there():
    narrow = np.repeat(np.float32([[-2.0], [2.0]]), KNOTS, axis=1)
    stands = replace(scene_of(robot=(0.0, 0.0, 0.0, 24.0), cars=[(204.0, 0, 0.0)]), edges=narrow, moving=NOBODY)
    comes = coming(replace(scene_of(robot=(0.0, 0.0, 0.0, 24.0), cars=[(300.0, 0, 24.0)]), edges=narrow), 0)
    assert 5.0 < lost(comes)[KEEPING_SPEED] < lost(stands)[KEEPING_SPEED] - 1.0


def test_a_car_that_joins_the_road_may_go_on_into_the_robots_lane():
    on_road = scene_of(robot=(0.0, 0.0, 0.0, 30.0), cars=[(65.0, 1, 18.0)])
    joining = replace(on_road, edges=on_road.edges - np.float32([[0.0], [4.0]]))
    assert missing(on_road)[KEEPING_SPEED, 0] == 0
    assert missing(joining)[KEEPING_SPEED, 0] > 0
