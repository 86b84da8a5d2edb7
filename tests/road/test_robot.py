"""The robot's car keeps within its grip, whatever its driver does."""

from types import SimpleNamespace

import highway_env  # noqa: F401, registers the environments
import numpy as np
import pytest
from highway_env.road.road import Road, RoadNetwork

from ms_highway.road.robot import GRIP, RoadRobot


@pytest.mark.parametrize("frequency", [5, 15])
@pytest.mark.parametrize("speed", [0.0, 3.0, 16.0, 30.0])
def test_no_driver_makes_the_robot_exceed_its_grip_in_any_frame_or_reverse(speed, frequency):
    robot = RoadRobot(Road(RoadNetwork.straight_road_network(3, length=10_000)), [100.0, 4.0], 0.0, speed)
    random, last = np.random.default_rng(0), None
    robot.drive_with(SimpleNamespace(step=lambda _: SimpleNamespace(control=random.uniform(-1, 1, 2) * [0.5, 20.0])))
    for _ in range(100):
        robot.act()
        before, start = robot.velocity, robot.position.copy()
        robot.step(1 / frequency)
        moved = (robot.position - start) * frequency
        assert np.linalg.norm(robot.velocity - before) * frequency <= GRIP
        assert last is None or np.linalg.norm(moved - last) * frequency <= GRIP
        assert robot.speed >= -1e-9
        last = moved
    assert 0.9 * GRIP < max(robot.accelerations) <= GRIP
