"""Prediction of recorded drivers, on driving made by hand and on real driving where that is present."""

import json
from dataclasses import replace

import numpy as np
import pytest
from commands import run
from msgspec import structs

import ms_highway
from ms_highway.game.learned_drivers import Spread
from ms_highway.game.learned_reward import load, shipped
from ms_highway.irl.evaluation import (
    LEVELS,
    Errors,
    driving_regimes,
    evaluate,
    metrics,
    metrics_by_regime,
    prediction_errors,
)
from ms_highway.irl.mixture import Mixture, Modes, density_level, expected_path, fit_spread, log_density, one_mode
from ms_highway.irl.prediction import PREDICTORS, predict_constant_velocity, predict_drivers, predict_with
from ms_highway.irl.recording import Recording
from ms_highway.irl.snapshots import cut_snapshots

DRIVERS = shipped("us101").drivers


def following(gap, speed=15.0, leader=15.0, times=61):
    """A recording of a driver that keeps its velocity and of a leader, a gap between bumpers apart."""
    states = np.zeros((times, 2, 4))
    states[..., 1], states[..., 3] = 3.4, (speed, leader)
    states[..., 0] = [0.0, gap + 5.0] + 0.1 * np.arange(times)[:, None] * states[..., 3]
    sizes, lanes = np.tile([5.0, 2.0], (2, 1)), np.array([0.0, 3.4, 6.8])
    return Recording("a pair", "a pair", states, np.array([0]), sizes, lanes, 3.4, 29.0)


def nth(recording, number):
    snapshots = cut_snapshots([recording])
    return snapshots.of(np.arange(len(snapshots)) == number)


def test_a_driver_is_predicted_from_every_full_second_that_a_second_follows():
    snapshots = cut_snapshots([following(20.0)])
    assert len(snapshots) == snapshots.predicted.sum() == 6
    assert np.isfinite(snapshots.past[0, :, 0]).all(axis=-1).sum() == 1  # nothing is known before the first
    with pytest.raises(ValueError, match=r"seen for 1 s"):
        cut_snapshots([following(4.0, times=8)])


def test_errors_are_what_a_known_path_is_off():
    snapshots = cut_snapshots([following(20.0)])
    exact = expected_path(predict_constant_velocity(snapshots)).astype(float)
    off = exact + np.stack([3.0 * 0.1 * np.arange(1, 51), np.zeros(50)], axis=-1)  # 3 m/s too fast
    right, wrong = (
        metrics(prediction_errors(Mixture(one_mode(path), DRIVERS.spread), snapshots.recorded)) for path in (exact, off)
    )
    assert tuple(right) == ("fde", "ade", "rmse", "miss", "log_p", *(f"inside {level}" for level in LEVELS))
    assert right["ade"] == pytest.approx(dict.fromkeys("1235", 0.0), abs=1e-4)
    assert wrong["fde"] == wrong["rmse"] == pytest.approx({"1": 3.0, "2": 6.0, "3": 9.0, "5": 15.0}, abs=1e-3)
    assert wrong["ade"]["1"] == pytest.approx(1.65, abs=1e-3)
    assert set(wrong["miss"].values()) == {1.0}
    assert wrong["log_p"]["5"] < right["log_p"]["5"]


@pytest.mark.slow
def test_learned_drivers_brake_behind_a_car_that_stands_and_know_nothing_of_the_future():
    snapshots = cut_snapshots([following(60.0, leader=0.0)])
    blind = replace(snapshots, future=np.full_like(snapshots.future, np.nan))
    seeing, guessing = (np.asarray(predict_drivers(each, DRIVERS.bare).path) for each in (snapshots, blind))
    assert seeing[0, 0, -1, 0] < 60.0
    np.testing.assert_array_equal(guessing, seeing)


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
    level = density_level(Mixture(modes, spread), positions)
    for share in (0.5, 0.9):
        np.testing.assert_allclose((level[:, 9::20] < share).mean(axis=0), share, atol=0.04)


