"""The released code's logs, replayed."""

import json
import shutil

import numpy as np
import pytest

from ms_highway.cli.main import main
from ms_highway.experiments.validation import read_episodes, validate, validate_file

DECISIONS = {"merger": 780, "give_way": 780, "stay_back": 680}
ELSEWHERE = [pytest.param(name, marks=pytest.mark.slow) for name in ("give_way", "stay_back")]


@pytest.fixture(scope="module", params=["merger", *ELSEWHERE])
def replayed(request, reference):
    """A scenario, and what `validate_file` says of each of its controllers."""
    files = sorted(reference.glob(f"{request.param}__*.npz"))
    return request.param, {file.stem.partition("__")[2]: validate_file(file) for file in files}


def test_rewards_and_human_controls_are_the_logged_ones(replayed):
    for name, file in replayed[1].items():
        assert file["reward_error"]["max"] < 1e-4, name
        assert file["human_error"]["q99"] < 1e-4, name


def test_models_plan_the_logged_controls_where_the_reference_is_not_chaotic(replayed):
    scenario, kinds = replayed
    error = {model: kinds[model]["action_error"] for model in ("naive", "turn", "tom") if model in kinds}
    if scenario == "stay_back":
        assert max(error["naive"]["q90"], error["turn"]["q90"]) < 1e-5
        assert error["naive"]["q99"] < 1e-4
    else:
        assert max(each["q50"] for each in error.values()) < 1e-6
        assert max(error["naive"]["q99"], error["turn"]["q99"], error["tom"]["q90"]) < 1e-4


def test_every_switching_decision_agrees(replayed):
    scenario, kinds = replayed
    decisions = [errors["decisions"] for errors in kinds.values() if "decisions" in errors]
    assert sum(errors["all"] for errors in decisions) == DECISIONS[scenario]
    assert all(errors["agree"] == errors["all"] for errors in decisions)


def test_validate_prints_json_for_any_directory_of_such_files(reference, tmp_path, capsys):
    shutil.copy(reference / "merger__switching_lambda_0.6.npz", tmp_path)
    assert main(["validate", str(tmp_path), "--json"]) == 0
    file = json.loads(capsys.readouterr().out)["files"]["merger__switching_lambda_0.6.npz"]
    assert file["decisions"] == {"agree": 390, "all": 390}
    assert set(file["action_error"]) == {"q50", "q90", "q99", "max"}


def test_files_that_are_no_reference_files_are_refused_by_name(tmp_path):
    with pytest.raises(FileNotFoundError, match="no reference episodes"):
        validate(tmp_path)
    (tmp_path / "merger__naive.npz").write_bytes(b"not an archive")
    with pytest.raises(ValueError, match=r"merger__naive\.npz cannot be read as a reference file"):
        validate(tmp_path)
    with pytest.raises(ValueError, match="SCENARIO__KIND"):
        read_episodes(tmp_path / "highway__naive.npz")


def test_damaged_arrays_are_refused_by_name(reference, tmp_path):
    with np.load(reference / "merger__tom.npz") as archive:
        arrays = dict(archive)
    file = tmp_path / "merger__tom.npz"
    for change, message in (
        ({"models": arrays["models"] + 5}, "no places in naive, turn, tom"),
        ({"states": np.zeros(3)}, r"states holds float64 of shape \(3,\); it must hold finite numbers of shape"),
        ({"states": arrays["states"] * 1e300}, "states holds .*; it must hold finite numbers"),
        ({"states": arrays["states"] > 0}, "states holds bool .*; it must hold finite numbers"),
        ({name: array[:0] for name, array in arrays.items() if name != "ladder"}, r"states holds .* of shape \(0, "),
    ):
        np.savez(file, **{**arrays, **change})
        with pytest.raises(ValueError, match=message):
            validate_file(file)
