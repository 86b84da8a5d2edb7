"""Scenes of highway-env's own roads, seen from a driving car."""

from collections.abc import Iterator
from dataclasses import fields

import gymnasium as gym
import highway_env  # noqa: F401, registers the environments
import jax
import numpy as np
import pytest
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.game.road import KNOTS, LANES, TRAFFIC, TRAFFIC_KNOTS, Path, RoadScene, place
from ms_highway.vehicle.road_scene import observe_road

pytestmark = pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")

SCENES = {
    "highway-v0": None,
    "highway-fast-v0": None,
    "merge-v0": None,
    "merge-v1": None,
    "merge-generic-v0": None,
    "roundabout-v0": "nxs",
    "roundabout-v1": "nxs",
    "roundabout-generic-v0": "nxs",
    "exit-v0": "exit",
    "exit-v1": "exit",
    "intersection-v0": "o1",
    "intersection-v1": "o1",
    "intersection-v2": "o1",
    "two-way-v0": None,
    "u-turn-v0": "d",
    "racetrack-v0": None,
    "lane-keeping-v0": None,
}


def replace_ego(environment: AbstractEnv, lane: tuple[str, str, int] | None = None, at: float = 0.0) -> IDMVehicle:
    """Let an IDM vehicle drive in place of the ego vehicle, from a place on a lane or where that one is."""
    old, road = environment.vehicle, environment.road
    if lane is None:
        ego = IDMVehicle(road, old.position, old.heading, old.speed if isinstance(old, Vehicle) else 8.0)
    else:
        ego = IDMVehicle.make_on_lane(road, lane, at, speed=10.0)
    road.vehicles = [ego if car is old else car for car in road.vehicles]
    environment.vehicle = ego
    environment.controlled_vehicles = [ego]
    return ego


def make(scene: str, seed: int = 0) -> AbstractEnv:
    environment = gym.make(scene).unwrapped
    environment.reset(seed=seed)
    return environment


def episode(scene: str, steps: int, seed: int = 0) -> Iterator[tuple[AbstractEnv, IDMVehicle, RoadScene]]:
    environment = make(scene, seed)
    ego = replace_ego(environment)
    if SCENES[scene]:
        ego.plan_route_to(SCENES[scene])
    for _ in range(steps):
        yield environment, ego, observe_road(ego, SCENES[scene])
        environment.road.act()
        environment.road.step(1 / 15)