def test_the_density_of_two_modes_integrates_to_one():
    spread, grid = Spread((-1.0, 0.5, 0.0), (-1.0, 0.5, 0.0), (0.2, 0.1), (5.0, 0.5)), np.arange(-15, 15, 0.1)
    points = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 1, 2).astype(np.float32)
    path = np.zeros((len(points), 2, 10, 2), np.float32)
    path[:, 1, :, 1] = 3.0
    modes = Modes(np.tile([0.3, 0.7], (len(points), 1)), path)
    density = np.exp(log_density(Mixture(modes, spread), np.tile(points, (10, 1))))
    np.testing.assert_allclose(density.sum(axis=0) * 0.01, 1.0, atol=0.01)


def test_situations_are_told_apart_by_what_drivers_did_and_counted():
    moving, time = following(20.0), 0.1 * np.arange(61)
    moving.states[:, 0, 1] -= 1.2 * time
    moving.states[:, 0, 3] -= 2.0 * time
    for recording, regimes in ((moving, {"lane change", "braking"}), (following(20.0, 3.0, 3.0), {"slow"})):
        found = driving_regimes(cut_snapshots([recording]))
        assert {name for name, chosen in found.items() if chosen[0]} == regimes
    snapshots = cut_snapshots([following(20.0), following(60.0)])
    ones = np.where(np.isfinite(snapshots.recorded[..., 0]), 1.0, np.nan)
    rows = metrics_by_regime({"late": Errors(ones, 0 * ones, ones)}, driving_regimes(snapshots))["distance"]
    assert list(rows) == ["no leader", "following"]
    assert rows["following"] == {"windows": {"1": 4, "2": 4, "3": 4, "5": 2}, "late": dict.fromkeys("1235", 1)}


def test_rewards_without_a_peer_and_too_few_folds_are_refused():
    with pytest.raises(ValueError, match="two groups"):
        evaluate([following(20.0)])
    snapshots, fitted = cut_snapshots([following(20.0)]), DRIVERS.peers["fitted_idm"]
    damaged = structs.replace(fitted, parameters={"gap": 2.0})
    for peers, message in (({"idm": fitted}, "fitted_idm; learn it .* irl fit"), ({"fitted_idm": damaged}, "`speed`")):
        with pytest.raises(ValueError, match=message):
            predict_with("fitted_idm", snapshots, structs.replace(DRIVERS, peers=peers))


def test_real_drivers_are_predicted_better_by_what_was_learned_than_by_any_peer(us101):
    snapshots = cut_snapshots(us101[::5])
    learned, *peers = (
        metrics(prediction_errors(predict_with(name, snapshots, DRIVERS), snapshots.recorded)) for name in PREDICTORS
    )
    for horizon in ("3", "5"):
        assert learned["fde"][horizon] < 0.8 * peers[0]["fde"][horizon]  # of constant velocity
        assert learned["fde"][horizon] < min(peer["fde"][horizon] for peer in peers)
    assert learned["log_p"]["3"] > max(peer["log_p"]["3"] for peer in peers)


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


def test_a_reward_without_drivers_predicts_none(refused):
    assert "--theta demonstrations has no drivers" in refused("irl evaluate --theta demonstrations --data .")


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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": [0.0, 0.0, 0.0, 20.0]}, r"states are of shape \(4,\)"),
        ({"speed_limit": 0}, "speed_limit cannot be 0; give positive"),
        ({"seconds": 8}, "seconds cannot be 8"),
        ({"predictor": "imm"}, "predictor is 'imm'; choose one of model, constant_velocity, idm, fitted_idm"),
    ],
)
def test_what_cannot_be_predicted_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        ms_highway.predict(**{"states": [[0.0, 0.0, 0.0, 20.0]], "lanes": [0.0, 4.0], "speed_limit": 30.0} | changes)
