"""Directories of results: what made them, what they may hold, and what is shown of them."""

import json
import shutil
from importlib.metadata import version

import pytest
from commands import run
from comparisons import COMPARE


def test_provenance_grows_when_a_comparison_goes_on_and_only_then(compared):
    runs = json.loads((compared / "provenance.json").read_text())
    assert [run["command"][-1] for run in runs] == ["1", "2"]
    assert runs[0]["time"] <= runs[1]["time"]  # to the second
    assert runs[0]["machine"]["cores"] >= 1
    assert runs[0]["versions"]["highway-env"] == version("highway-env")
    run(f"{COMPARE} {compared} --seeds 2")
    assert json.loads((compared / "provenance.json").read_text()) == runs


@pytest.mark.parametrize(
    ("name", "spoil", "message"),
    [
        ("settings.json", lambda text: "{}", "holds no settings"),
        ("steps.csv", lambda text: text.replace(",naive,", ",telepathy,"), "holds model 'telepathy', not one of naive"),
    ],
)
def test_results_that_are_no_results_are_refused_in_one_line(name, spoil, message, compared, tmp_path, refused):
    directory = shutil.copytree(compared, tmp_path / "results", ignore=shutil.ignore_patterns("*.html"))
    (directory / name).write_text(spoil((directory / name).read_text()))
    assert message in refused("report results --out page.html")