def lateral(path: Path, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Distance of points to the right of a path, from its nearest knots."""
    nearest = np.argmin((path.x[:, None] - x) ** 2 + (path.y[:, None] - y) ** 2, axis=0)
    cosine, sine = np.cos(path.heading[nearest]), np.sin(path.heading[nearest])
    x, y = x - path.x[nearest], y - path.y[nearest]
    return cosine * y - sine * x - path.curvature[nearest] * (cosine * x + sine * y) ** 2 / 2


@pytest.mark.parametrize("scene", SCENES)
def test_all_scenes_have_the_same_shapes_and_finite_numbers_all_along(scene: str) -> None:
    for _, _, seen in episode(scene, 40):
        assert seen.route.x.shape == (KNOTS,)
        assert seen.lanes.shape == seen.open.shape == (LANES, KNOTS)
        assert seen.edges.shape == (2, KNOTS)
        assert seen.paths.x.shape == (TRAFFIC, TRAFFIC_KNOTS)
        for field in fields(seen):
            for leaf in jax.tree.leaves(getattr(seen, field.name)):
                expected = {"open": bool, "present": bool, "moving": bool, "priority": bool}.get(field.name, np.float32)
                assert leaf.dtype == (np.int32 if field.name in ("leaders", "owners", "names") else expected), (
                    field.name
                )
                assert field.name == "room" or np.isfinite(leaf).all(), field.name


@pytest.mark.parametrize("scene", SCENES)
def test_a_route_can_be_driven_at_any_place(scene: str) -> None:
    for _, _, seen in episode(scene, 40):
        route = seen.route
        assert np.abs(route.curvature).max() <= 0.2
        assert np.abs(np.diff(route.curvature)).max() < 0.1
        assert np.hypot(np.diff(route.x), np.diff(route.y)) == pytest.approx(2.0, abs=0.02)
        chords = np.unwrap(np.arctan2(np.diff(route.y), np.diff(route.x)))
        between = (route.heading[1:] + route.heading[:-1]) / 2
        assert np.abs(np.sin(chords - between)).max() < 0.1 * 2.0 / 12, "as the curvature's steps allow"
        assert np.abs(np.diff(route.heading)).max() < 0.4
        assert (seen.edges[1] - seen.edges[0] >= 3.9).all()


@pytest.mark.parametrize("scene", SCENES)
def test_cars_are_found_again_from_their_road_coordinates(scene: str) -> None:
    for _, ego, seen in episode(scene, 30):
        x, y, heading = place(seen.route, seen.robot[0], seen.robot[1])
        heading = float(heading + seen.robot[2])
        rear = ego.position - ego.LENGTH / 2 * ego.direction
        assert np.allclose([x, y], rear, atol=0.02)
        assert np.cos(heading - ego.heading) == pytest.approx(1.0, abs=1e-4)
        positions = [car.position for car in (*ego.road.vehicles, *ego.road.objects)]
        for number in np.flatnonzero(seen.present):
            path = jax.tree.map(lambda leaf, number=number: leaf[number], seen.paths)
            x, y, _ = place(path, *seen.states[number, :2])
            assert min(np.hypot(*(np.array([x, y]) - position)) for position in positions) < 0.1


@pytest.mark.parametrize("scene", ["roundabout-v0", "intersection-v0", "racetrack-v0", "u-turn-v0", "merge-v0"])
def test_a_route_does_not_wobble_while_it_is_driven(scene: str) -> None:
    before, lane = None, None
    for _, ego, seen in episode(scene, 100):
        if before is not None and (ego.lane_index == lane or ego.lane_index[:2] != lane[:2]):
            places = slice(8, 60)
            assert np.abs(lateral(seen.route, before.x[places], before.y[places])).max() < 0.05
        before, lane = seen.route, ego.lane_index


def test_straight_lanes_stay_straight_and_circles_round() -> None:
    for _, _, seen in episode("highway-v0", 40):
        assert np.abs(seen.route.curvature).max() < 1e-6
        assert np.ptp(seen.route.heading) < 1e-6
        assert np.ptp(seen.route.y) < 1e-4
    environment = make("u-turn-v0")
    ego = replace_ego(environment, ("b", "c", 0), at=25.0)
    bend = observe_road(ego, "d").route.curvature[6:20]
    assert bend == pytest.approx(-1 / 20, rel=0.01)


def test_the_way_into_a_roundabout_and_out_of_it_is_one_smooth_curve() -> None:
    environment = make("roundabout-v0")
    ego = replace_ego(environment)
    route = observe_road(ego, "nxs").route
    network = environment.road.network
    ring = np.hypot(route.x, route.y)
    assert ring.min() == pytest.approx(24.0, abs=0.1)
    last = np.array([route.x[-1], route.y[-1]])
    assert network.get_lane(("nxs", "nxr", 0)).distance(last) < 0.1


def test_the_exit_asks_for_changes_to_its_lane_before_it_leaves_the_road() -> None:
    environment = make("exit-v0")
    for lane, at, changes, room in [
        (("0", "1", 0), 100.0, [7, 6, 5], 400.0),
        (("0", "1", 5), 380.0, [2, 1, 0], 120.0),
        (("1", "2", 5), 50.0, [2, 1, 0], 50.0),
        (("1", "2", 6), 50.0, [1, 0, -1], 50.0),
    ]:
        ego = replace_ego(environment, lane, at)
        seen = observe_road(ego, "exit")
        assert seen.changes.tolist() == changes
        assert float(seen.room) == pytest.approx(room, abs=0.1)
        assert observe_road(ego).changes[1] == 0
    assert float(seen.route.y[-1]) > 26.0, "the exit bends away from the road"
    assert seen.open[1].all()


def test_the_exit_lane_opens_beside_the_road_and_stays_open() -> None:
    environment = make("exit-v0")
    right = observe_road(replace_ego(environment, ("0", "1", 5), 380.0), "exit").open[2]
    knots = 380.0 - 2.5 - 20.0 + 2.0 * np.arange(KNOTS)
    assert not right[knots < 399].any()
    assert right[(knots > 401) & (knots < 520)].all()
    assert observe_road(replace_ego(environment, ("0", "1", 5), 380.0)).edges[1].max() == pytest.approx(6.0, abs=0.1)


def test_a_ramp_that_ends_asks_for_a_change_to_the_left_before_its_end() -> None:
    environment = make("merge-v0")
    ego = replace_ego(environment, ("k", "b", 0), 60.0)
    seen = observe_road(ego)
    assert seen.changes[1] == -1
    assert float(seen.room) == pytest.approx(100.0, abs=0.5)
    x = seen.route.x
    assert not seen.open[0, x < 228].any()
    assert seen.open[0, x > 232].all()
    assert seen.open[1, x < 308].all()
    assert not seen.open[1, x > 312].any()
    assert np.allclose(seen.edges[1, x > 312], seen.lanes[0, x > 312] + 2.0, atol=0.05)


def test_the_ramp_is_closed_to_the_cars_beside_it() -> None:
    environment = make("merge-v0")
    seen = observe_road(replace_ego(environment, ("b", "c", 1), 10.0))
    assert not seen.open[2].any()
    assert seen.edges[1] == pytest.approx(2.0, abs=0.01)


def test_the_left_lane_of_a_two_way_road_is_open() -> None:
    seen = observe_road(replace_ego(make("two-way-v0"), ("a", "b", 1), 100.0))
    assert seen.open[:, :].all(axis=1).tolist() == [True, True, False]
    assert seen.lanes[0] == pytest.approx(-4.0, abs=0.01)
    assert seen.edges[0] == pytest.approx(-6.0, abs=0.01)


def test_cars_before_an_intersection_may_go_several_ways() -> None:
    environment = make("intersection-v0")
    ego = replace_ego(environment, ("o0", "ir0", 0), 80.0)
    other = IDMVehicle.make_on_lane(environment.road, ("o2", "ir2", 0), 85.0, speed=8.0)
    other.plan_route_to("o1")
    environment.road.vehicles = [ego, other]
    seen = observe_road(ego, "o1")
    assert seen.present.sum() == 3
    assert seen.owners[:3].tolist() == [0, 0, 0]
    ends = np.stack([seen.paths.x[:3, -1], seen.paths.y[:3, -1]], axis=-1)
    assert min(np.hypot(*(one - two)) for n, one in enumerate(ends) for two in ends[:n]) > 30.0
    environment.road.vehicles[1] = IDMVehicle.make_on_lane(environment.road, ("ir2", "il3", 0), 10.0, speed=8.0)
    assert observe_road(ego, "o1").present.sum() == 1, "it has begun to turn"


def test_the_robot_gives_way_to_higher_priorities_and_to_the_ring_of_a_roundabout() -> None:
    environment = make("intersection-v0")
    ego = replace_ego(environment, ("o0", "ir0", 0), 85.0)
    for lane, expected in [(("o1", "ir1", 0), True), (("o2", "ir2", 0), True), (("il2", "o2", 0), False)]:
        environment.road.vehicles = [ego, IDMVehicle.make_on_lane(environment.road, lane, 85.0, speed=8.0)]
        assert observe_road(ego, "o1").priority.any() == expected
    environment = make("roundabout-v0")
    ego = replace_ego(environment, ("ses", "se", 0), 5.0)
    for lane, expected in [(("sx", "se", 1), True), (("ees", "ee", 0), False)]:
        environment.road.vehicles = [ego, IDMVehicle.make_on_lane(environment.road, lane, 5.0, speed=8.0)]
        assert observe_road(ego, "nxs").priority.any() == expected


def test_a_car_that_changes_lane_has_a_way_along_both_lanes() -> None:
    environment = make("highway-v0")
    ego = replace_ego(environment, ("0", "1", 1), 100.0)
    other = IDMVehicle.make_on_lane(environment.road, ("0", "1", 2), 120.0, speed=20.0)
    environment.road.vehicles = [ego, other]
    assert observe_road(ego).present.sum() == 1
    other.heading = -0.15
    seen = observe_road(ego)
    assert seen.states[:2, 1] == pytest.approx([0.0, 4.0], abs=0.01)
    assert seen.owners[:3].tolist() == [0, 0, -1]


def test_leaders_are_the_nearest_cars_ahead_on_the_same_path() -> None:
    environment = make("highway-v0")
    ego = replace_ego(environment, ("0", "1", 1), 100.0)
    cars = [
        IDMVehicle.make_on_lane(environment.road, ("0", "1", lane), at, speed=20.0)
        for lane, at in [(1, 110.0), (1, 140.0), (2, 130.0)]
    ]
    environment.road.vehicles = [ego, *cars]
    seen = observe_road(ego)
    owners = seen.owners.tolist()
    near, middle, far = owners.index(0), owners.index(1), owners.index(2)
    assert seen.leaders[[near, middle, far]].tolist() == [far, -1, -1]
    assert seen.gaps[near] == pytest.approx(30.0, abs=0.01)
    assert seen.moving[[near, middle, far]].all()


def test_obstacles_stand_still() -> None:
    environment = make("merge-v0")
    seen = observe_road(replace_ego(environment, ("b", "c", 2), 10.0))
    standing = np.flatnonzero(seen.present & ~seen.moving)
    assert standing.size == 1
    assert seen.sizes[standing[0]].tolist() == [2.0, 2.0]
    assert seen.states[standing[0], 3] == 0
