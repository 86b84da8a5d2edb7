"""`ms-highway compare` as a user types it."""

import contextlib
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import imageio.v3 as imageio
import pandas as pd
import pytest
from commands import run

from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.records import columns
from ms_highway.experiments.runner import run as run_comparison

COMPARE = "compare stay_back --controllers naive naive switching:0.4 --seeds 2 --out"


def untimed(directory):
    """The records without their measured times."""
    records = pd.read_csv(directory / "steps.csv")
    return records.drop(columns=[name for name in records if name.endswith("seconds")])


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    directory = tmp_path_factory.mktemp("compare")
    run(f"{COMPARE} {directory}")
    return directory


@pytest.fixture
def begun(compared, tmp_path):
    """A directory with the settings and the records of that comparison."""
    for name in ("settings.json", "steps.csv"):
        (tmp_path / name).write_text((compared / name).read_text())
    return tmp_path


def test_compare_writes_a_row_per_step_a_summary_and_figures(compared):
    records = pd.read_csv(compared / "steps.csv")
    assert list(records) == columns()
    assert len(records) == 2 * 2 * 35
    summary = pd.read_csv(compared / "summary.csv").set_index("controller")
    means = records.groupby("controller")["reward"].mean()
    assert summary["reward"].to_dict() == pytest.approx(means.to_dict())
    assert summary["reward"].between(summary["reward_low"], summary["reward_high"]).all()
    assert summary.loc["naive", "share_naive"] == 1
    assert summary.loc["naive", "decision_ms"] == 0 < summary.loc["switching:0.4", "decision_ms"]
    for name in ("bars", "timeline"):
        assert imageio.imread(compared / f"stay_back_{name}.png").std() > 10
    assert not list(compared.glob("*part*"))


def parts(directory):
    return {*(directory / "parts").glob("[!.]*")}


@pytest.mark.slow
def test_a_comparison_on_two_cores_that_is_killed_goes_on_and_gives_what_one_process_gives(tmp_path):
    """Nothing is lost, nothing doubled, and no process is left behind."""
    asked, alone, killed = Comparison({"merger": ["naive", "turn"]}, 40), tmp_path / "1", tmp_path / "2"
    assert list(run_comparison(asked, alone)) == list(range(81))
    words = f"compare merger --controllers naive turn --seeds 40 --out {killed}"
    process = subprocess.Popen([sys.executable, "-m", "ms_highway", *words.split()])
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    while len(parts(killed)) < 10:
        assert process.poll() is None
        time.sleep(0.01)
    workers = [Path("/proc") / child for child in children.read_text().split()]
    process.kill()
    process.wait()
    left = len(parts(killed))
    assert 10 <= left < 80
    assert not (killed / "steps.csv").exists()
    while any(worker.exists() for worker in workers):
        time.sleep(0.1)
    assert list(run_comparison(asked, killed)) == list(range(left, 81))
    pd.testing.assert_frame_equal(untimed(killed), untimed(alone))
    assert not parts(killed)


def test_compare_goes_on_from_steps_and_parts(compared, begun):
    steps, parts = begun / "steps.csv", begun / "parts"
    head, *lines = steps.read_text().splitlines(keepends=True)
    steps.write_text("".join([head, *lines[:35]]))
    parts.mkdir()
    (parts / "3.csv").write_text("".join([head, *lines[-35:]]))
    (parts / f".part.{'0' * 16}.1.csv").write_text(head + lines[40][:20])  # killed while it was written
    run(f"{COMPARE} {begun}")
    pd.testing.assert_frame_equal(untimed(begun), untimed(compared))
    before = steps.read_text()
    run(f"{COMPARE} {begun} --format pdf")
    assert steps.read_text() == before
    assert (begun / "stay_back_bars.png").exists()  # of the same records
    assert not parts.exists()


@pytest.mark.parametrize("command", [f"{COMPARE} .", "compare --help"])
def test_a_command_whose_output_nobody_reads_any_more_ends_well_and_writes_its_results(
    command, begun, monkeypatch, capsys
):
    monkeypatch.chdir(begun)
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as closed, contextlib.suppress(SystemExit):
        monkeypatch.setattr(sys, "stdout", closed)
        run(command)
    assert "pipe" not in capsys.readouterr().err
    assert Path("summary.csv").exists() == command.endswith(".")


@pytest.mark.slow
def test_compare_keeps_measured_costs_with_the_results(tmp_path):
    command = f"compare stay_back --controllers switching:1 --seeds 1 --set costs=measured --out {tmp_path}"
    run(command)
    settings = (tmp_path / "settings.json").read_text()
    assert 0 < json.loads(settings)["measured"]["stay_back"]["naive"] < 0.1
    run(command)
    assert (tmp_path / "settings.json").read_text() == settings


def test_compare_says_that_it_goes_on_with_other_versions(compared, begun, capsys):
    (made,) = json.loads((compared / "provenance.json").read_text())
    older = [made | {"versions": made["versions"] | {"jax": "0.1"}, "xla_flags": "--other"}]
    (begun / "provenance.json").write_text(json.dumps(older))
    run(f"compare stay_back --seeds 1 --out {begun} --controllers turn")
    said = capsys.readouterr().err
    assert f"continues with jax {made['versions']['jax']} instead of 0.1, XLA_FLAGS" in said
    assert "instead of --other; results may not agree" in said


@pytest.mark.parametrize(
    ("pattern", "replacement", "message"),
    [
        ("(?m),[^,]*$", "", "its columns are not"),
        ("(stay_back,naive,0,0,naive),[^,]*", r"\1,1e400", "reward of naive with seed 0 is inf; it must be"),
        ("stay_back,naive,0,0,", "stay_back,na\xefve,0,0,", "steps.csv cannot be read ('utf-8' codec can't decode"),
    ],
)
def test_compare_refuses_records_that_are_damaged_or_of_another_version_and_leaves_them(
    pattern, replacement, message, begun, refused
):
    steps = begun / "steps.csv"
    spoilt = re.sub(pattern, replacement, steps.read_text())
    steps.write_text(spoilt, encoding="latin-1")
    assert message in refused(f"{COMPARE} .")
    assert steps.read_text(encoding="latin-1") == spoilt


@pytest.mark.slow
def test_scenes_of_the_paper_and_physical_ones_stand_in_one_comparison(tmp_path, capsys):
    run(f"compare merger merger-v1 --controllers naive --seeds 1 --out {tmp_path}")
    assert "out of date" not in capsys.readouterr().err
    assert set(pd.read_csv(tmp_path / "summary.csv")["scenario"]) == {"merger", "merger-v1"}
    run(f"report {tmp_path}")
