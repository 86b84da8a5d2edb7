"""The robot keeps a way out from cones and from humans who do not yield."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.dynamics import keep_velocity, step
from ms_highway.game.features import features
from ms_highway.game.scenario import build_game
from ms_highway.game.scenarios import DENSE_MERGE
from ms_highway.planning.way_out import keep_way_out
from ms_highway.runtime.compilation import jit_quickly

STEPS = 45


@pytest.fixture(scope="module")
def game():
    return build_game(DENSE_MERGE, control_limit=DENSE_MERGE.control_limit, grip=DENSE_MERGE.grip, humans=3)


@pytest.fixture(scope="module")
def escape(game):
    return jit_quickly(lambda state, control: keep_way_out(game, state, control))


def beside(game, offsets):
    """The robot in its lane, and humans in the other one, so far ahead of it [m]."""
    robot, target = np.array([[0.0, 0.0, 0.0, 20.0]]), float(game.scene.target_lane)
    humans = np.array([[offset, target, 0.0, 20.0] for offset in offsets])
    return jnp.asarray(np.concatenate([robot, humans]), jnp.float32)


def changed(game, state, curvature, acceleration):
    """The scaled control that changes the robot's velocity by this much."""
    kept = keep_velocity(game.dynamics, state[0])
    return (kept + np.float32([curvature, acceleration])) / game.planner.control_scale


@pytest.fixture(scope="module")
def moved(game):
    """The state after a control of the robot, while humans keep their velocity, and whether the robot collides then."""

    @jax.jit
    def after(state, control):
        others = keep_velocity(game.dynamics, state[1:])
        state = step(game.dynamics, state, jnp.concatenate([(control * game.planner.control_scale)[None], others]))
        return state, features(game.scene, game.robot, state)[game.robot.names.index("collision")] > 0

    return after


def driven(game, moved, state, control, escape=None):
    """Whether the robot collides if it always wants this control [1/m, m/s^2], and how many controls are replaced."""
    wanted, replaced = jnp.asarray(np.array(control) / game.planner.control_scale, jnp.float32), 0
    for _ in range(STEPS):
        own = wanted
        if escape is not None:
            instead, replaces = escape(state, own)
            own, replaced = instead[0] if replaces else own, replaced + bool(replaces)
        state, collides = moved(state, own)
        if collides:
            return True, replaced
    return False, replaced


@pytest.mark.parametrize("control", [[0.0, 4.0], [-0.01, 4.0]], ids=["into the cones", "into a human"])
def test_a_robot_that_would_collide_brakes_in_time_if_the_next_lane_is_taken(game, moved, escape, control):
    state = beside(game, [-8.0, 0.0, 8.0])
    assert driven(game, moved, state, control)[0]
    collided, replaced = driven(game, moved, state, control, escape)
    assert not collided
    assert replaced > 0


def test_a_robot_does_not_count_on_a_human_that_swerves_to_leave_the_road(game, moved, escape):
    """The human beside the robot makes room for it, but only up to the edge of the road."""
    edge = float(game.scene.lanes.min()) - 0.5
    state = beside(game, [-3.0, 30.0, 40.0]).at[:2, 2].set(-0.2).at[0, 1].set(-0.5).at[0, 3].set(23.0)
    cuts_in = keep_velocity(game.dynamics, state[0]) / game.planner.control_scale
    for _ in range(STEPS):
        found = escape(state, cuts_in)
        state, collides = moved(state, found.controls[0] if found.replaces else cuts_in)
        assert not collides
        state = state.at[1, 2].set(jnp.where(state[1, 1] < edge, 0.0, state[1, 2]))


def test_a_control_that_leaves_a_way_out_stays(game, escape):
    state, control = beside(game, [-60.0, 60.0, 70.0]), jnp.array([0.1, 0.12], jnp.float32)
    assert not escape(state, control).replaces


def test_a_control_is_judged_over_the_same_time_as_escapes(game, escape):
    """A human from behind reaches the robot sooner or later: no escape replaces the first control of the best one."""
    replaced = []
    for gap in np.arange(10.0, 60.0, 0.5):
        state = beside(game, [-gap, -gap, -gap]).at[1, 1].set(0.0).at[1:, 3].set(40.0)
        best = escape(state, jnp.zeros(2))
        replaced.append(bool(escape(state, best.controls[0]).replaces))
    assert not any(replaced)


def test_a_robot_speeds_up_before_a_faster_car_from_which_it_cannot_escape(game, escape):
    state = beside(game, [-12.0, 0.0, 8.0]).at[1, 1].set(0.0).at[1, 3].set(30.0)
    steady = changed(game, state, 0.0, 0.0)
    found = escape(state, steady)
    assert found.replaces
    assert found.controls[0, 1] > steady[1]
    assert not escape(state, found.controls[0]).replaces  # one that is as good stays


def test_a_robot_that_cannot_stop_before_the_cones_brakes_as_hard_as_it_can(game, escape):
    cones = float(game.scene.obstacles[:, 0].min())
    state = beside(game, [-8.0, 0.0, 8.0]).at[:, 0].add(cones - 20.0)
    found = escape(state, changed(game, state, 0.0, 4.0))
    assert found.replaces
    np.testing.assert_allclose(found.controls[0, 1], changed(game, state, 0.0, -8.0)[1], rtol=0.01)


def test_the_controls_of_an_escape_are_those_that_avoid_the_collision(game, moved, escape):
    state, cruise = beside(game, [-8.0, 0.0, 8.0]), jnp.array([0.0, 0.12])
    while not (found := escape(state, cruise)).replaces:
        state = step(game.dynamics, state, keep_velocity(game.dynamics, state))
    assert found.controls.shape == (game.planner.horizon, 2)
    for control in found.controls:
        state, collides = moved(state, control)
        assert not collides
