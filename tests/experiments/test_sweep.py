"""Very many simulated episodes: `ms-highway sweep`."""

import hashlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time

import imageio.v3 as imageio
import numpy as np
import pandas as pd
import pytest

from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.sweep import Sweep, run_sweep

SWEEP = "sweep stay_back --set ladder=naive, --lambdas 0.1:10:2 --seeds 24 --part 16 --steps --out"
"""Three controllers of which none thinks hard: 72 episodes in five parts."""


def contents(directory):
    """What the parts and the summary hold, byte for byte."""
    files = [*directory.rglob("part-*.parquet"), directory / "summary.csv"]
    return {str(file.relative_to(directory)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def begin(command, devices=1):
    """The command in a process of its own, compiled without much optimisation, as little is computed."""
    flags = f"--xla_backend_optimization_level=0 --xla_force_host_platform_device_count={devices}"
    words = [sys.executable, "-m", "ms_highway", *command.split(" ")]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(words, env={**os.environ, "XLA_FLAGS": flags}, **quiet)


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    directory = tmp_path_factory.mktemp("sweep") / "out"
    assert begin(f"{SWEEP} {directory}").wait() == 0
    return directory


def test_a_sweep_is_opened_in_one_line_with_a_row_per_episode_and_per_step(swept):
    episodes, steps = pd.read_parquet(swept / "episodes"), pd.read_parquet(swept / "steps")
    keys = ["controller", "seed"]
    assert (len(episodes), len(steps)) == (3 * 24, 35 * 3 * 24)
    assert not episodes.duplicated(keys).any()
    means = steps.groupby(keys)["reward"].mean()
    np.testing.assert_allclose(episodes.set_index(keys)["reward"].sort_index(), means.sort_index(), atol=1e-6)
    assert set(episodes["price"].dropna()) == {0.1, 10}
    assert len(list((swept / "episodes").iterdir())) == 5
    summary = pd.read_csv(swept / "summary.csv").set_index("controller")
    assert summary["episodes"].tolist() == [24, 24, 24]
    assert summary.loc["naive", "reward"] == pytest.approx(episodes.query("controller == 'naive'")["reward"].mean())
    assert imageio.imread(swept / "stay_back_curve.png").std() > 5
    assert len(json.loads((swept / "provenance.json").read_text())) == 1


@pytest.mark.slow
def test_a_sweep_that_is_killed_goes_on_with_two_devices_to_what_an_uninterrupted_one_with_one_gives(swept, tmp_path):
    command, parts = f"{SWEEP} {tmp_path / 'out'}", tmp_path / "out" / "episodes"
    process = begin(command)
    while process.poll() is None and len(list(parts.glob("part-*"))) < 2:
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert len(list(parts.glob("part-*"))) >= 2
    assert not (tmp_path / "out" / "summary.csv").exists()
    assert begin(command, devices=2).wait() == 0
    assert contents(tmp_path / "out") == contents(swept)


@pytest.mark.slow
def test_two_processes_and_other_parts_give_the_episodes_of_one(swept, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        coordinator = f"127.0.0.1:{free.getsockname()[1]}"
    command = f"{SWEEP} {tmp_path} --part 10 --coordinator {coordinator} --processes 2 --process"
    runs = [begin(f"{command} {place}") for place in (0, 1)]
    assert [run.wait() for run in runs] == [0, 0]
    for kind in ("episodes", "steps"):
        alone, shared = (pd.read_parquet(directory / kind) for directory in (swept, tmp_path))
        pd.testing.assert_frame_equal(alone, shared, check_exact=True)
    assert (tmp_path / "summary.csv").read_bytes() == (swept / "summary.csv").read_bytes()


def test_a_sweep_refuses_a_directory_of_other_settings_and_one_of_other_things(swept, tmp_path, refused):
    before = contents(swept)
    assert "first_seed 0 instead of 5" in refused(f"{SWEEP} {swept} --first-seed 5")
    assert contents(swept) == before
    (tmp_path / "steps.csv").touch()
    assert "choose another directory" in refused(f"{SWEEP} .")


def test_processes_that_are_asked_for_different_sweeps_do_not_mix_them(swept, tmp_path):
    shutil.copytree(swept, tmp_path / "out", ignore=shutil.ignore_patterns("episodes"))
    comparison = Comparison({"stay_back": ["naive"]}, seeds=24, config={"ladder": ["naive"]})
    with pytest.raises(ValueError, match="part 16 instead of 10"):
        next(run_sweep(Sweep(comparison, tmp_path / "out", part=10, place=1, processes=2)))
    assert not (tmp_path / "out" / "episodes").exists()


@pytest.mark.parametrize(("kind", "copied"), [("episodes", False), ("episodes", True), ("steps", True)])
def test_a_part_that_was_damaged_or_is_a_copy_of_another_is_named(kind, copied, swept, tmp_path, refused):
    shutil.copytree(swept, tmp_path / "out")
    part = tmp_path / "out" / kind / "part-000002.parquet"
    part.write_bytes(part.with_stem("part-000001").read_bytes() if copied else part.read_bytes()[:100])
    line = refused(f"{SWEEP} out")
    assert "part-000002.parquet cannot be read" in line
    assert not copied or "holds other episodes" in line
    assert "remove it" in line


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("merger --seeds 1000000 --part 1", "parts; there may be 1000000, of --part episodes each"),
        (
            "dense_merge --set costs=measured",
            "costs are 'measured', and a simulation cannot measure plans; say 'shipped', or give seconds",
        ),
        ("dense_merge --set costs=naive=0.1", "without seconds for 'turn'"),
        ("merger --devices 1000", "1000 devices are wanted; this process has"),
        ("merger --processes 2", "several need a coordinator"),
        ("merger --process 1", "numbered from 0"),
    ],
)
def test_a_wrong_sweep_says_so_in_one_line_and_writes_nothing(arguments, message, refused):
    assert message in refused(f"sweep {arguments} --out out")
