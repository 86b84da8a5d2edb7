"""A driver's view of a road, straightened along its lane."""

import numpy as np
import pytest
from highway_env.road.lane import CircularLane, StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.perception.observation import observe_road
from ms_highway.road.road_view import look

AROUND = {  # a lane of each shape, at some distance to the right of the road's middle
    "slanted": lambda side: StraightLane(
        [-2.4 * side, 3.2 * side], [320 - 2.4 * side, 240 + 3.2 * side]
    ),
    "bend": lambda side: CircularLane(
        [0, 0], 60 - 4 * side, 0, 3, clockwise=True, speed_limit=10
    ),
}


def road_with(shape):
    """A road of two parallel lanes of a shape."""
    network = RoadNetwork()
    beside = [AROUND[shape](side) for side in range(2)]
    for lane in beside:
        network.add_lane("a", "b", lane)
    return Road(network, np_random=np.random.RandomState(0)), beside


@pytest.mark.parametrize("shape", AROUND)
def test_a_view_has_the_coordinates_of_the_drivers_lane(shape):
    road, (lane, _) = road_with(shape)
    placed = np.array(
        [
            [30, 0.5, 0.02, 10],
            [45, -0.3, -0.01, 9],
            [12, -0.2, 0, 12],
            [20, 4, 0.05, 11],
        ]
    )
    for along, lateral, turn, speed in placed:
        heading = lane.heading_at(along) + turn
        road.vehicles.append(
            Vehicle(road, lane.position(along, lateral), heading, speed)
        )
    driver = road.vehicles[0]
    view = look(driver, observe_road(driver))

    # The driver, ahead, behind, and behind in the lane to the right.
    seen = view.states[[0, 1, 2, 6]]
    np.testing.assert_allclose(
        seen - [seen[0, 0], 0, 0, 0], placed - [30, 0, 0, 0], atol=1e-2
    )
    np.testing.assert_allclose(view.scene.lanes, [0.0, 0.0, 4.0], atol=1e-2)
