"""Prediction of recorded drivers, on driving made by hand and on real driving where
that is present.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from commands import run
from highway_env.road.lane import StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from msgspec import structs
from recordings import car, pedestrian, scenario
from scipy import stats

import ms_highway
from ms_highway.data.learned_reward import load, save, shipped
from ms_highway.irl.commonroad import read_directory
from ms_highway.irl.evaluation import evaluate, metrics, prediction_errors
from ms_highway.irl.mixture import (
    Mixture,
    Modes,
    density_level,
    expected_path,
    fit_spread,
    log_density,
)
from ms_highway.irl.peers import predict_peer
from ms_highway.irl.prediction import (
    PREDICTORS,
    predict_drivers,
    predict_with,
)
from ms_highway.irl.recording import Recording, known_from, sources
from ms_highway.irl.snapshots import cut_snapshots

DRIVERS = shipped("us101").drivers
# As many as recordings are padded to: the same program predicts moments.
LANES = 3.4 * np.arange(6)


def recorded(*cars, drivers=1):
    """Return a recording of 6 s. All cars keep their speed and lane; predictors predict
    the first ``drivers`` cars.
    """
    first = np.array(cars, float)
    states = np.linspace(first, first + 6 * first[:, 3:] * [1, 0, 0, 0], 61)
    sizes = np.tile([5.0, 2.0], (len(cars), 1))
    return Recording(
        "made", "made", states, np.arange(drivers), sizes, LANES, 3.4, 29.0
    )


def following():
    """A driver at 15 m/s behind a leader, with a gap of 20 m between their bumpers."""
    return recorded((0.0, 3.4, 0.0, 15.0), (25.0, 3.4, 0.0, 15.0))


def snapshot(recording, second):
    return cut_snapshots([recording]).of([second])


@pytest.mark.parametrize("predictor", PREDICTORS)
def test_a_moment_is_predicted_as_in_a_recording(predictor):
    """The future of the recording is not used. Of 50 cars, the first comes up to a
    standing one, and 48 come into sight only at this moment.
    """
    behind = [(-40.0 * row, y, 0.0, 15.0) for row in range(1, 9) for y in LANES]
    recording = recorded(
        (0.0, 3.4, 0.0, 15.0), (105.0, 3.4, 0.0, 0.0), *behind, drivers=50
    )
    recording.states[:30, 2:] = np.nan
    (weights, paths), spread = predict_with(predictor, snapshot(recording, 3), DRIVERS)
    # Whole turns of headings change nothing.
    states = recording.states[:31] + np.array([0, 0, 2 * np.pi, 0])
    found = ms_highway.predict(
        states, LANES, 29.0, seconds=4, predictor=predictor, lane_width=3.4
    )
    np.testing.assert_allclose(found.times, 0.1 * np.arange(1, 41))
    np.testing.assert_allclose(found.weights, weights, rtol=1e-4)
    np.testing.assert_allclose(found.means, paths[:, :, :40], atol=2e-3)
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()
    assert (found.mean[0, -1, 0] < 100.0) == (predictor != "constant_velocity"), (
        "it brakes behind the standing car"
    )
    scales = spread.scales(len(found.covariances), 40)
    variances = found.covariances.diagonal(axis1=-2, axis2=-1) / scales**2
    freedom = np.asarray(spread.freedom(40))[:, None]
    inside = stats.f.cdf(np.log(2) * variances, 2, freedom)
    np.testing.assert_allclose(
        inside,
        0.5,
        rtol=1e-3,
        err_msg="half of the drivers are within the half-ellipse",
    )


def test_highway_envs_own_idm_vehicles_are_reproduced():
    cars = (0, 3.0, 0.02, 20), (30, 3.6, 0, 14), (-10, 6.0, 0, 18), (12, 7.0, 0, 12)
    snapshots = snapshot(recorded(*cars, drivers=4), 3)
    network = RoadNetwork()
    for y in LANES:
        lane = StraightLane([-1e4, y], [1e4, y], width=3.4, speed_limit=29.0)
        network.add_lane("start", "end", lane)
    road = Road(network)
    for x, y, heading, speed in snapshots.now[0, :4]:
        start = np.array([x, y])
        vehicle = IDMVehicle(road, start, heading, speed, enable_lane_change=False)
        road.vehicles.append(vehicle)
    path = []
    for _ in range(50):
        road.act()
        for vehicle in road.vehicles:
            vehicle.step(0.1)  # without collisions
        path.append([vehicle.position.copy() for vehicle in road.vehicles])
    found = expected_path(predict_peer("idm", snapshots, {}))
    np.testing.assert_allclose(found, np.moveaxis(path, 0, 1), atol=2e-3)


def test_errors_of_a_known_path_are_its_distances():
    snapshots = cut_snapshots([following()])
    exact = predict_with("constant_velocity", snapshots, DRIVERS)
    times = 0.1 * np.arange(1, 51)
    paths = np.asarray(exact.modes.path) + [3.0, 0.0] * times[:, None]  # 3 m/s too fast
    fast = exact._replace(modes=exact.modes._replace(path=paths))
    right, wrong = (
        metrics(prediction_errors(each, snapshots.recorded)) for each in (exact, fast)
    )
    assert max(right["ade"].values()) < 1e-4
    expected = pytest.approx({"1": 3.0, "2": 6.0, "3": 9.0, "5": 15.0}, abs=1e-3)
    assert wrong["fde"] == wrong["rmse"] == expected
    assert wrong["ade"]["1"] == pytest.approx(1.65, abs=1e-3)
    assert set(wrong["miss"].values()) == {1.0}
    assert wrong["log_p"]["5"] < right["log_p"]["5"]


def test_a_drifting_driver_is_expected_in_the_next_lane():
    drifting = following()
    drifting.states[:, 0, 2] = -0.06
    # In the snapshot, it is half way to the next lane.
    drifting.states[:, 0, 1] += 1.0 - 0.9 * 0.1 * np.arange(61)
    modes = predict_drivers(snapshot(drifting, 2), DRIVERS)
    assert modes.probability[0].argmax() == 1
    assert modes.path[0, 1, -1, 1] == pytest.approx(0.0, abs=0.7)
    straight_on = predict_drivers(snapshot(following(), 5), DRIVERS)
    assert straight_on.probability[0].argmax() == 0


def test_the_fitted_spread_holds_as_many_drivers_as_it_says():
    random = np.random.default_rng(0)
    time = 0.1 * np.arange(1, 51)
    scales = np.stack([0.3 * time**1.5, 0.1 * time], axis=-1)
    normal = random.normal(size=(1000, 50, 2))
    stretch = np.sqrt(random.chisquare(4, size=(1000, 1, 1)) / 4)
    positions = normal * scales / stretch
    modes = Modes(np.ones((1000, 1)), np.zeros((1000, 1, 50, 2), np.float32))
    fitted = Mixture(modes, fit_spread(modes, positions))
    found = np.asarray(fitted.spread.scales(1, 50))[0]
    freedom = float(fitted.spread.freedom(50)[-1])
    np.testing.assert_allclose(found[9::10], scales[9::10], rtol=0.15)
    shape = np.diag(found[-1] ** 2)
    density = stats.multivariate_t.logpdf(positions[:, -1], shape=shape, df=freedom)
    own_density = log_density(fitted, positions)[:, -1]
    np.testing.assert_allclose(own_density, density, rtol=1e-3)
    level = density_level(fitted, positions)
    for share in (0.5, 0.9):
        inside = (level[:, 9::20] < share).mean(axis=0)
        np.testing.assert_allclose(inside, share, atol=0.04)


def test_evaluating_on_recordings_that_were_learned_from_is_said(tmp_path, capsys):
    """They are known under any name."""
    of_files = car(1, 20, 0) + car(2, 60, 3.0), car(3, 30, 0) + pedestrian(4, 80)
    for number, cars in enumerate(of_files):
        text = scenario(cars=cars).replace("Test-1", f"Test-{number}")
        (tmp_path / f"{number}.xml").write_text(text)
    first, second = recordings = read_directory(tmp_path)
    theta = tmp_path / "theta.json"
    learned = structs.replace(shipped("us101"), learned_from=sources([first]))
    save(learned, theta)

    known = load(theta).learned_from
    assert known_from(recordings, known) == [first]
    renamed = replace(first, group="Renamed-1")
    of_same_group = replace(second, group=first.group)
    assert len(known_from([renamed, of_same_group], known)) == 2
    simulated = replace(second, group="episode 0", measured=False)
    assert known_from([simulated], {"episode 0": ["other"]}) == []

    run(f"irl evaluate --theta {theta} --data {tmp_path} --json")
    printed = capsys.readouterr()
    lines = printed.err.splitlines()
    (line,) = (line for line in lines if line.startswith("ms-highway:"))
    assert "was learned from 1 of these 2 recordings" in line
    assert "--folds 4" in line
    assert json.loads(printed.out)["learned_from"] == 1


def test_the_shipped_drivers_know_their_recordings(us101_directory):
    recordings = read_directory(us101_directory, first=1)
    (renamed,) = (replace(recording, group="renamed") for recording in recordings)
    assert len(known_from([*recordings, renamed], shipped("us101").learned_from)) == 2


@pytest.mark.slow
def test_the_commands_fit_and_evaluate(us101_directory, tmp_path, capsys):
    data = tmp_path / "two"
    theta = tmp_path / "theta.json"
    data.mkdir()
    for short in ("8_4", "14_1"):
        (path,) = us101_directory.glob(f"*-{short}_*.xml.gz")
        (data / path.name).symlink_to(path)
    run(
        f"irl fit --data {data} --learn headway closing_speed comfort_steering --out"
        f" {theta}"
    )
    assert load(theta).log_likelihood["held_out"] is not None
    assert "closing_speed" in capsys.readouterr().out
    run(f"irl evaluate --folds 2 --data {data} --json --figures {tmp_path}")
    found = json.loads(capsys.readouterr().out)
    assert (len(found["folds"]), [*found["predictors"]]) == (2, [*PREDICTORS])
    assert found["windows"] > found["tracks"] > 20
    assert "learned_from" not in found
    model, kept, *_ = found["predictors"].values()
    assert model["fde"]["5"] < kept["fde"]["5"]
    assert model["log_p"]["5"] > kept["log_p"]["5"]
    assert {path.stem for path in tmp_path.glob("*.png")} == {
        "errors",
        "likelihood",
        "calibration",
    }


def test_drivers_with_damaged_peers_are_refused(tmp_path, refused):
    """They are before recordings are read."""
    peers = DRIVERS.peers
    fitted = peers["fitted_idm"]
    damaged = structs.replace(fitted, parameters=fitted.parameters | {"braking": -1.0})
    theta = tmp_path / "theta.json"
    for wrong, message in (
        (
            {**peers, "fitted_idm": damaged},
            "drivers.peers.fitted_idm.parameters: braking is -1.0",
        ),
        ({"idm": peers["idm"]}, "drivers.peers lacks constant_velocity"),
    ):
        drivers = structs.replace(DRIVERS, peers=wrong)
        save(structs.replace(shipped("us101"), drivers=drivers), theta)
        line = refused(f"irl evaluate --theta {theta} --data nowhere")
        assert f"{theta} cannot be used ({message}" in line


def test_impossible_predictions_are_refused():
    with pytest.raises(ValueError, match=r"states are of shape \(4,\)"):
        ms_highway.predict([0.0, 0.0, 0.0, 20.0], LANES, 30.0)
    with pytest.raises(
        ValueError,
        match=(
            "predictor is 'imm'; choose one of model, constant_velocity, idm,"
            " fitted_idm"
        ),
    ):
        predict_with("imm", None, DRIVERS)
    with pytest.raises(ValueError, match=r"fitted_idm; learn it .* irl fit"):
        predict_with("fitted_idm", None, structs.replace(DRIVERS, peers={}))
    with pytest.raises(ValueError, match="two groups"):
        evaluate([following()])
