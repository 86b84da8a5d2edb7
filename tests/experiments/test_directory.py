"""What an interrupted run finds when it is resumed."""

import shutil
import subprocess

import pandas as pd
import pytest

from ms_highway.experiments import directory
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.results import read_results
from ms_highway.experiments.runner import read, run

COMPARISON = Comparison({"merger": ["naive"]}, seeds=1)


def test_a_comparison_that_was_stopped_in_its_first_episode_can_be_resumed(tmp_path):
    assert next(run(COMPARISON, tmp_path)) == 0
    with pytest.raises(ValueError, match="holds no episodes yet"):
        read_results(tmp_path)
    runs = run(COMPARISON, tmp_path)
    assert [next(runs), next(runs)] == [0, 1]
    stopped = read_results(tmp_path).records
    assert list(run(COMPARISON, tmp_path)) == [1]
    pd.testing.assert_frame_equal(read_results(tmp_path).records, stopped)
    pd.testing.assert_frame_equal(read(COMPARISON, tmp_path), stopped)
    assert len(stopped) == 40


def test_a_run_from_a_checkout_names_its_commit_and_whether_its_files_have_changed(tmp_path, monkeypatch):
    monkeypatch.setattr(directory, "CHECKOUT", tmp_path / "checkout")
    assert "commit" not in directory.this_run()  # where the package was installed
    file = tmp_path / "checkout" / "file"
    file.parent.mkdir()
    shutil.copy(__file__, file)
    author = ["-c", "user.name=A", "-c", "user.email=a@example.org"]
    for words in (["init"], ["add", "file"], [*author, "commit", "-m", "first"]):
        subprocess.run(["git", *words], cwd=file.parent, check=True)
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=file.parent, check=True, capture_output=True, text=True)
    (file.parent / "results").touch()  # which is no part of the commit
    for text, dirty in (("", False), ("more", True)):
        with file.open("a") as opened:
            opened.write(text)
        run = directory.this_run()
        assert (run["commit"], run["dirty"]) == (head.stdout.strip(), dirty)
