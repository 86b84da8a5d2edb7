"""What plans on roads earn, and which constraints they break."""

from dataclasses import replace

import numpy as np
import pytest
from roads import NOBODY, PLANNING, crossing, judged, now_in, on_path, scene_of, wrecked

from ms_highway.geometry.curve import BEHIND, SPACING
from ms_highway.road.scene import TRAFFIC_KNOTS
from ms_highway.road.score import blocks
from ms_highway.runtime.compilation import jit_quickly

STEPS, OWN, RIGHT = PLANNING.steps, 1, 2
KEEPING = (0.0, 0.0)


in_the_way = jit_quickly(blocks)


def scores_of(scene, *plans, lanes=(OWN, OWN)):
    """Scores of two plans of constant controls."""
    controls = np.tile(np.array(plans, np.float32)[:, None], (1, STEPS, 1))
    return judged(scene, controls, np.array(lanes), NOBODY)


def changing(curvature, seconds):
    """Controls that turn and turn back."""
    controls = np.zeros((STEPS, 2), np.float32)
    steps = round(seconds / PLANNING.time_step)
    controls[:steps, 0], controls[steps : 2 * steps, 0] = curvature, -curvature
    return controls


@pytest.mark.parametrize(("place", "expected"), [(1.25, (False, False)), (1.5, (False, True)), (1.75, (True, True))])
def test_what_has_crashed_is_passed_by_more_than_a_car_that_stands_and_may_drive_on(place, expected):
    standing, crashed = (scene_of(robot=(0.0, place, 0.0, 10.0), cars=[(20.0, 1, 0.0)]) for _ in range(2))
    for scene, close in zip((standing, wrecked(crashed, 0)), expected, strict=True):
        _, scores = scores_of(scene, KEEPING, KEEPING)
        assert bool(scores.collides[0]) == close


@pytest.mark.parametrize("side", [-1, 1])
def test_a_plan_that_leaves_the_road_breaks_a_constraint(side):
    _, scores = scores_of(scene_of(), (side * 0.01, 0.0), KEEPING)
    np.testing.assert_array_equal(scores.leaves, [True, False])
    assert scores.total[0] < scores.total[1]


def test_who_changes_to_a_closed_lane_breaks_a_constraint():
    scene = scene_of()
    scene.open[RIGHT] = False
    controls = np.stack([changing(0.004, 1.2)] * 2)
    _, scores = judged(scene, controls, np.array([RIGHT, OWN]), NOBODY)
    np.testing.assert_array_equal(scores.broken, [True, False])


def test_room_to_stop_is_missing_where_the_robot_is_too_close_and_too_fast():
    """Behind a standing car, full braking suffices wherever no room is missing."""
    missing = []
    for place in np.arange(95.0, 220.0, 20.0):
        scene = scene_of(robot=(0.0, 0.0, 0.0, 20.0), cars=[(place, 0, 0.0)])
        rollouts, scores = scores_of(scene, KEEPING, (0.0, -3.0))
        s, _, _, speed = np.asarray(rollouts.states)[:, -1].T
        missing.append(np.asarray(scores.missing))
        assert ((missing[-1] > 0) | (speed**2 / (2 * PLANNING.grip) < place - s - 7.5)).all()
    assert (np.diff(missing, axis=0) <= 0).all()
    assert missing[0][0] > missing[0][1]
    assert (missing[-1] == 0).all()


@pytest.mark.parametrize(
    ("place", "better"),
    [(75.0, "lacks no room, and earns less"), (23.7, "hits nobody"), (14.0, "hits more softly")],
)
def test_a_sound_plan_is_preferred_then_one_that_hits_nobody_then_the_softest(place, better):
    scene = scene_of(robot=(0.0, 0.0, 0.0, 12.0), cars=[(place, 0, 0.0)])
    _, scores = scores_of(scene, KEEPING, (0.0, -4.9 if place > 20 else -1.0))
    keeps, brakes = np.asarray(scores.preference)
    assert brakes > keeps + 100, better
    assert (scores.broken[1], scores.impact[1] > 0) == (place < 70, place < 20)


def test_to_come_close_to_somebody_or_to_hit_it_softly_is_better_than_to_leave_the_road():
    for place in (23.7, 22.5):
        scene = scene_of(robot=(0.0, 0.0, 0.0, 12.0), cars=[(place, 0, 0.0)])
        _, scores = scores_of(scene, (0.0, -4.9), (0.03, 0.0))
        np.testing.assert_array_equal(scores.leaves, [False, True])
        assert scores.broken.all()
        assert scores.preference[0] > scores.preference[1] + 100


@pytest.mark.parametrize("lane", [OWN, RIGHT])
def test_a_follower_that_runs_into_a_robot_that_keeps_its_lane_or_waits_to_change_does_not_count(lane):
    scene = scene_of(robot=(0.0, 0.0, 0.0, 15.0), cars=[(-15.0, 0, 25.0)])
    rollouts, scores = scores_of(scene, KEEPING, KEEPING, lanes=(lane, OWN))
    assert (np.asarray(rollouts.s)[:, 0, -1] > np.asarray(rollouts.states)[:, -1, 0]).all()  # it drives through it
    assert not np.asarray(scores.collides).any()


def test_a_car_that_the_robot_cuts_in_on_does_count():
    scene = scene_of(robot=(0.0, 0.0, 0.0, 15.0), cars=[(-15.0, 1, 25.0)])
    controls = np.stack([changing(0.008, 1.2), np.zeros((STEPS, 2))]).astype(np.float32)
    _, scores = judged(scene, controls, np.array([RIGHT, OWN]), NOBODY)
    np.testing.assert_array_equal(scores.collides, [True, False])


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
    rollouts, scores = scores_of(scene, KEEPING, KEEPING)
    assert bool(in_the_way(now_in(scene), rollouts)[0, 0]) == expected
    assert not np.asarray(scores.collides).any()


@pytest.mark.parametrize(("joins_at", "crosses"), [(10.0, False), (50.0, True)])
def test_who_joins_the_route_behind_the_robot_and_turns_off_ahead_of_it_does_not_cross_it(joins_at, crosses):
    scene = scene_of(robot=(30.0, 0.0, 0.0, 8.0), cars=[(0.0, 0, 8.0)])
    along = SPACING * np.arange(TRAFFIC_KNOTS) - BEHIND
    aside = np.where(along < joins_at, -5.0, 0.0) - np.maximum(along - 60.0, 0.0)
    path = along, aside, np.where(along > 60.0, -np.pi / 4, 0.0), 0 * along
    assert now_in(on_path(scene, *path)).crossings.exist[0] == crosses


@pytest.mark.parametrize(
    ("s", "come_from", "grip", "broken"),
    [(26.0, 12.0, 5.0, [True, False]), (10.0, 32.0, 5.0, [False, False]), (10.0, 32.0, 1.0, [True, False])],
)
def test_who_meets_a_car_that_crosses_breaks_a_constraint_once_tyres_cannot_stop_it(s, come_from, grip, broken):
    """The second plan brakes as hard as it can."""
    scene = replace(crossing(0.0, come_from), robot=np.array([s, 0.0, 0.0, 8.0], np.float32))
    controls = np.tile(np.array([KEEPING, (0.0, -grip)], np.float32)[:, None], (1, STEPS, 1))
    _, scores = judged(scene, controls, np.array([OWN, OWN]), NOBODY, replace(PLANNING, grip=grip))
    np.testing.assert_array_equal(scores.collides, broken)
    np.testing.assert_array_equal(scores.broken, broken)
    assert scores.others[0, 0] > 0
