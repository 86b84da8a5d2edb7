"""The released code's logs, replayed."""

import json
import shutil

import numpy as np
import pytest

from ms_highway.cli.main import main
from ms_highway.experiments.validation import validate_file

ELSEWHERE = [pytest.param(name, marks=pytest.mark.slow) for name in ("give_way", "stay_back")]


@pytest.fixture(scope="module", params=["merger", *ELSEWHERE])
def replayed(request, reference):
    """A scenario, and what `validate_file` says of each of its controllers."""
    files = sorted(reference.glob(f"{request.param}__*.npz"))
    return request.param, {file.stem.partition("__")[2]: validate_file(file) for file in files}


def test_rewards_and_controls_are_the_logged_ones_where_the_reference_is_not_chaotic(replayed):
    scenario, kinds = replayed
    for name, file in kinds.items():
        assert file["reward_error"]["max"] < 1e-4, name
        assert file["human_error"]["q99"] < 1e-4, name
    error = {model: kinds[model]["action_error"] for model in ("naive", "turn", "tom") if model in kinds}
    if scenario == "stay_back":
        assert max(error["naive"]["q90"], error["turn"]["q90"]) < 1e-5
        assert error["naive"]["q99"] < 1e-4
    else:
        assert max(each["q50"] for each in error.values()) < 1e-6
        assert max(error["naive"]["q99"], error["turn"]["q99"], error["tom"]["q90"]) < 1e-4


def test_validate_prints_json_for_any_directory_of_such_files(reference, tmp_path, capsys):
    shutil.copy(reference / "merger__switching_lambda_0.6.npz", tmp_path)
    assert main(["validate", str(tmp_path), "--json"]) == 0
    file = json.loads(capsys.readouterr().out)["files"]["merger__switching_lambda_0.6.npz"]
    assert file["decisions"] == {"agree": 390, "all": 390}
    assert set(file["action_error"]) == {"q50", "q90", "q99", "max"}


def test_damaged_arrays_are_refused_by_name(reference, tmp_path):
    with np.load(reference / "merger__tom.npz") as archive:
        arrays = dict(archive)
    file = tmp_path / "merger__tom.npz"
    for change, message in (
        ({"models": arrays["models"] + 5}, "no places in naive, turn, tom"),
        ({"states": arrays["states"] * 1e300}, "states holds .*; it must hold finite numbers"),
    ):
        np.savez(file, **{**arrays, **change})
        with pytest.raises(ValueError, match=message):
            validate_file(file)
    file.write_bytes(b"not an archive")
    with pytest.raises(ValueError, match=r"merger__tom\.npz cannot be read as a reference file"):
        validate_file(file)
