"""The robot moves in road coordinates like highway-env's cars."""

from dataclasses import replace

import numpy as np
import pytest
from highway_env.vehicle.kinematics import Vehicle
from roads import PLANNING, execute, scene_of

from ms_highway.road.robot import steering_of
from ms_highway.road.simulation import bodies

LENGTH = Vehicle.LENGTH


def of_highway_env(speed, controls, dt):
    """x, y, heading and speed of a car of highway-env after each control, its rear axle at the origin at first."""
    car, after = Vehicle(None, [LENGTH / 2, 0.0], 0.0, speed), []
    for curvature, acceleration in np.asarray(controls, float):
        car.act({"steering": steering_of(curvature, LENGTH), "acceleration": acceleration})
        car.step(dt)
        after.append([*car.position, car.heading, car.speed])
    return np.array(after)


@pytest.mark.parametrize("bend", [0.0, 1 / 20, -1 / 60])
def test_in_fine_steps_the_robot_moves_like_highway_envs_car_on_any_road(bend):
    often = replace(PLANNING, time_step=0.005)
    turns = np.stack([np.linspace(0.12, -0.06, 800), np.linspace(1.0, -2.0, 800)], axis=-1).astype(np.float32)
    scene = scene_of(bend, robot=(0.0, 0.0, 0.0, 6.0))
    states, held = execute(scene, often, turns)
    centres = np.stack(bodies(scene, states), axis=-1)
    theirs = of_highway_env(6.0, held, 0.005)
    assert np.hypot(*theirs[-1, :2]) > 10.0
    assert np.hypot(*(centres - theirs[:, :3]).T[:2]).max() < 0.05
    np.testing.assert_allclose(centres[:, 2], theirs[:, 2], atol=0.01)
    np.testing.assert_allclose(states[:, 3], theirs[:, 3], atol=1e-3)
