"""Predictors of the literature, on snapshots made by hand, and on real driving where that is present."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from highway_env.road.lane import StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from msgspec import structs

from ms_highway.irl.mixture import expected_path
from ms_highway.irl.prediction import FIRST_IDM, HIGHWAY_ENV_IDM, fit_idm, predict_constant_velocity, predict_idm
from ms_highway.irl.recording import Recording
from ms_highway.irl.snapshots import cut_snapshots

LANES = np.array([0.0, 3.4, 6.8])


def driving(x, y, speed, *, heading=0.0):
    """States of a car that keeps its velocity for 9 s, with x and y at 3 s."""
    time = 0.1 * (np.arange(91) - 30)
    position = x + speed * np.cos(heading) * time, y + speed * np.sin(heading) * time
    return np.stack([*position, heading + 0 * time, speed + 0 * time], axis=-1)


def snapshot_of(*cars):
    """The moment of drivers on three lanes at which 3 s of the past of all are known."""
    sizes, states = np.tile([5.0, 2.0], (len(cars), 1)), np.stack(cars, axis=1)
    snapshots = cut_snapshots([Recording("made", "made", states, np.arange(len(cars)), sizes, LANES, 3.4, 29.0)])
    return snapshots.of(np.arange(len(snapshots)) == 3)


@pytest.mark.parametrize("peer", [predict_constant_velocity, lambda snapshots: predict_idm(snapshots, HIGHWAY_ENV_IDM)])
def test_peers_know_nothing_of_the_future(peer):
    snapshots = snapshot_of(driving(0, 3.4, 15), driving(20, 3.4, 14), driving(5, 6, 15, heading=-0.03))
    blind = replace(snapshots, future=np.full_like(snapshots.future, np.nan))
    jax.tree.map(np.testing.assert_array_equal, peer(snapshots), peer(blind))


def test_highway_envs_own_idm_vehicles_are_reproduced():
    cars = driving(0, 3.0, 20, heading=0.02), driving(30, 3.6, 14), driving(-10, 6.0, 18), driving(12, 7.0, 12)
    snapshots, network = snapshot_of(*cars), RoadNetwork()
    for y in LANES:
        network.add_lane("start", "end", StraightLane([-1e4, y], [1e4, y], width=3.4, speed_limit=29.0))
    road = Road(network, np_random=np.random.RandomState(0))
    road.vehicles = [
        IDMVehicle(road, state[:2], *state[2:], enable_lane_change=False) for state in snapshots.now[0, :4]
    ]
    path = []
    for _ in range(50):
        road.act()
        for vehicle in road.vehicles:
            vehicle.step(0.1)
        path.append([vehicle.position.copy() for vehicle in road.vehicles])
    found = expected_path(predict_idm(snapshots, HIGHWAY_ENV_IDM))
    np.testing.assert_allclose(found, np.moveaxis(path, 0, 1), atol=2e-3)


def test_drivers_made_by_idm_are_predicted_by_its_fit_whose_parameters_are_plain_numbers():
    truth = structs.replace(FIRST_IDM, speed=18.0, headway=0.8, gap=3.0)
    snapshots = snapshot_of(*(driving(-18.0 * n, 3.4, 14 + n % 2) for n in range(8)))
    paths = expected_path(predict_idm(snapshots, truth))
    snapshots.future[0, :, :8, :2] = np.moveaxis(paths, 0, 1)
    found = fit_idm(snapshots)
    fitted, first = (
        np.linalg.norm(expected_path(predict_idm(snapshots, case)) - paths, axis=-1)[:, -1].mean()
        for case in (found, FIRST_IDM)
    )
    assert fitted < min(0.2, 0.1 * first)
    assert all(type(value) is float for value in structs.astuple(found))
