"""The robot keeps a way out from cones and from humans who do not yield."""

from functools import partial

import jax
import numpy as np
import pytest
from driving import dense_merge

from ms_highway.game.dynamics import keep_velocity, step
from ms_highway.game.features import features
from ms_highway.planning.way_out import keep_way_out
from ms_highway.runtime.compilation import jit_quickly

STEPS = 45


GAME = dense_merge(3)
escape = partial(jit_quickly(keep_way_out), GAME)


def beside(*offsets):
    """The robot in its lane, and humans in the other one, so far ahead of it [m]."""
    robot = [0.0, 0.0, 0.0, 20.0]
    target = GAME.scene.target_lane
    return np.float32([robot, *([offset, target, 0.0, 20.0] for offset in offsets)])


def scaled(curvature, acceleration):
    """The scaled control that changes the robot's velocity by this much at 20 m/s."""
    return np.float32([curvature, 4.0 + acceleration]) / GAME.planner.control_scale


STEADY = scaled(0.0, 0.0)


@jax.jit
def robot_collides(state):
    collision = GAME.robot.names.index("collision")
    return features(GAME.scene, GAME.robot, state)[collision] > 0


def moved(state, control):
    """The state after a control of the robot, and whether the robot collides then.

    Humans keep their velocity.
    """
    controls = keep_velocity(GAME.dynamics, state)
    controls[0] = control * GAME.planner.control_scale
    state = step(GAME.dynamics, state, controls)
    return state, bool(robot_collides(state))


def collides_if_it_wants(state, control, keeps_way_out=True):
    for _ in range(STEPS):
        found = escape(state, control)
        escapes = keeps_way_out and found.replaces
        state, collides = moved(state, found.controls[0] if escapes else control)
        if collides:
            return True
    return False


@pytest.mark.parametrize(
    "curvature", [0.0, -0.01], ids=["into the cones", "into a human"]
)
def test_a_robot_brakes_in_time_beside_a_taken_lane(curvature):
    state = beside(-8.0, 0.0, 8.0)
    control = scaled(curvature, 0.0)
    assert collides_if_it_wants(state, control, keeps_way_out=False)
    assert not collides_if_it_wants(state, control)


def test_a_robot_faster_than_the_limit_brakes_in_time():
    """It stops 1.65 m before the cones if it brakes now, and 0.85 m too late if it
    brakes a step later.

    A check of bodies that are widened by the clearance would miss that collision.
    """
    state = beside(-8.0, 0.0, 8.0)
    touch = (GAME.scene.car_size[0] + GAME.scene.obstacle_size[0]) / 2
    state[:, 3] = 25.0
    state[:, 0] += GAME.scene.obstacles[:, 0].min() - touch - 25.0**2 / (2 * 8.0) - 1.65
    assert escape(state, STEADY).replaces


def test_a_swerving_human_is_expected_to_stay_on_the_road():
    """The human beside the robot makes room for it, but only up to the edge of the
    road.
    """
    edge = GAME.scene.lanes.min() - 0.5
    state = beside(-3.0, 30.0, 40.0)
    state[:2, 2] = -0.2
    state[0, 1] = -0.5
    state[0, 3] = 23.0
    cuts_in = keep_velocity(GAME.dynamics, state[0]) / GAME.planner.control_scale
    for _ in range(STEPS):
        found = escape(state, cuts_in)
        state, collides = moved(state, found.controls[0] if found.replaces else cuts_in)
        assert not collides
        if state[1, 1] < edge:
            state[1, 2] = 0.0


def test_a_control_is_judged_over_the_same_time_as_escapes():
    """A human from behind reaches the robot sooner or later: no escape replaces the
    first control of the best one.
    """
    for gap in np.arange(10.0, 60.0, 0.5):
        state = beside(-gap, -gap, -gap)
        state[1, 1] = 0.0
        state[1:, 3] = 40.0
        best = escape(state, np.zeros(2, np.float32)).controls[0]
        assert not escape(state, best).replaces


def test_a_robot_speeds_up_before_a_faster_car_behind():
    state = beside(-12.0, 0.0, 8.0)
    state[1, 1] = 0.0
    state[1, 3] = 30.0
    found = escape(state, STEADY)
    assert found.replaces
    assert found.controls[0, 1] > STEADY[1]
    assert not escape(state, found.controls[0]).replaces  # one that is as good stays


def test_a_robot_that_cannot_stop_brakes_hard():
    state = beside(-8.0, 0.0, 8.0)
    state[:, 0] += GAME.scene.obstacles[:, 0].min() - 20.0
    found = escape(state, STEADY)
    assert found.replaces
    np.testing.assert_allclose(found.controls[0, 1], scaled(0.0, -8.0)[1], rtol=0.01)


def test_the_controls_of_an_escape_avoid_the_collision():
    state = beside(-8.0, 0.0, 8.0)
    while not (found := escape(state, STEADY)).replaces:
        state, _ = moved(state, STEADY)
    assert found.controls.shape == (GAME.planner.horizon, 2)
    for control in found.controls:
        state, collides = moved(state, control)
        assert not collides
