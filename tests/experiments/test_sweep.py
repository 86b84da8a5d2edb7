"""Very many simulated episodes: `ms-highway sweep`."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from threading import Thread

import pandas as pd
import pytest
from commands import run
from distributed import LocalCluster

from ms_highway.runtime.files import FILE_NAMES

SWEEP = (
    "sweep stay_back --set ladder=naive, --controllers naive random:naive=1"
    " schedule:naive=3,naive "
)
SWEEP += "--seeds 24 --part 16 --steps --out"
"""Three controllers that share a small program: 72 episodes in five parts."""


def contents(directory):
    """Return the bytes of all parts and of the summary, by file."""
    files = [*directory.rglob("part-*.parquet"), directory / "summary.csv"]
    return {file.relative_to(directory): file.read_bytes() for file in files}


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    directory = tmp_path_factory.mktemp("sweep") / "out"
    run(f"{SWEEP} {directory}")
    return directory


def test_a_sweep_holds_episodes_steps_and_a_summary(swept):
    episodes = pd.read_parquet(swept / "episodes")
    steps = pd.read_parquet(swept / "steps")
    keys = ["controller", "seed"]
    assert (len(episodes), len(steps)) == (3 * 24, 35 * 3 * 24)
    assert len(list((swept / "episodes").iterdir())) == 5
    rewards = episodes.set_index(keys)["reward"].sort_index()
    means = steps.groupby(keys)["reward"].mean()
    pd.testing.assert_series_equal(rewards, means, atol=1e-6)
    summary = pd.read_csv(swept / "summary.csv").set_index("controller")
    assert summary["episodes"].tolist() == [24, 24, 24]
    means = episodes.groupby("controller")["reward"].mean()
    assert summary["reward"].to_dict() == pytest.approx(means.to_dict())
    files = {file.name for file in swept.iterdir()}
    assert {"stay_back_curve.png", "provenance.json"} <= files


@pytest.mark.slow
def test_a_killed_sweep_resumes_to_the_same_bytes(swept, tmp_path):
    out = tmp_path / "out"
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2"
    words = [sys.executable, "-m", "ms_highway", *f"{SWEEP} {out}".split()]
    process = subprocess.Popen(
        words, env={**os.environ, "XLA_FLAGS": flags}, stderr=subprocess.DEVNULL
    )
    while process.poll() is None and len(list(out.glob("episodes/part-*"))) < 2:
        time.sleep(0.002)
    process.kill()
    process.wait()
    assert not (out / "summary.csv").exists()
    assert (out / FILE_NAMES.lock).exists()
    run(f"{SWEEP} {out}")
    assert contents(out) == contents(swept)
    assert not (out / FILE_NAMES.lock).exists()


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_gives_the_same_bytes(
    swept, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "mine.py").write_text(
        "import os\nopen(f'imported-{os.getpid()}', 'w').close()"
    )
    killed = []

    def kill_a_busy_worker(cluster):
        while not killed:
            for worker in cluster.scheduler.workers.values():
                if worker.processing:
                    killed.append(cluster.workers[worker.name].pid)
                    os.kill(killed[0], signal.SIGKILL)
                    break
            time.sleep(0.01)

    workers = {"n_workers": 2, "threads_per_worker": 1}
    with LocalCluster(**workers, dashboard_address=":0") as cluster:
        killing = Thread(target=kill_a_busy_worker, args=(cluster,))
        killing.start()
        run(f"--import mine {SWEEP} out --scheduler {cluster.scheduler_address}")
        killing.join()
    assert contents(tmp_path / "out") == contents(swept)
    assert (tmp_path / f"imported-{killed[0]}").exists()


@pytest.mark.filterwarnings("always:.*not whole")
def test_parts_whose_steps_are_missing_or_cut_are_computed_again(
    swept, tmp_path, capsys
):
    out = shutil.copytree(swept, tmp_path / "out")
    first, second, third = sorted((out / "steps").iterdir())[:3]
    first.unlink()
    second.write_bytes(second.read_bytes()[:-100])
    pd.read_parquet(third)[:-1].to_parquet(third)
    run(f"{SWEEP} {out}")
    warning = "out/steps: parts that are not whole are computed again: 3"
    assert warning in capsys.readouterr().err
    assert contents(out) == contents(swept)


def test_a_sweep_refuses_directories_with_other_settings_and_damaged_parts(
    swept, tmp_path, refused
):
    out = shutil.copytree(swept, tmp_path / "out")
    first = out / "episodes" / "part-000000.parquet"
    third = out / "episodes" / "part-000002.parquet"
    assert "first_seed 0 instead of 5" in refused(f"{SWEEP} out --first-seed 5")
    assert contents(out) == contents(swept)
    shutil.copy(first, third)
    refusal = refused(f"{SWEEP} out")
    reason = "it holds other episodes than its number says"
    assert f"{third.name} cannot be read ({reason})" in refusal
    third.write_bytes(first.read_bytes()[:100])
    refusal = refused(f"{SWEEP} out")
    assert re.search(f"{third.name} cannot be read .*remove it", refusal)
