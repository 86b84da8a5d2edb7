"""How humans respond to the robot on any road."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from roads import PLANNING, judged, scene_of

from ms_highway.game.dynamics import Motion
from ms_highway.game.features import motion_reward
from ms_highway.game.learned_reward import commuter_weights
from ms_highway.game.reward import linear_reward
from ms_highway.game.scenario import PAPER_UNIT
from ms_highway.game.scene import Scene
from ms_highway.road.best_responses import ACCELERATION_UNIT, Commuter, commuter_among

TIMES = np.asarray(PLANNING.times)


CUT_IN = np.minimum(-4 + 2 * TIMES, 0)  # lateral positions


def robot_from(place, d=0.0, acceleration=0.0):
    """Trajectory of the robot on a straight road, at 20 m/s at first."""
    s = place + 20 * TIMES + acceleration * TIMES**2 / 2
    return jnp.stack(jnp.broadcast_arrays(*map(jnp.float32, (s, d, 0.0, 20 + acceleration * TIMES))))


def keeping_velocity(scene):
    """Trajectories of others that keep their velocity."""
    return judged(scene, np.zeros((1, PLANNING.steps, 2)), [1])[0].world[0]


@jax.jit
def respond(scene, robot, others):
    return ACCELERATION_UNIT * commuter_among(scene, PLANNING, 0, robot, others).best_response()


def response(scene, robot):
    """Accelerations of the first car."""
    return np.asarray(respond(scene, robot, keeping_velocity(scene)))


def busy_human():
    scene = scene_of(cars=[(0.0, 0, 22.0), (30.0, 0, 18.0), (-25.0, 0, 25.0), (5.0, 1, 20.0)])
    return jax.jit(commuter_among)(scene, PLANNING, 0, robot_from(8, CUT_IN), keeping_velocity(scene))


def test_the_reward_is_that_of_commuters_on_a_straight_road():
    human = busy_human()
    learned = linear_reward(commuter_weights(), 30.0)
    scene = Scene(jnp.zeros(1), 4.0, jnp.zeros((0, 2)), jnp.ones(2), jnp.array([5.0, 2.0]), 0.5, 0.0, PAPER_UNIT)

    def earned(scaled):
        a = scaled * ACCELERATION_UNIT
        speed = 22 + jnp.cumsum(a) * 0.2
        s = jnp.cumsum(jnp.concatenate([jnp.full(1, 22.0), speed[:-1]]) + speed) * 0.1
        own = Motion(s, 0 * s, 0 * s + 1, 0 * s, speed)
        comfort = learned.comfort[1] * jnp.sum((a / PAPER_UNIT) ** 2) / 2
        return jnp.sum(motion_reward(scene, learned, own, Motion(*human.others))) - comfort

    random = np.random.default_rng(0)
    first, second = (jnp.asarray(random.normal(size=PLANNING.steps) / 10, jnp.float32) for _ in range(2))
    found, difference = (float(jax.jit(of)(first) - jax.jit(of)(second)) for of in (human.earned, earned))
    assert abs(difference) > 10
    assert found == pytest.approx(difference, rel=1e-3)


def test_its_derivatives_are_exact():
    human, at = busy_human(), jnp.full(PLANNING.steps, -0.1)
    found = jax.jit(Commuter.expand)(human, at)
    gradient, hessian = (jax.jit(of(human.earned))(at) for of in (jax.grad, jax.hessian))
    for part, exact in zip(found, (gradient, hessian), strict=True):
        np.testing.assert_allclose(part, exact, atol=1e-4 * np.abs(exact).max())


def test_a_human_brakes_behind_a_braking_robot_and_slows_for_a_robot_that_cuts_in():
    scene = scene_of(cars=[(0.0, 0, 20.0)])
    assert response(scene, robot_from(20, acceleration=-4.0)).mean() < -1.0
    cut_in, beside = (response(scene, robot_from(10, d))[:5].mean() for d in (CUT_IN, -4.0))
    assert -6.0 < cut_in < beside - 0.5


def test_a_human_stops_behind_a_standing_car():
    scene = scene_of(cars=[(-30.0, 0, 15.0), (2.0, 0, 0.0)])
    speed = 15.0 + np.cumsum(response(scene, robot_from(-500))) * PLANNING.time_step
    assert -30.0 + speed.sum() * PLANNING.time_step < 2.0 - 5.0
    assert speed.min() > -1e-3
