"""Prediction of recorded drivers, by a learned reward and beside it, on real driving where that is present."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from ms_highway.cli.main import main
from ms_highway.game.learned_reward import load, shipped
from ms_highway.game.reward_model import RewardModel
from ms_highway.irl.evaluation import cross_validate
from ms_highway.irl.prediction import (
    constant_velocity,
    cut_cases,
    drive,
    errors,
    gaussian_log_likelihoods,
    idm,
    idm_controls,
)
from ms_highway.irl.recordings.recording import Recording
from ms_highway.irl.regimes import driving_regimes, errors_by_regime
from ms_highway.irl.windows import cut_windows


def following(gap: float, speed: float = 15.0, leader: float = 15.0, times: int = 61) -> Recording:
    """A recording of a driver that keeps its velocity and of a leader, a gap between bumpers apart."""
    time = 0.1 * np.arange(times)[:, None]
    cars = [
        np.column_stack([start + velocity * time, 0 * time + 3.4, 0 * time, 0 * time + velocity])
        for start, velocity in ((0.0, speed), (gap + 5.0, leader))
    ]
    sizes, lanes = np.tile([5.0, 2.0], (2, 1)), np.array([0.0, 3.4, 6.8])
    return Recording("a pair", "a pair", 0.1, np.stack(cars, axis=1), np.array([0]), sizes, lanes, 3.4, 29.0)


def test_constant_velocity_predicts_whoever_keeps_it_without_error():
    cases = cut_cases([following(20.0)])
    assert len(cases) == 6  # from every full second that a second follows
    found = errors(constant_velocity(cases), cases)
    for kind in ("fde", "ade", "rmse", "miss"):
        assert list(found[kind]) == ["1", "2", "3", "5"]
        np.testing.assert_allclose(list(found[kind].values()), 0.0, atol=1e-9)


def test_errors_are_what_a_known_path_is_off():
    cases = cut_cases([following(20.0)])
    off = constant_velocity(cases)
    off[:, :, 0] += 3.0 * 0.1 * np.arange(1, 51)  # 3 m/s too fast
    found = errors(off, cases)
    assert found["fde"] == pytest.approx({"1": 3.0, "2": 6.0, "3": 9.0, "5": 15.0})
    assert found["rmse"] == pytest.approx(found["fde"])
    assert found["ade"]["1"] == pytest.approx(1.65)
    assert found["miss"] == {"1": 1.0, "2": 1.0, "3": 1.0, "5": 1.0}


def test_a_learned_driver_brakes_behind_a_leader_that_it_sees_braking():
    braking = following(20.0)
    speed = np.maximum(15.0 - 0.3 * np.arange(61), 5.0)
    braking.states[:, 1, 3] = speed
    braking.states[1:, 1, 0] = 25.0 + np.cumsum(speed[:-1]) * 0.1
    weights = shipped("us101").sharp_weights
    seen, unseen = (drive(cut_cases([braking], others), weights, 5)[0] for others in ("recorded", "coasting"))
    assert (seen[:, 0] + 5.0 < braking.states[1:51, 1, 0]).all()
    assert unseen[-1, 0] - seen[-1, 0] > 5.0
    alone = drive(cut_cases([following(300.0)]), weights, 5)[0]
    np.testing.assert_allclose(alone[:, 0], unseen[:, 0], atol=3.0)


@pytest.mark.slow
def test_cross_validation_predicts_every_group_by_what_was_learned_from_the_others():
    random = np.random.default_rng(0)
    recordings = []
    for number in range(3):
        recording = following(20.0, speed=14.0 + number)
        recording.states[:, 0, 2] += random.normal(scale=0.002, size=61)
        recording.states[:, 0, 3] += random.normal(scale=0.05, size=61)
        recordings.append(replace(recording, group=str(number), measured=False))
    recordings[2].states[:, 0, 1] = 60.0  # off the road, where nothing can be learned, but something predicted
    model = RewardModel(("headway", "comfort_steering"), {"comfort_acceleration": 0.1})
    told: list[str] = []
    found = cross_validate(recordings, model, 5, 8, progress=told.append)
    assert [message for message in told if "learning" in message] == [f"learning, fold {n} of 3" for n in (1, 2, 3)]
    assert len(found["folds"]) == 3
    assert found["windows"] == 18
    assert found["likelihood_windows"] == 24
    for row in found["model"].values():
        assert np.isfinite(list(row.values()) if isinstance(row, dict) else row).all()
    assert found["model"]["fde"]["1"] < 2.0
    with pytest.raises(ValueError, match="two groups"):
        cross_validate(recordings[:1], model, 5, 2)


def test_highway_envs_idm_keeps_its_distance_and_its_lane():
    cases = cut_cases([following(4.0)])
    path = idm(cases)[0]
    assert path[-1, 0] < constant_velocity(cases)[0, -1, 0] - 5.0
    np.testing.assert_allclose(path[:, 1], 3.4, atol=1e-6)
    windows = cut_windows([following(4.0)], 5)
    assert idm_controls(windows)[0, 0, 1] < -2.0


def test_normal_noise_is_as_likely_around_what_was_expected_as_its_distribution_says():
    windows = cut_windows([following(20.0)], 5)
    noise = np.random.default_rng(0).normal(size=windows.controls.shape) * [0.001, 0.5]
    expected, scale = np.asarray(windows.controls) - noise, np.array([0.05, 100 / 3])
    deviation = np.sqrt(np.mean((noise / scale) ** 2, axis=(0, 1)))
    likely = stats.norm.logpdf(noise / scale, scale=deviation).sum(axis=(1, 2))
    np.testing.assert_allclose(gaussian_log_likelihoods(windows, expected), likely, rtol=1e-5)
    assert (
        gaussian_log_likelihoods(windows, expected).mean()
        > gaussian_log_likelihoods(windows, expected + np.array([0.0, 2.0])).mean() + 5
    )


def test_situations_are_told_apart_by_what_drivers_did():
    def which(recording: Recording) -> set[str]:
        return {name for name, chosen in driving_regimes(cut_cases([recording])).items() if chosen[0]}

    assert which(following(20.0)) == {"following"}
    assert which(following(60.0)) == {"no leader"}
    assert which(following(20.0, speed=3.0, leader=3.0)) == {"slow"}
    moving, time = following(20.0), 0.1 * np.arange(61)
    moving.states[:, 0, 1] -= 1.2 * time
    moving.states[:, 0, 3] -= 2.0 * time
    assert which(moving) == {"lane change", "braking"}


def test_errors_by_situation_count_what_is_in_it():
    cases = cut_cases([following(20.0), following(60.0)])
    late = constant_velocity(cases) - [1.0, 0.0]
    found = errors_by_regime({"late": late, "exact": constant_velocity(cases)}, cases)
    assert list(found) == ["no leader", "following"]
    for row in found.values():
        assert row == pytest.approx({"windows": 4, "late": 1.0, "exact": 0.0}, abs=1e-9)


def test_a_driver_that_is_never_seen_for_a_second_cannot_be_predicted():
    with pytest.raises(ValueError, match=r"seen for 1 s"):
        cut_cases([following(4.0, times=8)])


def test_real_drivers_are_predicted_better_by_the_learned_reward(us101):
    cases = cut_cases(us101[::5])
    cases = cases.of(np.arange(len(cases)) % 6 == 0)
    found = errors(drive(cases, shipped("us101").sharp_weights, 5), cases)
    baseline = errors(constant_velocity(cases), cases)
    for horizon in ("3", "5"):
        assert found["fde"][horizon] < 0.9 * baseline["fde"][horizon]
        assert found["miss"][horizon] < baseline["miss"][horizon]


@pytest.mark.slow
def test_the_commands_fit_and_evaluate(us101_directory, tmp_path, capsys):
    data, theta = tmp_path / "two", tmp_path / "theta.json"
    data.mkdir()
    for path in sorted(us101_directory.glob("*.xml.gz"))[-2:]:
        (data / path.name).symlink_to(path)
    learn = ["--learn", "headway", "closing_speed", "comfort_steering"]
    assert main(["irl", "fit", "--data", str(data), *learn, "--out", str(theta)]) == 0
    assert load(theta).learned == ("headway", "closing_speed", "comfort_steering")
    assert load(theta).log_likelihood["held_out"] is not None
    assert "closing_speed" in capsys.readouterr().out
    assert main(["irl", "evaluate", "--theta", str(theta), "--data", str(data), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    for name in ("model", "constant_velocity", "idm"):
        assert list(found[name]) == ["fde", "ade", "rmse", "miss", "log_likelihood"]
        assert list(found[name]["fde"]) == ["1", "2", "3", "5"]
    assert found["windows"] > found["tracks"] > 20
    assert found["model"]["fde"]["5"] < found["constant_velocity"]["fde"]["5"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fit", "--data", "nowhere", "--out", "{out}"], "nowhere is not a directory"),
        (["fit", "--data", "minari:ms-highway/none-v0", "--out", "{out}"], "there is no data set ms-highway/none-v0"),
        (["fit", "--data", "{empty}", "--out", "{out}"], "holds no CommonRoad scenarios"),
        (["evaluate", "--theta", "us102", "--data", "{empty}"], "us102 cannot be read as a learned reward"),
        (["evaluate", "--theta", "us101", "--data", "{empty}"], "holds no CommonRoad scenarios"),
        (["evaluate", "--theta", "us101", "--horizon", "9", "--data", "{empty}"], "leave them out"),
        (["fit", "--data", "{empty}", "--out", "{empty}"], "a directory; name a .json file"),
    ],
)
def test_bad_input_is_one_clear_message_and_nothing_is_written(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    (tmp_path / "empty").mkdir()
    names = {"out": tmp_path / "theta.json", "empty": tmp_path / "empty"}
    assert main(["irl", *(word.format(**names) for word in arguments)]) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert len(error.splitlines()) == 1
    assert not Path(names["out"]).exists()
