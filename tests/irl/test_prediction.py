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
from ms_highway.irl.recording import Recording, straight_on
from ms_highway.irl.snapshots import cut_snapshots

DRIVERS = shipped("us101").drivers
LANES = np.array([0.0, 3.4, 6.8])
CAR = (0.0, 0.0, 0.0, 20.0)


def recorded(*starts, drivers=1):
    """A recording of cars that keep their velocity for 6 s, of which the first are drivers to predict."""
    states = [straight_on(np.array([start]), start[3] * 0.1 * np.arange(61)) for start in starts]
    sizes = np.tile([5.0, 2.0], (len(starts), 1))
    return Recording("made", "made", np.stack(states, axis=1), np.arange(drivers), sizes, LANES, 3.4, 29.0)


def following(gap, leader=15.0):
    """A driver at 15 m/s behind a leader, with a gap between their bumpers."""
    return recorded((0.0, 3.4, 0.0, 15.0), (gap + 5.0, 3.4, 0.0, leader))


def snapshot(recording, second):
    snapshots = cut_snapshots([recording])
    return snapshots.of(np.arange(len(snapshots)) == second)


def mixture(path):
    """The predicted distribution with a single mode."""
    return Mixture(Modes(np.ones((len(path), 1)), path[:, None]), DRIVERS.spread)


@pytest.mark.parametrize("name", PREDICTORS)
def test_every_predictor_knows_nothing_of_the_future(name):
    seen = snapshot(following(60.0, leader=0.0), 0)
    blind = replace(seen, future=np.full_like(seen.future, np.nan))
    expected, found = (expected_path(predict_with(name, each, DRIVERS).modes) for each in (seen, blind))
    np.testing.assert_array_equal(found, expected)
    assert (found[0, -1, 0] < 60.0) == (name != "constant_velocity"), "it brakes behind a standing car"


def test_highway_envs_own_idm_vehicles_are_reproduced():
    cars = (0, 3.0, 0.02, 20), (30, 3.6, 0, 14), (-10, 6.0, 0, 18), (12, 7.0, 0, 12)
    snapshots, network = snapshot(recorded(*cars, drivers=4), 3), RoadNetwork()
    for y in LANES:
        network.add_lane("start", "end", StraightLane([-1e4, y], [1e4, y], width=3.4, speed_limit=29.0))
    road = Road(network, np_random=np.random.RandomState(0))
    for state in snapshots.now[0, :4]:
        road.vehicles.append(IDMVehicle(road, state[:2], *state[2:], enable_lane_change=False))
    path = []
    for _ in range(50):
        road.act()
        for vehicle in road.vehicles:
            vehicle.step(0.1)  # without collisions
        path.append([vehicle.position.copy() for vehicle in road.vehicles])
    found = expected_path(predict_peer("idm", snapshots, {}))
    np.testing.assert_allclose(found, np.moveaxis(path, 0, 1), atol=2e-3)


def test_errors_of_a_known_path_are_its_distances_from_the_recording():
    snapshots = cut_snapshots([following(20.0)])
    exact = expected_path(predict_peer("constant_velocity", snapshots, {})).astype(float)
    fast = exact + [3.0, 0.0] * (0.1 * np.arange(1, 51))[:, None]  # by 3 m/s too fast
    right, wrong = (metrics(prediction_errors(mixture(path), snapshots.recorded)) for path in (exact, fast))
    assert right["ade"] == pytest.approx(dict.fromkeys("1235", 0.0), abs=1e-4)
    assert wrong["fde"] == wrong["rmse"] == pytest.approx({"1": 3.0, "2": 6.0, "3": 9.0, "5": 15.0}, abs=1e-3)
    assert wrong["ade"]["1"] == pytest.approx(1.65, abs=1e-3)
    assert set(wrong["miss"].values()) == {1.0}
    assert wrong["log_p"]["5"] < right["log_p"]["5"]


