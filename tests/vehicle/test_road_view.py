"""A driver's view of a road, straightened along its lane, and driving by this view."""

import numpy as np
import pytest
from highway_env.road.lane import CircularLane, SineLane, StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.kinematics import Vehicle
from ms_highway.vehicle.road_view import look

from ms_highway.vehicle import HumanVehicle

AROUND = {  # a lane of each shape, at some distance to the right of the road's middle
    "slanted": lambda side: StraightLane([-2.4 * side, 3.2 * side], [320 - 2.4 * side, 240 + 3.2 * side]),
    "bend": lambda side: CircularLane([0, 0], 60 - 4 * side, 0, 3, clockwise=True, speed_limit=10),
    "winding": lambda side: SineLane([0, 4 * side], [400, 4 * side], 3, 0.05, 0, speed_limit=20),
}


def road_with(shape, lanes=1):
    """A road of parallel lanes of a shape."""
    network, beside = RoadNetwork(), [AROUND[shape](side) for side in range(lanes)]
    for lane in beside:
        network.add_lane("a", "b", lane)
    return Road(network, np_random=np.random.RandomState(0)), beside


def put(road, kind, lane, along, lateral=0.0, turn=0.0, speed=0.0):
    road.vehicles.append(kind(road, lane.position(along, lateral), lane.heading_at(along) + turn, speed))
    return road.vehicles[-1]


@pytest.mark.parametrize("shape", [shape for shape in AROUND if shape != "winding"])
def test_a_view_has_the_coordinates_of_the_drivers_lane(shape):
    road, (lane, _) = road_with(shape, lanes=2)
    placed = np.array([[30, 0.5, 0.02, 10], [45, -0.3, -0.01, 9], [12, -0.2, 0, 12], [20, 4, 0.05, 11]])
    kinds = HumanVehicle, Vehicle, Vehicle, Vehicle
    driver, *_ = [put(road, kind, lane, *place) for kind, place in zip(kinds, placed, strict=True)]
    view = look(driver)
    seen = view.states[[0, 1, 2, 6]]  # the driver, ahead, behind, and behind in the lane to the right
    np.testing.assert_allclose(seen - [seen[0, 0], 0, 0, 0], placed - [30, 0, 0, 0], atol=1e-2)
    np.testing.assert_allclose(view.scene.lanes, [0.0, 0.0, 4.0], atol=1e-2)


@pytest.mark.parametrize("shape", AROUND)
def test_a_human_follows_a_lane_of_any_shape(shape):
    road, (lane,) = road_with(shape)
    human = put(road, HumanVehicle, lane, 5.0, speed=0.9 * lane.speed_limit)
    for _ in range(100):
        road.act()
        road.step(1 / 15)
        assert abs(lane.local_coordinates(human.position)[1]) < 0.5
    assert human.speed == pytest.approx(lane.speed_limit, rel=0.1)
    assert human.last_step.status == "planned"
