"""What plans on roads earn, and which constraints they break."""

from dataclasses import replace

import numpy as np
import pytest
from roads import NOBODY, PLANNING, crossing, judged, now_in, on_path, scene_of, wrecked

from ms_highway.geometry.curve import BEHIND, SPACING
from ms_highway.perception.scene import TRAFFIC_KNOTS
from ms_highway.road.score import blocks
from ms_highway.runtime.compilation import jit_quickly

STEPS, OWN, RIGHT = PLANNING.steps, 1, 2
KEEPING, HARD = (0.0, 0.0), (0.0, -4.9)

in_the_way = jit_quickly(blocks)


def scores_of(scene, *plans, lanes=(OWN, OWN)):
    """Two plans of controls, constant or for each step."""
    controls = np.stack([np.broadcast_to(plan, (STEPS, 2)) for plan in plans])
    return judged(scene, controls, np.array(lanes), NOBODY)


def changing(curvature):
    """Controls that turn for 1.2 s and turn back."""
    return np.pad(np.repeat([[curvature, 0.0], [-curvature, 0.0]], 6, axis=0), ((0, STEPS - 12), (0, 0)))


def before(place):
    """A robot that is too close to a standing car, or not."""
    return scene_of(robot=(0.0, 0.0, 0.0, 12.0), cars=[(place, 0, 0.0)])


CLOSED, TWICE = scene_of(), [changing(0.004)] * 2
CLOSED.open[RIGHT] = False
CROSSED = replace(crossing(0.0, 12.0), robot=np.array([26.0, 0.0, 0.0, 8.0], np.float32))


@pytest.mark.parametrize(
    ("scene", "plans", "lanes", "broken"),
    [
        (scene_of(), (KEEPING, (0.01, 0.0)), (OWN, OWN), [False, True]),  # stays on the road
        (scene_of(), (KEEPING, (-0.01, 0.0)), (OWN, OWN), [False, True]),
        (CLOSED, TWICE, (OWN, RIGHT), [False, True]),  # changes to no closed lane
        (CROSSED, (HARD, KEEPING), (OWN, OWN), [False, True]),  # stops before who crosses
        (before(75.0), (HARD, KEEPING), (OWN, OWN), [False, True]),  # keeps room to stop
        (before(23.7), (HARD, KEEPING), (OWN, OWN), [True, True]),  # hits nobody
        (before(14.0), ((0.0, -1.0), KEEPING), (OWN, OWN), [True, True]),  # hits more softly
        (before(23.7), (HARD, (0.03, 0.0)), (OWN, OWN), [True, True]),  # comes close rather than to leave the road
        (before(22.5), (HARD, (0.03, 0.0)), (OWN, OWN), [True, True]),  # hits softly rather than to leave the road
    ],
)
def test_the_first_of_two_plans_is_preferred(scene, plans, lanes, broken):
    _, scores = scores_of(scene, *plans, lanes=lanes)
    assert scores.preference[0] > scores.preference[1] + 100
    np.testing.assert_array_equal(scores.broken, broken)


@pytest.mark.parametrize(
    ("lane", "controls", "goal", "collides"),
    [
        (0, KEEPING, OWN, False),  # runs into a robot that keeps its lane, which is its own affair
        (0, KEEPING, RIGHT, False),  # the same of a robot that waits to change lanes
        (1, KEEPING, OWN, False),
        (1, changing(0.008), RIGHT, True),
    ],
)
def test_of_cars_behind_only_those_count_that_the_robot_cuts_in_on(lane, controls, goal, collides):
    scene = scene_of(robot=(0.0, 0.0, 0.0, 15.0), cars=[(-15.0, lane, 25.0)])
    _, scores = scores_of(scene, controls, controls, lanes=(goal, OWN))
    assert scores.collides[0] == collides


@pytest.mark.parametrize(("place", "crashed", "close"), [(1.25, True, False), (1.5, True, True), (1.5, False, False)])
def test_what_has_crashed_is_passed_by_more_than_a_car_that_stands_and_may_drive_on(place, crashed, close):
    scene = scene_of(robot=(0.0, place, 0.0, 10.0), cars=[(20.0, 1, 0.0)])
    _, scores = scores_of(wrecked(scene, 0) if crashed else scene, KEEPING, KEEPING)
    assert scores.collides[0] == close


@pytest.mark.parametrize(
    ("s", "come_from", "speed", "expected"),
    [
        (38.5, 75.0, 10.0, True),
        (20.0, 55.0, 10.0, False),  # waits
        (50.0, 75.0, 10.0, False),  # has passed
        (36.0, -20.0, 10.0, False),  # the car has passed
        (36.0, 60.0, 0.0, False),  # stands
    ],
)
def test_a_robot_that_stands_where_a_car_comes_is_in_its_way_and_no_other(s, come_from, speed, expected):
    scene = crossing(s, come_from, speed)
    rollouts, _ = scores_of(scene, KEEPING, KEEPING)
    assert bool(in_the_way(now_in(scene), rollouts)[0, 0]) == expected


@pytest.mark.parametrize(("joins_at", "crosses"), [(10.0, False), (50.0, True)])
def test_who_joins_the_route_behind_the_robot_and_turns_off_ahead_of_it_does_not_cross_it(joins_at, crosses):
    scene = scene_of(robot=(30.0, 0.0, 0.0, 8.0), cars=[(0.0, 0, 8.0)])
    along = SPACING * np.arange(TRAFFIC_KNOTS) - BEHIND
    aside = np.where(along < joins_at, -5.0, 0.0) - np.maximum(along - 60.0, 0.0)
    path = along, aside, np.where(along > 60.0, -np.pi / 4, 0.0), 0 * along
    assert now_in(on_path(scene, *path)).crossings.exist[0] == crosses
