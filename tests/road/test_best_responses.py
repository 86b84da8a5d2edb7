"""How humans respond to the robot on any road."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from roads import PLANNING, scene_of

from ms_highway.data.learned_reward import commuter_weights
from ms_highway.game.dynamics import Motion
from ms_highway.game.features import motion_reward
from ms_highway.game.reward import linear_reward
from ms_highway.game.scenario import PAPER_UNIT
from ms_highway.game.scene import Scene
from ms_highway.geometry.curve import BEHIND, SPACING
from ms_highway.road.best_responses import RESPONSES, commuter_among
from ms_highway.runtime.compilation import jit_quickly

TIMES = np.asarray(PLANNING.times)
CUT_IN = np.minimum(-4 + 2 * TIMES, 0)  # lateral positions [m]


def robot_from(place, d=0.0, acceleration=0.0):
    """Trajectory of the robot on a straight road, at 20 m/s at first."""
    s = place + 20 * TIMES + acceleration * TIMES**2 / 2
    speed = 20 + acceleration * TIMES
    return np.stack(np.broadcast_arrays(s, d, 0.0, speed)).astype(np.float32)


def keeping_velocity(scene):
    """Trajectories of others that keep their velocity on a straight road."""
    present_knot = round(BEHIND / SPACING)
    x = scene.paths.x[:, present_knot, None]
    y = scene.paths.y[:, present_knot, None]
    speeds = scene.states[:, 3:]
    fields = np.broadcast_arrays(x + speeds * TIMES, y, 0.0, speeds)
    return np.stack(fields, axis=1).astype(np.float32)


@jit_quickly
def respond(scene, robot, others):
    human = commuter_among(scene, PLANNING, 0, robot, others)
    return RESPONSES.acceleration_unit * human.best_response()


def response(scene, robot):
    """Accelerations of the first car."""
    return np.asarray(respond(scene, robot, keeping_velocity(scene)))


def test_rewards_and_derivatives_are_those_of_commuters():
    learned = linear_reward(commuter_weights(), 30.0)
    road = Scene(
        np.zeros(1),
        4.0,
        np.zeros((0, 2)),
        np.ones(2),
        np.array([5.0, 2.0]),
        0.5,
        0.0,
        PAPER_UNIT,
    )
    scene = scene_of(
        cars=[(0.0, 0, 22.0), (30.0, 0, 18.0), (-25.0, 0, 25.0), (5.0, 1, 20.0)]
    )

    @jit_quickly
    def rewards_and_derivatives(first, second):
        human = commuter_among(
            scene, PLANNING, 0, robot_from(8, CUT_IN), keeping_velocity(scene)
        )

        def earned(scaled):
            a = scaled * RESPONSES.acceleration_unit
            speed = 22 + jnp.cumsum(a) * 0.2
            s = jnp.cumsum(speed - a * 0.1) * 0.2
            own = Motion(s, 0 * s, 0 * s + 1, 0 * s, speed)
            comfort = learned.comfort[1] * jnp.sum((a / PAPER_UNIT) ** 2) / 2
            return jnp.sum(motion_reward(road, learned, own, human.others)) - comfort

        gradient, hessian = human.expand(first)
        found = human.earned(first) - human.earned(second), gradient, hessian @ second
        return found, (
            earned(first) - earned(second),
            *jax.jvp(jax.grad(earned), (first,), (second,)),
        )

    random = np.random.default_rng(0)
    first, second = random.normal(size=(2, PLANNING.steps)).astype(np.float32) / 10
    found, expected = rewards_and_derivatives(first, second)
    assert abs(found[0]) > 10
    assert found[0] == pytest.approx(float(expected[0]), rel=1e-3)
    for derivative, exact in zip(found[1:], expected[1:], strict=True):
        np.testing.assert_allclose(derivative, exact, atol=1e-4 * np.abs(exact).max())


def test_a_human_brakes_behind_a_braking_robot():
    scene = scene_of(cars=[(0.0, 0, 20.0)])
    assert response(scene, robot_from(20, acceleration=-4.0)).mean() < -1.0


def test_a_human_slows_for_a_robot_that_cuts_in():
    scene = scene_of(cars=[(0.0, 0, 20.0)])
    cut_in = response(scene, robot_from(10, CUT_IN))[:5].mean()
    beside = response(scene, robot_from(10, -4.0))[:5].mean()
    assert -6.0 < cut_in < beside - 0.5


def test_a_human_stops_behind_a_standing_car():
    scene = scene_of(cars=[(-30.0, 0, 15.0), (2.0, 0, 0.0)])
    speed = 15.0 + np.cumsum(response(scene, robot_from(-500))) * PLANNING.time_step
    assert -30.0 + speed.sum() * PLANNING.time_step < 2.0 - 5.0
    assert speed.min() > -1e-3
