"""Scenes of highway-env's own roads, observed from a driving car."""

from dataclasses import replace

import gymnasium as gym
import highway_env  # noqa: F401
import jax
import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from ms_highway.perception.observation import observe_road
from tests.roads import scene_of

pytestmark = pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")

GOALS = {
    "roundabout-v0": "nxs",
    "exit-v0": "exit",
    "u-turn-v0": "d",
    "intersection-v2": "o1",
}
SCENES = [
    *GOALS,
    "highway-v0",
    "merge-v0",
    "two-way-v0",
    "racetrack-v0",
    "lane-keeping-v0",
]


def forms(scene):
    """Shapes and types of a scene's arrays."""
    return [(np.shape(leaf), leaf.dtype) for leaf in jax.tree.leaves(scene)]


FORMS = forms(scene_of())


def with_ego(scene, lane=None, at=0.0):
    """An IDM vehicle instead of the ego of a scene, at the same place or at a place on
    a lane.
    """
    environment = gym.make(scene).unwrapped
    environment.reset(seed=0)
    old = environment.vehicle
    road = environment.road
    ego = IDMVehicle(road, old.position, old.heading, old.speed)
    if lane:
        ego = IDMVehicle.make_on_lane(road, lane, at, speed=10.0)
    road.vehicles = [ego if car is old else car for car in road.vehicles]
    return ego


def among(ego, lane, at):
    """Replace all other vehicles by one IDM vehicle at a place on a lane."""
    other = IDMVehicle.make_on_lane(ego.road, lane, at, speed=8.0)
    ego.road.vehicles = [ego, other]
    return other


def drive(scene, steps=80):
    """The ego's observation, the pose of its rear axle, its lane, and the positions of
    all, in every frame.
    """
    ego = with_ego(scene)
    goal = GOALS.get(scene)
    if goal:
        ego.plan_route_to(goal)
    for _ in range(steps):
        pose = (*(ego.position - ego.LENGTH / 2 * ego.direction), ego.heading)
        positions = np.array(
            [car.position for car in (*ego.road.vehicles, *ego.road.objects)]
        )
        yield observe_road(ego, goal), pose, ego.lane_index, positions
        ego.road.act()
        ego.road.step(1 / 15)


@pytest.mark.parametrize("scene", SCENES)
def test_observed_routes_are_drivable_and_positions_true(
    scene,
):
    before = None
    last = None
    for seen, pose, lane, positions in drive(scene):
        route = seen.route
        left, right = seen.edges
        assert forms(seen) == FORMS
        assert all(
            np.isfinite(leaf).all() for leaf in jax.tree.leaves(replace(seen, room=0.0))
        )
        assert np.abs(route.curvature).max() <= 0.2
        assert np.abs(np.diff(route.curvature)).max() < 0.1
        chords = np.diff(route.x) + 1j * np.diff(route.y)
        turns = np.angle(
            chords * np.exp(-0.5j * (route.heading[1:] + route.heading[:-1]))
        )
        assert np.abs(chords) == pytest.approx(2.0, abs=0.02)
        assert np.abs(turns).max() < 0.1 * 2.0 / 12
        assert (right - left >= 3.9).all()
        np.testing.assert_allclose(route.project(*pose), seen.robot[:3], atol=0.02)
        x, y, _ = seen.paths.place(seen.states[:, :1], seen.states[:, 1:2])
        found = np.stack([x, y], axis=-1)[seen.present] - positions
        assert (np.hypot(*found.T).min(axis=0, initial=np.inf) < 0.1).all()
        if before and (lane == last or lane[:2] != last[:2]):
            _, aside, _ = route.project(
                before.x[8:60], before.y[8:60], before.heading[8:60]
            )
            assert np.abs(aside).max() < 0.05
        before = route
        last = lane


def test_a_ramp_asks_for_a_lane_change_before_its_end():
    seen = observe_road(with_ego("merge-v0", ("k", "b", 0), 60.0))
    x = seen.route.x
    left, own, _ = seen.open
    assert seen.changes[1] == -1
    assert float(seen.room) == pytest.approx(100.0, abs=0.5)
    assert not left[x < 228].any()
    assert left[x > 232].all()
    assert own[x < 308].all()
    assert not own[x > 312].any()


def test_a_ramp_is_closed_to_cars_beside_it():
    beside = observe_road(with_ego("merge-v0", ("b", "c", 1), 10.0))
    assert not beside.open[2].any()
    assert beside.edges[1] == pytest.approx(2.0, abs=0.01)


def test_cars_before_an_intersection_may_take_three_paths():
    ego = with_ego("intersection-v0", ("o0", "ir0", 0), 80.0)
    among(ego, ("o2", "ir2", 0), 85.0).plan_route_to("o1")
    seen = observe_road(ego, "o1")
    assert seen.owners[seen.present].tolist() == [0, 0, 0]
    ends = np.stack([seen.paths.x[:3, -1], seen.paths.y[:3, -1]], axis=-1)
    assert len(np.unique(ends.round(-1), axis=0)) == 3


def test_cars_take_one_path_if_their_route_is_known():
    ego = with_ego("intersection-v0", ("o0", "ir0", 0), 80.0)
    among(ego, ("o2", "ir2", 0), 85.0).plan_route_to("o1")
    shown = observe_road(ego, "o1", intentions=True)
    assert shown.present.sum() == 1
    assert shown.paths.x[0, -1] < -50.0
    assert shown.paths.y[0, -1] == pytest.approx(-2.0, abs=0.1)


def test_cars_that_have_begun_to_turn_take_one_path():
    ego = with_ego("intersection-v0", ("o0", "ir0", 0), 80.0)
    among(ego, ("ir2", "il3", 0), 10.0)
    assert observe_road(ego, "o1").present.sum() == 1
