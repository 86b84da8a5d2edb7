"""The robot moves like highway-env's cars, and keeps within its grip, whatever its
driver does.
"""

from dataclasses import replace
from types import SimpleNamespace

import highway_env  # noqa: F401
import numpy as np
import pytest
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.kinematics import Vehicle
from roads import PLANNING, execute, scene_of

from ms_highway.road.robot import RoadRobot, steering_of

GRIP = RoadRobot.usual_grip


def test_in_fine_steps_the_robot_moves_like_highway_envs_car():
    """The rear axle of the car of highway-env is at the origin at first."""
    turns = np.stack(
        [np.linspace(0.12, -0.06, 800), np.linspace(1.0, -2.0, 800)], axis=-1
    ).astype(np.float32)
    scene = scene_of(1 / 20, robot=(0.0, 0.0, 0.0, 6.0))
    states, held, centres = map(
        np.asarray, execute(scene, replace(PLANNING, time_step=0.005), turns)
    )
    car = Vehicle(None, [Vehicle.LENGTH / 2, 0.0], 0.0, 6.0)
    poses = []
    speeds = []
    for curvature, acceleration in held.tolist():
        car.act(
            {
                "steering": steering_of(curvature, car.LENGTH),
                "acceleration": acceleration,
            }
        )
        car.step(0.005)
        poses.append([*car.position, car.heading])
        speeds.append(car.speed)
    assert np.hypot(*car.position) > 10.0
    x, y, turned = (centres - poses).T
    assert np.hypot(x, y).max() < 0.05
    assert np.abs(turned).max() < 0.01
    np.testing.assert_allclose(states[:, 3], speeds, atol=1e-3)


@pytest.mark.parametrize("frequency", [5, 15])
@pytest.mark.parametrize("speed", [0.0, 3.0, 16.0, 30.0])
def test_no_driver_exceeds_the_grip_or_reverses_in_any_frame(speed, frequency):
    robot = RoadRobot(
        Road(RoadNetwork.straight_road_network(3, length=10_000)),
        [100.0, 4.0],
        0.0,
        speed,
    )
    random = np.random.default_rng(0)
    last = None
    robot.drive_with(
        SimpleNamespace(
            step=lambda _: SimpleNamespace(
                control=random.uniform(-1, 1, 2) * [0.5, 20.0]
            )
        )
    )
    for _ in range(100):
        robot.act()
        before = robot.velocity
        start = robot.position.copy()
        robot.step(1 / frequency)
        moved = (robot.position - start) * frequency
        assert np.linalg.norm(robot.velocity - before) * frequency <= GRIP
        assert last is None or np.linalg.norm(moved - last) * frequency <= GRIP
        assert robot.speed >= -1e-9
        last = moved
    assert 0.9 * GRIP < max(robot.accelerations) <= GRIP