def test_a_driver_who_drifts_to_the_next_lane_is_expected_there():
    drifting = following(20.0)
    drifting.states[:, 0, 2] = -0.06
    drifting.states[:, 0, 1] += 1.0 - 0.9 * 0.1 * np.arange(61)  # in the snapshot, half way to the next lane
    modes = predict_drivers(snapshot(drifting, 2), DRIVERS.bare)
    assert modes.probability[0].argmax() == 1
    assert np.asarray(modes.path)[0, 1, -1, 1] == pytest.approx(0.0, abs=0.7)
    assert predict_drivers(snapshot(following(20.0), 5), DRIVERS.bare).probability[0].argmax() == 0


def scale_and_freedom(spread):
    """The scales after each step, and the degrees of freedom after 5 s."""
    return np.asarray(spread.scales(1, 50))[0], float(spread.freedom(50)[-1])


def test_the_fitted_spread_holds_as_many_drivers_as_it_says():
    random, time = np.random.default_rng(0), 0.1 * np.arange(1, 51)
    scales = np.stack([0.3 * time**1.5, 0.1 * time], axis=-1)
    positions = random.normal(size=(2000, 50, 2)) * scales / np.sqrt(random.chisquare(4, size=(2000, 1, 1)) / 4)
    modes = mixture(np.zeros((2000, 50, 2), np.float32)).modes
    spread = fit_spread(modes, positions)
    fitted, freedom = scale_and_freedom(spread)
    np.testing.assert_allclose(fitted[9::10], scales[9::10], rtol=0.15)
    density = multivariate_t.logpdf(positions[:, -1], shape=np.diag(fitted[-1] ** 2), df=freedom)
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
    run(f"irl fit --data {data} --learn headway closing_speed comfort_steering --out {theta}")
    assert load(theta).log_likelihood["held_out"] is not None
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
    known = predict_with(predictor, snapshot(recording, 3), DRIVERS).modes
    found = ms_highway.predict(recording.states[:31], LANES, 29.0, seconds=3, predictor=predictor, lane_width=3.4)
    assert found.mean.shape == (2, 30, 2)
    assert found.times[[0, -1]].tolist() == pytest.approx([0.1, 3.0])
    np.testing.assert_allclose(found.weights[0], np.asarray(known.probability)[0], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found.means[0], np.asarray(known.path)[0, :, :30], atol=2e-3)
    np.testing.assert_allclose(found.weights.sum(axis=1), 1.0, rtol=1e-5)
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()


def test_half_of_the_drivers_are_within_the_half_ellipse_of_a_predicted_covariance():
    found = ms_highway.predict([CAR], [0.0], 30.0, predictor="constant_velocity")
    random, (scales, freedom) = np.random.default_rng(0), scale_and_freedom(DRIVERS.peers["constant_velocity"].spread)
    drawn = scales[-1] * random.standard_normal((20000, 2)) / np.sqrt(random.chisquare(freedom, (20000, 1)) / freedom)
    far = np.einsum("ni,ij,nj->n", drawn, np.linalg.inv(found.covariances[0, -1]), drawn)
    assert np.mean(far < 2 * np.log(2)) == pytest.approx(0.5, abs=0.02)


def test_impossible_predictions_are_refused():
    with pytest.raises(ValueError, match=r"states are of shape \(4,\)"):
        ms_highway.predict(CAR, LANES, 30.0)
    with pytest.raises(ValueError, match="predictor is 'imm'; choose one of model, constant_velocity, idm, fitted_idm"):
        ms_highway.predict([CAR], LANES, 30.0, predictor="imm")
    with pytest.raises(ValueError, match="two groups"):
        evaluate([following(20.0)])
    with pytest.raises(ValueError, match=r"fitted_idm; learn it .* irl fit"):
        predict_with("fitted_idm", cut_snapshots([following(20.0)]), structs.replace(DRIVERS, peers={}))
