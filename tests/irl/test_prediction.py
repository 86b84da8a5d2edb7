"""Prediction of recorded drivers, on driving made by hand and on real driving where that is present."""

import json
from dataclasses import replace

import numpy as np
import pytest
from commands import run
from highway_env.road.lane import StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from msgspec import structs
from scipy.stats import multivariate_t

import ms_highway
from ms_highway.game.learned_reward import load, shipped
from ms_highway.irl.evaluation import evaluate, metrics, prediction_errors
from ms_highway.irl.mixture import Mixture, Modes, density_level, expected_path, fit_spread, log_density
from ms_highway.irl.prediction import PREDICTORS, predict_drivers, predict_peer, predict_with
from ms_highway.irl.recording import Recording
from ms_highway.irl.snapshots import cut_snapshots

DRIVERS = shipped("us101").drivers
LANES = np.array([0.0, 3.4, 6.8])


def driving(x, y, speed, heading=0.0, times=61):
    """States of a car that keeps its velocity, with x and y at first."""
    time = 0.1 * np.arange(times)
    position = x + speed * np.cos(heading) * time, y + speed * np.sin(heading) * time
    return np.stack([*position, heading + 0 * time, speed + 0 * time], axis=-1)


def recorded(*cars, drivers=1):
    """A recording of cars of which the first are drivers to predict."""
    sizes, states = np.tile([5.0, 2.0], (len(cars), 1)), np.stack(cars, axis=1)
    return Recording("made", "made", states, np.arange(drivers), sizes, LANES, 3.4, 29.0)


def following(gap, leader=15.0):
    """A driver at 15 m/s behind a leader, a gap between bumpers apart."""
    return recorded(driving(0.0, 3.4, 15.0), driving(gap + 5.0, 3.4, leader))


def nth(recording, number):
    snapshots = cut_snapshots([recording])
    return snapshots.of(np.arange(len(snapshots)) == number)


@pytest.mark.parametrize("name", PREDICTORS)
def test_every_predictor_knows_nothing_of_the_future(name):
    snapshots = nth(following(60.0, leader=0.0), 0)
    blind = replace(snapshots, future=np.full_like(snapshots.future, np.nan))
    seeing, guessing = (expected_path(predict_with(name, each, DRIVERS).modes) for each in (snapshots, blind))
    np.testing.assert_array_equal(guessing, seeing)
    assert (seeing[0, -1, 0] < 60.0) == (name != "constant_velocity"), "it brakes behind a car that stands"


def test_highway_envs_own_idm_vehicles_are_reproduced():
    cars = driving(0, 3.0, 20, 0.02), driving(30, 3.6, 14), driving(-10, 6.0, 18), driving(12, 7.0, 12)
    snapshots, network = nth(recorded(*cars, drivers=4), 3), RoadNetwork()
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
    found = expected_path(predict_peer("idm", snapshots, {}))
    np.testing.assert_allclose(found, np.moveaxis(path, 0, 1), atol=2e-3)


def test_errors_are_what_a_known_path_is_off():
    snapshots = cut_snapshots([following(20.0)])
    exact = expected_path(predict_peer("constant_velocity", snapshots, {})).astype(float)
    off = exact + np.stack([3.0 * 0.1 * np.arange(1, 51), np.zeros(50)], axis=-1)  # 3 m/s too fast
    right, wrong = (
        metrics(
            prediction_errors(
                Mixture(Modes(np.ones((len(path), 1)), path[:, None]), DRIVERS.spread), snapshots.recorded
            )
        )
        for path in (exact, off)
    )
    assert right["ade"] == pytest.approx(dict.fromkeys("1235", 0.0), abs=1e-4)
    assert wrong["fde"] == wrong["rmse"] == pytest.approx({"1": 3.0, "2": 6.0, "3": 9.0, "5": 15.0}, abs=1e-3)
    assert wrong["ade"]["1"] == pytest.approx(1.65, abs=1e-3)
    assert set(wrong["miss"].values()) == {1.0}
    assert wrong["log_p"]["5"] < right["log_p"]["5"]


def test_who_drifts_to_the_next_lane_is_expected_there():
    drifting = following(20.0)
    drifting.states[:, 0, 2] = -0.06
    drifting.states[:, 0, 1] += 1.0 - 0.9 * 0.1 * np.arange(61)  # half way at the moment that is looked at
    modes = predict_drivers(nth(drifting, 2), DRIVERS.bare)
    assert modes.probability[0].argmax() == 1
    assert np.asarray(modes.path)[0, 1, -1, 1] == pytest.approx(0.0, abs=0.7)
    assert predict_drivers(nth(following(20.0), 5), DRIVERS.bare).probability[0].argmax() == 0


