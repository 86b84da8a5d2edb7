"""Predictors of the literature: on moments made by hand, and on real driving where that is present."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from highway_env.road.lane import StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from msgspec import structs

from ms_highway.irl.lane_following import FIRST_KALMAN, fit_kalman, lane_modes
from ms_highway.irl.moments import cut_moments
from ms_highway.irl.outlook import expected_path
from ms_highway.irl.peers import FIRST_IDM, HIGHWAY_ENV_IDM, fit_idm, idm, steady_motion, turn_and_accelerate
from ms_highway.irl.recordings.recording import Recording

LANES = np.array([0.0, 3.4, 6.8])
PEERS = {
    "constant velocity": steady_motion,
    "turn and accelerate": turn_and_accelerate,
    "highway-env's IDM": lambda moments: idm(moments, HIGHWAY_ENV_IDM),
    "IDM": lambda moments: idm(moments, FIRST_IDM),
    "lane modes": lambda moments: lane_modes(moments, FIRST_KALMAN),
}


def driving(x, y, speed, *, acceleration=0.0, turn_rate=0.0, heading=0.0):
    """States of a car in 9 s, with x and y at 3 s."""
    time = 0.1 * (np.arange(91) - 30)
    headings, speeds = heading + turn_rate * time, speed + acceleration * time
    along, across = (np.cumsum(0.1 * speeds * way(headings)) for way in (np.cos, np.sin))
    return np.stack([x + along - along[30], y + across - across[30], headings, speeds], axis=-1)


def moment(*cars, number=3):
    """A moment of drivers on three lanes; by default the one at which 3 s of the past of all are known."""
    sizes, states = np.tile([5.0, 2.0], (len(cars), 1)), np.stack(cars, axis=1)
    moments = cut_moments([Recording("made", "made", states, np.arange(len(cars)), sizes, LANES, 3.4, 29.0)])
    return moments.of(np.arange(len(moments)) == number)


@pytest.mark.parametrize("name", PEERS)
def test_nothing_of_the_future_is_known(name):
    moments = moment(driving(0, 3.4, 15, acceleration=-0.5), driving(20, 3.4, 14), driving(5, 6, 15, heading=-0.03))
    blind = replace(moments, future=np.full_like(moments.future, np.nan))
    known, unknown = (PEERS[name](case) for case in (moments, blind))
    jax.tree.map(np.testing.assert_array_equal, known, unknown)
    np.testing.assert_allclose(np.sum(known.probability, axis=1), 1.0, rtol=1e-5)
    assert np.isfinite(known.path).all()


@pytest.mark.parametrize("name", PEERS)
def test_a_car_in_the_middle_of_an_empty_lane_keeps_its_velocity(name):
    path = expected_path(PEERS[name](moment(driving(0, 3.4, 29))))[0]  # at the speed limit, which IDM does not exceed
    np.testing.assert_allclose(path[:, 1], 3.4, atol=0.01)
    if "IDM" not in name:
        np.testing.assert_allclose(path[:, 0], 2.9 * np.arange(1, 51), rtol=1e-3)


@pytest.mark.parametrize("name", PEERS)
def test_drivers_of_whom_only_one_instant_was_seen_are_predicted(name):
    modes = PEERS[name](moment(driving(0, 3.4, 15), driving(20, 3.4, 15), number=0))
    assert np.isfinite(modes.path).all()
    assert np.argmax(modes.probability, axis=1).tolist() == [0, 0]


def test_turning_and_accelerating_are_exact_if_they_last_and_end_at_a_standstill():
    moments = moment(driving(0, 3.4, 15, acceleration=0.5, turn_rate=0.02))
    exact = expected_path(turn_and_accelerate(moments, fading=(1e4, 1e4)))[0]
    np.testing.assert_allclose(exact, moments.future[0, :, 0, :2], atol=0.5)
    path = expected_path(turn_and_accelerate(moment(driving(0, 3.4, 1, acceleration=-4.0)), fading=(1e4, 1e4)))[0]
    assert (np.diff(path[:, 0]) >= 0).all()
    assert path[-1, 0] < 0.5


def test_highway_envs_own_idm_vehicles_are_reproduced():
    cars = driving(0, 3.0, 20, heading=0.02), driving(30, 3.6, 14), driving(-10, 6.0, 18), driving(12, 7.0, 12)
    moments, network = moment(*cars), RoadNetwork()
    for y in LANES:
        network.add_lane("start", "end", StraightLane([-1e4, y], [1e4, y], width=3.4, speed_limit=29.0))
    road = Road(network, np_random=np.random.RandomState(0))
    road.vehicles = [IDMVehicle(road, state[:2], *state[2:], enable_lane_change=False) for state in moments.now[0, :4]]
    path = []
    for _ in range(50):
        road.act()
        for vehicle in road.vehicles:
            vehicle.step(0.1)
        path.append([vehicle.position.copy() for vehicle in road.vehicles])
    found = expected_path(idm(moments, HIGHWAY_ENV_IDM))
    np.testing.assert_allclose(found, np.moveaxis(path, 0, 1), atol=2e-3)


def test_drivers_made_by_idm_are_predicted_by_its_fit():
    truth = structs.replace(FIRST_IDM, speed=18.0, headway=0.8, gap=3.0)
    moments = moment(*(driving(-18.0 * n, 3.4, 14 + n % 2) for n in range(8)))
    paths = expected_path(idm(moments, truth))
    moments.future[0, :, :8, :2] = np.moveaxis(paths, 0, 1)
    found = fit_idm(moments, evaluations=40)
    fitted, first = (
        np.linalg.norm(expected_path(idm(moments, case)) - paths, axis=-1)[:, -1].mean() for case in (found, FIRST_IDM)
    )
    assert fitted < min(0.2, 0.1 * first)


def test_who_drifts_to_the_left_lane_probably_changes_to_it():
    keeping, left, right = (
        lane_modes(moment(driving(0, 3.4 + y, 15, heading=y / 30)), FIRST_KALMAN) for y in (0.0, -1.3, 1.3)
    )
    assert [int(np.argmax(modes.probability)) for modes in (keeping, left, right)] == [0, 1, 2]
    assert keeping.probability[0, 0] > 0.8
    np.testing.assert_allclose(left.probability[0], right.probability[0, np.array([0, 2, 1])], rtol=0.01)
    np.testing.assert_allclose(left.path[0, 1, -1, 1], 0.0, atol=0.5)  # in the left lane


def test_a_lane_that_does_not_exist_is_never_entered():
    modes = lane_modes(moment(driving(0, 0.0, 15, heading=-0.03), driving(0, 6.8, 15, heading=0.03)), FIRST_KALMAN)
    assert modes.probability[0, 1] == modes.probability[1, 2] == 0.0
    assert (np.asarray(modes.probability)[:, [1, 2]].max(axis=1) > 0.0).all()  # to the lane that does exist
    ends = np.asarray(modes.path)[:, :, -1, 1]
    assert ((ends > -1.7) & (ends < 8.5)).all()


def test_fitted_parameters_are_plain_numbers():
    moments = moment(driving(0, 3.4, 15), driving(20, 3.4, 15))
    for fit in (fit_idm, fit_kalman):
        assert all(type(value) is float for value in structs.astuple(fit(moments, evaluations=1)))


def test_real_drivers_are_predicted_better_by_fitted_parameters(us101):
    moments = cut_moments(us101[::8])

    def error(modes):
        return np.nanmean(np.linalg.norm(expected_path(modes)[:, 29] - moments.recorded[:, 29], axis=-1))

    fitted = error(idm(moments, fit_idm(moments, evaluations=20)))
    assert fitted < error(steady_motion(moments)) < error(idm(moments, HIGHWAY_ENV_IDM))
