"""Proposals keep within the limits of the car, and traffic follows as in highway-env."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from roads import (
    NOBODY,
    PLANNING,
    PLANS,
    behaving,
    driven_and_judged,
    execute,
    scene_of,
    winding,
)

from ms_highway.geometry.curve import SPACING
from ms_highway.perception.scene import KNOTS, TRAFFIC
from ms_highway.road.proposals import LAST_PLAN, PROPOSALS

GRIP, DT, STEPS = float(PLANNING.grip), PLANNING.time_step, PLANNING.steps
FOLLOWING = np.ones(TRAFFIC, bool)
STRAIGHT_ON = np.zeros((STEPS, 2), np.float32)
LENGTHS = 5.0 + 2.5  # m, from a centre to the rear axle of the car behind where the bumpers touch


def proposed(scene, follows=NOBODY, last=STRAIGHT_ON, acceleration=0.0):
    """All proposals, simulated."""
    plans = PLANS._replace(controls=np.tile(last, (PROPOSALS, 1, 1)))
    return driven_and_judged(scene, PLANNING, behaving(follows, acceleration), plans)[0]


def before_a_bend(speed, ahead):
    """A straight road that bends by a radius of 20 m ahead."""
    curvature = np.where(np.arange(KNOTS) * SPACING > 20.0 + ahead, 1 / 20, 0.0)
    return replace(scene_of(robot=(0.0, 0.0, 0.0, speed)), route=winding(curvature))


SCENES = {
    "standing": scene_of(robot=(0.0, 0.0, 0.0, 0.0)),
    "fast in traffic": scene_of(robot=(0.0, 0.5, -0.05, 38.0), cars=[(30.0, 0, 10.0), (-15.0, 1, 30.0)]),
    "circle": scene_of(bend=-1 / 15, robot=(0.0, 1.0, 0.2, 11.0), cars=[(20.0, 0, 5.0)]),
    "before a bend": before_a_bend(20.0, 15.0),
}


@pytest.mark.parametrize("name", SCENES)
def test_every_step_of_every_proposal_is_within_the_limits_of_the_car(name):
    wild = (np.random.default_rng(0).normal(size=(STEPS, 2)) * [0.3, 10]).astype(np.float32)
    scene = SCENES[name]
    rollouts = proposed(scene, FOLLOWING, wild)
    states, (curvature, acceleration) = np.asarray(rollouts.states), np.moveaxis(np.asarray(rollouts.controls), -1, 0)
    before = np.insert(states[:, :-1, 3], 0, scene.robot[3], axis=1)
    assert np.hypot(before**2 * curvature, acceleration).max() <= GRIP + 1e-4
    assert np.abs(curvature).max() <= PLANNING.curvature
    assert states[..., 3].min() > -1e-6
    driven, _ = jax.jit(jax.vmap(execute, (None, None, 0)))(scene, PLANNING, rollouts.controls)
    np.testing.assert_allclose(states, driven, atol=0.02)


@pytest.mark.parametrize(("gap", "speed"), [(20.0, 20.0), (10.0, 10.0)])
def test_a_plan_that_follows_does_not_hit_a_car_ahead_that_brakes_to_a_stop(gap, speed):
    scene = scene_of(robot=(0.0, 0.0, 0.0, speed), cars=[(gap + LENGTHS, 0, speed)])
    rollouts, own = proposed(scene, acceleration=-6.0), PLANS.follows & ~PLANS.closes & (PLANS.lane == 1)
    assert (np.asarray(rollouts.s)[own, 0] - np.asarray(rollouts.states)[own, :, 0] - LENGTHS).min() > 0


def theirs(speed, distance, ahead):
    """Acceleration of highway-env's IDMVehicle, within its own limits, at a distance of centres to the car ahead."""
    road = Road(RoadNetwork.straight_road_network(1, speed_limit=50.0))
    car = IDMVehicle(road, [100.0, 0.0], 0.0, speed, target_speed=speed)
    other = IDMVehicle(road, [100.0 + distance, 0.0], 0.0, ahead)
    return np.clip(car.acceleration(car, other), -IDMVehicle.ACC_MAX, IDMVehicle.COMFORT_ACC_MAX)


@pytest.mark.parametrize(("speed", "ahead", "distance"), [(25.0, 22.0, 60.0), (22.0, 25.0, 30.0)])
def test_followers_are_predicted_as_highway_env_moves_them_behind_others_and_behind_the_robot(speed, ahead, distance):
    led = scene_of(cars=[(40.0, 1, speed), (40.0 + distance, 1, ahead)])
    led.leaders[0], led.gaps[0] = 1, distance
    behind = scene_of(robot=(0.0, 0.0, 0.0, ahead), cars=[(2.5 - distance, 0, speed)])
    for scene in (led, behind):
        speeds = np.asarray(proposed(scene, FOLLOWING).speeds)[LAST_PLAN]
        assert (speeds[0, 0] - speed) / DT == pytest.approx(theirs(speed, distance, ahead), abs=5e-3)
