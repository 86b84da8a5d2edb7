"""How the robot moves in road coordinates: as highway-env's cars do, and within what tyres hold."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from highway_env.vehicle.kinematics import Vehicle
from jax import numpy as jnp
from roads import PLANNING, execute, scene_of

from ms_highway.road.robot import steering_of
from ms_highway.road.simulation import bodies

LENGTH = Vehicle.LENGTH


@jax.jit
def driven(scene, planning, controls):
    """States, controls within limits, and x, y and heading of the centre [steps, 3]."""
    states, held = execute(scene, planning, controls)
    return states, held, jnp.stack(bodies(scene, states), axis=-1)


def of_highway_env(speed, controls, dt):
    """x, y, heading and speed of a car of highway-env after each control, its rear axle at the origin at first."""
    car, after = Vehicle(None, [LENGTH / 2, 0.0], 0.0, speed), []
    for curvature, acceleration in np.asarray(controls, float):
        car.act({"steering": steering_of(curvature, LENGTH), "acceleration": acceleration})
        car.step(dt)
        after.append([*car.position, car.heading, car.speed])
    return np.array(after)


@pytest.mark.parametrize("bend", [0.0, 1 / 20, -1 / 60])
def test_in_fine_steps_the_robot_goes_where_highway_envs_car_goes_on_any_road(bend):
    often = replace(PLANNING, time_step=0.005)
    turns = np.stack([np.linspace(0.12, -0.06, 800), np.linspace(1.0, -2.0, 800)], axis=-1).astype(np.float32)
    states, held, centres = driven(scene_of(bend, robot=(0.0, 0.0, 0.0, 6.0)), often, turns)
    theirs = of_highway_env(6.0, held, 0.005)
    assert np.hypot(*theirs[-1, :2]) > 10.0
    assert np.hypot(*(np.asarray(centres) - theirs[:, :3]).T[:2]).max() < 0.05
    np.testing.assert_allclose(centres[:, 2], theirs[:, 2], atol=0.01)
    np.testing.assert_allclose(states[:, 3], theirs[:, 3], atol=1e-3)
