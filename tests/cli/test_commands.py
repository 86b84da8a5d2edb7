"""Commands as users type them."""

import os
import sys
import warnings
from pathlib import Path

import pandas as pd
import pytest
from commands import python, run

from ms_highway.cli.main import main
from ms_highway.envs.registry import CONTROLLERS
from ms_highway.planning.ladders import MODELS

NAIVE = "compare stay_back --controllers naive --seeds 1 --out"


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (
            "sweep merger --devices 1000 --out out",
            "1000 devices are wanted; this process has",
        ),
        (
            "irl evaluate --theta demonstrations --data .",
            "--theta demonstrations has no drivers",
        ),
        ("values learn merger --set ladder=best --out values.npz", "leave +warm out"),
        (
            "bench road merge --drivers oracle",
            "unknown driver 'oracle'; the drivers are idm, commuter, human",
        ),
        (
            "bench road merge --drivers agents/mine.zip",
            "there is no agent agents/mine.zip; notebooks/examples/train",
        ),
        (
            (
                "sweep merger --set ladder=naive,tom@8 --controllers naive learned:1"
                " --out sweep"
            ),
            "without 'tom@8'",
        ),
        (
            "--import no_such_module compare",
            "--import no_such_module: ModuleNotFoundError: No module named",
        ),
        ("compare merger --out caf\udce9", "invalid path value: 'caf\\udce9'"),
        (
            "report elsewhere",
            (
                "elsewhere holds no results of a comparison; name a directory that"
                " `ms-highway compare`"
            ),
        ),
        ("video merger --out film.avi", "no name that ends in .mp4, .gif"),
        ("sweep merger --out sweep --devices 1 --scheduler tcp://a:1", "leave one out"),
        ("validate nowhere", "no reference episodes (*.npz) in nowhere"),
        (
            "compare --no-such-option",
            "unrecognized arguments: --no-such-option; see the --help of the command",
        ),
        (
            "sweep merger --out out --seeds 0",
            "argument --seeds: '0' is no whole number from 1 to 1,000,000",
        ),
        (
            "frontier --lambdas 3:1:1",
            (
                "argument --lambdas: lambdas are '3:1:1'; give a number like 0.1, or"
                " LOW:HIGH"
            ),
        ),
        (
            "compare --out /proc/x/y",
            "/proc/x/y cannot be written: No such file or directory; ",
        ),
        (
            "compare --out /proc/version",
            "/proc/version cannot be written: it is no directory; ",
        ),
        ("bench --json .", ". cannot be written: it is a directory or a device; "),
    ],
)
def test_a_wrong_command_is_refused_in_one_line(command, message, refused):
    line = refused(command)
    assert line.startswith("ms-highway: ")
    assert message in line


@pytest.mark.slow
def test_a_sweep_knows_rules_and_models_of_imported_modules(tmp_path, monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[2])
    monkeypatch.setattr(sys, "path", list(sys.path))
    models = "--set costs=coasting=0.09,tom=0.37 --set ladder=coasting,tom"
    asked = f"merger {models} --controllers coasting near:6 closeness:2"
    try:
        run(
            f"--import notebooks.examples.rule sweep {asked} --seeds 2 --out {tmp_path}"
        )
    finally:
        del MODELS["coasting"], CONTROLLERS["near"], CONTROLLERS["closeness"]
    summary = pd.read_csv(tmp_path / "summary.csv").set_index("controller")
    for name in ("near:6", "closeness:2"):
        assert summary["kind"][name] == name.partition(":")[0]
        assert 0 < summary["share_tom"][name] < 1


def test_a_warning_is_one_line_without_a_place_in_source(tmp_path, capsys):
    (tmp_path / "other").touch()
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert main(f"{NAIVE} {tmp_path} --set step_size=0.5".split()) == 2
    warning, refusal = capsys.readouterr().err.splitlines()
    assert warning.startswith("ms-highway: config['step_size'] is 0.5")
    assert ".py" not in warning
    assert "is not empty" in refusal


def test_output_to_files_is_ascii_with_a_line_per_row():
    """A narrow terminal does not matter, as the output is none; ASCII lacks ²."""
    narrow = {**os.environ, "PYTHONIOENCODING": "ascii", "COLUMNS": "60"}
    bench = ["-m", "ms_highway", "bench", "road", "merge-v0", "--drivers"]
    table = python(*bench, "idm", "--seeds", "1", env=narrow).stdout.splitlines()
    (headings,) = (line for line in table if "reward per step" in line)
    (row,) = (line for line in table if line.startswith("idm"))
    assert "m/s? at most" in headings
    assert min(len(headings), len(row)) > 120
    refusal = python(*bench, "caf\xe9", status=2, env=narrow).stderr
    assert refusal.startswith("ms-highway: unknown driver 'caf\\xe9'")


@pytest.mark.slow
def test_a_missing_platform_is_refused_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    words = f"-m ms_highway {NAIVE} {tmp_path}".split()
    (line,) = python(*words, status=2).stderr.splitlines()
    assert "JAX_PLATFORMS is 'cuda'" in line