def test_the_spread_that_is_fitted_holds_as_many_drivers_as_it_says():
    random, time = np.random.default_rng(0), 0.1 * np.arange(1, 51)
    scales = np.stack([0.3 * time**1.5, 0.1 * time], axis=-1)
    positions = random.normal(size=(2000, 50, 2)) * scales / np.sqrt(random.chisquare(4, size=(2000, 1, 1)) / 4)
    modes = Modes(np.ones((2000, 1)), np.zeros((2000, 1, 50, 2), np.float32))
    spread = fit_spread(modes, positions)
    np.testing.assert_allclose(np.asarray(spread.scales(1, 50))[0, 9::10], scales[9::10], rtol=0.15)
    scale, freedom = np.asarray(spread.scales(1, 50))[0, -1], float(spread.freedom(50)[-1])
    density = multivariate_t.logpdf(positions[:, -1], shape=np.diag(scale**2), df=freedom)
    np.testing.assert_allclose(log_density(Mixture(modes, spread), positions)[:, -1], density, rtol=1e-3)
    level = density_level(Mixture(modes, spread), positions)
    for share in (0.5, 0.9):
        np.testing.assert_allclose((level[:, 9::20] < share).mean(axis=0), share, atol=0.04)


@pytest.mark.slow
def test_the_commands_fit_and_evaluate(us101_directory, tmp_path, capsys):
    data, theta = tmp_path / "two", tmp_path / "theta.json"
    data.mkdir()
    for short in ("8_4", "14_1"):
        (path,) = us101_directory.glob(f"*-{short}_*.xml.gz")
        (data / path.name).symlink_to(path)
    options = f"--data {data} --learn headway closing_speed comfort_steering"
    run(f"irl fit {options} --out {theta}")
    learned = load(theta)
    assert learned.log_likelihood["held_out"] is not None
    assert "closing_speed" in capsys.readouterr().out
    run(f"irl evaluate --folds 2 --data {data} --json --figures {tmp_path}")
    found = json.loads(capsys.readouterr().out)
    assert len(found["folds"]) == 2
    assert list(found["predictors"]) == list(PREDICTORS)
    assert found["windows"] > found["tracks"] > 20
    model, kept, *_ = found["predictors"].values()
    assert model["fde"]["5"] < kept["fde"]["5"]
    assert model["log_p"]["5"] > kept["log_p"]["5"]
    assert {path.stem for path in tmp_path.glob("*.png")} == {"errors", "likelihood", "calibration"}


@pytest.mark.parametrize("predictor", [pytest.param("model", marks=pytest.mark.slow), "fitted_idm"])
def test_a_moment_is_predicted_as_it_would_be_in_a_recording(predictor):
    recording = following(20.0)
    known = predict_with(predictor, nth(recording, 3), DRIVERS).modes
    past, lanes = recording.states[:31], recording.lanes
    found = ms_highway.predict(past, lanes, 29.0, seconds=3, predictor=predictor, lane_width=3.4)
    assert found.mean.shape == (2, 30, 2)
    assert found.times[[0, -1]].tolist() == pytest.approx([0.1, 3.0])
    np.testing.assert_allclose(found.weights[0], np.asarray(known.probability)[0], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found.means[0], np.asarray(known.path)[0, :, :30], atol=2e-3)
    np.testing.assert_allclose(found.weights.sum(axis=1), 1.0, rtol=1e-5)
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()


def test_half_of_the_drivers_are_within_the_ellipse_of_a_covariance_that_holds_half():
    found = ms_highway.predict([[0.0, 0.0, 0.0, 20.0]], [0.0], 30.0, predictor="constant_velocity")
    random, spread = np.random.default_rng(0), DRIVERS.peers["constant_velocity"].spread
    scales, freedom = np.asarray(spread.scales(1, 50))[0, -1], float(spread.freedom(50)[-1])
    drawn = scales * random.standard_normal((20000, 2)) / np.sqrt(random.chisquare(freedom, (20000, 1)) / freedom)
    far = np.einsum("ni,ij,nj->n", drawn, np.linalg.inv(found.covariances[0, -1]), drawn)
    assert np.mean(far < 2 * np.log(2)) == pytest.approx(0.5, abs=0.02)


def test_what_cannot_be_predicted_is_refused():
    with pytest.raises(ValueError, match=r"states are of shape \(4,\)"):
        ms_highway.predict([0.0, 0.0, 0.0, 20.0], [0.0, 4.0], 30.0)
    with pytest.raises(ValueError, match="predictor is 'imm'; choose one of model, constant_velocity, idm, fitted_idm"):
        ms_highway.predict([[0.0, 0.0, 0.0, 20.0]], [0.0, 4.0], 30.0, predictor="imm")
    with pytest.raises(ValueError, match="two groups"):
        evaluate([following(20.0)])
    with pytest.raises(ValueError, match=r"fitted_idm; learn it .* irl fit"):
        predict_with("fitted_idm", cut_snapshots([following(20.0)]), structs.replace(DRIVERS, peers={}))
