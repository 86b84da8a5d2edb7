"""How humans answer the robot on any road."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from roads import NOBODY, PLANNING, judged, scene_of

from ms_highway.game.dynamics import Motion
from ms_highway.game.features import motion_reward
from ms_highway.game.learned_reward import commuter_weights
from ms_highway.game.reward import linear_reward
from ms_highway.game.scenario import PAPER_UNIT
from ms_highway.game.scene import Scene
from ms_highway.road.best_responses import ACCELERATION_UNIT, Commuter, commuter_among

TIMES = np.asarray(PLANNING.times)


def robot_at(s, speed, d=0.0):
    """World trajectory on a straight road."""
    return jnp.stack(jnp.broadcast_arrays(*map(jnp.float32, (s, d, 0.0)), jnp.asarray(speed, jnp.float32)))


def keeping_velocity(scene):
    """World trajectories of others who keep their velocity."""
    return judged(scene, np.zeros((1, PLANNING.steps, 2)), [1], NOBODY)[0].world[0]


@jax.jit
def answer(scene, robot, others):
    return ACCELERATION_UNIT * commuter_among(scene, PLANNING, 0, robot, others).best_response()


AWAY = robot_at(-500 + 20 * TIMES, 20.0 + 0 * TIMES)


def answered(scene, robot):
    return np.asarray(answer(scene, robot, keeping_velocity(scene)))


BUSY = scene_of(cars=[(0.0, 0, 22.0), (30.0, 0, 18.0), (-25.0, 0, 25.0), (5.0, 1, 20.0)])


def busy_human():
    cut_in = robot_at(8 + 20 * TIMES, 20.0 + 0 * TIMES, jnp.asarray(np.minimum(-4 + 2 * TIMES, 0)))
    return jax.jit(commuter_among)(BUSY, PLANNING, 0, cut_in, keeping_velocity(BUSY))


def test_the_reward_is_the_commuters_on_a_straight_road():
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


def test_a_human_behind_a_braking_robot_brakes_and_one_beside_a_cut_in_slows():
    scene = scene_of(cars=[(0.0, 0, 20.0)])
    braking = robot_at(20 + 20 * TIMES - 2 * TIMES**2, 20 - 4 * TIMES)
    assert answered(scene, braking).mean() < -1.0
    cut_in = robot_at(10 + 20 * TIMES, 20.0 + 0 * TIMES, jnp.asarray(np.minimum(-4 + 2 * TIMES, 0)))
    beside = robot_at(10 + 20 * TIMES, 20.0 + 0 * TIMES, -4.0)
    assert -6.0 < answered(scene, cut_in)[:5].mean() < answered(scene, beside)[:5].mean() - 0.5


def test_a_human_stops_behind_a_standing_car_that_it_would_drive_through():
    scene = scene_of(cars=[(-30.0, 0, 15.0), (2.0, 0, 0.0)])
    speed = 15.0 + np.cumsum(answered(scene, AWAY)) * PLANNING.time_step
    assert -30.0 + speed.sum() * PLANNING.time_step < 2.0 - 5.0
    assert speed.min() > -1e-3
