"""What plans on roads earn, and which constraints they break."""

import numpy as np
import pytest
from roads import PLANNING, crossing, judged, scene_of

STEPS, OWN, RIGHT = PLANNING.steps, 1, 2
KEEPING, HARD = (0.0, 0.0), (0.0, -4.9)


def scores_of(scene, *plans, lanes=(OWN, OWN)):
    """Two plans with controls, constant or for each step, and their scores."""
    controls = np.stack([np.broadcast_to(plan, (STEPS, 2)) for plan in plans])
    return judged(scene, controls, np.array(lanes))


def changing(curvature):
    """Controls that turn for 1.2 s and turn back."""
    return np.pad(np.repeat([[curvature, 0.0], [-curvature, 0.0]], 6, axis=0), ((0, STEPS - 12), (0, 0)))


def before(place):
    """A robot before a standing car."""
    return scene_of(robot=(0.0, 0.0, 0.0, 12.0), cars=[(place, 0, 0.0)])


CLOSED, TWICE = scene_of(), [changing(0.004)] * 2
CLOSED.open[RIGHT] = False


@pytest.mark.parametrize(
    ("scene", "plans", "lanes", "broken"),
    [
        (scene_of(), (KEEPING, (0.01, 0.0)), (OWN, OWN), [False, True]),  # stays on the road
        (CLOSED, TWICE, (OWN, RIGHT), [False, True]),  # changes to no closed lane
        (crossing(), (HARD, KEEPING), (OWN, OWN), [False, True]),  # stops before a crossing car
        (before(75.0), (HARD, KEEPING), (OWN, OWN), [False, True]),  # keeps room to stop
        (before(14.0), ((0.0, -1.0), KEEPING), (OWN, OWN), [True, True]),  # hits more softly
        (before(22.5), (HARD, (0.03, 0.0)), (OWN, OWN), [True, True]),  # hits softly rather than leaves the road
    ],
)
def test_the_first_of_two_plans_is_preferred(scene, plans, lanes, broken):
    _, scores = scores_of(scene, *plans, lanes=lanes)
    assert scores.preference[0] > scores.preference[1] + 100
    np.testing.assert_array_equal(scores.broken, broken)


@pytest.mark.parametrize(
    ("lane", "controls", "goal", "collides"),
    [
        (0, KEEPING, OWN, False),  # runs into a robot that keeps its lane
        (1, changing(0.008), RIGHT, True),
    ],
)
def test_a_car_behind_counts_only_if_the_robot_cuts_in_ahead_of_it(lane, controls, goal, collides):
    scene = scene_of(robot=(0.0, 0.0, 0.0, 15.0), cars=[(-15.0, lane, 25.0)])
    _, scores = scores_of(scene, controls, controls, lanes=(goal, OWN))
    assert scores.collides[0] == collides
