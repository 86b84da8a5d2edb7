"""Directories of results: what made them, what they may hold, and what is shown of them."""

import json
import re
import shutil
from importlib.metadata import version

import pandas as pd
import pytest
from commands import run
from comparisons import COMPARE

from ms_highway.envs.short_names import controller_config
from ms_highway.experiments.analysis.selection import choosing_controllers, telling_pair
from ms_highway.experiments.results import read_results
from ms_highway.visualization.comparison import timeline


def test_provenance_grows_when_a_comparison_goes_on_and_only_then(compared):
    runs = json.loads((compared / "provenance.json").read_text())
    assert [run["command"][-1] for run in runs] == ["1", "2"]
    assert runs[0]["time"] <= runs[1]["time"]  # to the second
    assert runs[0]["machine"]["cores"] >= 1
    assert runs[0]["versions"]["highway-env"] == version("highway-env")
    run(f"{COMPARE} {compared} --seeds 2")
    assert json.loads((compared / "provenance.json").read_text()) == runs


def test_a_comparison_refuses_provenance_that_cannot_be_read_and_leaves_everything(tmp_path, refused):
    (tmp_path / "provenance.json").write_text("[")
    assert "provenance.json cannot be read" in refused(f"{COMPARE} .")


def without_column(directory):
    pd.read_csv(directory / "steps.csv").drop(columns="model").to_csv(directory / "steps.csv", index=False)


def with_a_broken_line(directory):
    with (directory / "steps.csv").open("a") as file:
        file.write("stay_back,naive,2,0,naive,0.5\n")


def renamed(old, new):
    def rename(directory):
        text = (directory / "steps.csv").read_text()
        (directory / "steps.csv").write_text(re.sub(rf"(?m)(^|,){re.escape(old)}(?=,)", rf"\1{new}", text))

    return rename


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (shutil.rmtree, "there is no directory"),
        (lambda directory: (directory / "steps.csv").unlink(), "has no steps.csv; name a directory"),
        (lambda directory: (directory / "settings.json").unlink(), "has no settings.json"),
        (lambda directory: (directory / "settings.json").write_text("{"), "settings.json cannot be read"),
        (lambda directory: (directory / "settings.json").write_text("{}"), "holds no settings"),
        (lambda directory: (directory / "steps.csv").write_text(""), "steps.csv cannot be read"),
        (lambda directory: (directory / "steps.csv").write_bytes(bytes(range(256))), "steps.csv cannot be read"),
        (
            lambda directory: (directory / "provenance.json").write_text("{}"),
            "provenance.json cannot be read as a list of runs",
        ),
        (without_column, "has no column model"),
        (with_a_broken_line, "holds an unfinished episode"),
        (renamed("naive", "brief"), "holds model 'brief', not one of naive"),
        (renamed("switching:0.4", "swerving"), "unknown controller 'swerving'"),
        (renamed("stay_back", "zipper"), "holds scenario 'zipper', not one of stay_back, merger, give_way"),
        (renamed("0.09", "cheap"), "has texts where numbers belong, in column counted_seconds"),
    ],
)
def test_results_that_are_no_results_are_refused_in_one_line(spoil, message, compared, tmp_path, refused):
    spoil(shutil.copytree(compared, tmp_path / "results", ignore=shutil.ignore_patterns("*.html")))
    assert message in refused("report results --out page.html")


def test_results_know_the_settings_of_their_environments(compared):
    config = read_results(compared).config("stay_back")
    assert config == {"semantics": "paper", "solver": "gradient", "human_reward": "learned", "costs": "published"}


def test_the_best_fixed_model_is_shown_beside_switching_at_the_papers_conservative_lambda():
    rows = [("naive", 1.0), ("switching:0.6", 3.0), ("tom", 5.0), ("switching:0.1", 4.0), ("turn", 2.0)]
    rows += [("switching:0.001", 4.5)]
    summaries = pd.DataFrame(
        [
            {
                "scenario": "merger",
                "controller": name,
                "reward": reward,
                "kind": config["type"],
                "price": config.get("lambda"),
            }
            for name, reward in rows
            for config in [controller_config(name)]
        ]
    )
    assert telling_pair(summaries, "merger") == ["tom", "switching:0.1"]  # the paper's
    assert telling_pair(summaries[summaries["price"] != 0.1], "merger") == ["tom", "switching:0.001"]
    assert telling_pair(summaries[summaries["reward"] < 3], "merger") == ["naive", "turn"]
    assert telling_pair(summaries[summaries["reward"] == 5], "merger") == ["tom"]


def test_learned_values_are_shown_rather_than_switching_where_both_were_compared():
    rows = [
        ("tom", 5.0),
        ("switching:0.1", 4.0),
        ("learned:10", 3.0),
        ("learned:0.1:own.npz", 4.9),
        ("learned:0.01", 5),
    ]
    configs = [controller_config(name) if "own" not in name else {"type": "learned", "lambda": 0.1} for name, _ in rows]
    summaries = pd.DataFrame(rows, columns=["controller", "reward"]).assign(
        scenario="merger",
        kind=[config["type"] for config in configs],
        price=[config.get("lambda") for config in configs],
    )
    assert telling_pair(summaries, "merger") == ["tom", "learned:0.1:own.npz"]  # at the paper's lambda
    assert telling_pair(summaries.drop(index=3), "merger") == ["tom", "learned:0.01"]
    assert choosing_controllers(summaries, "merger") == ["learned:0.1:own.npz", "switching:0.1"]


def test_a_timeline_has_a_row_for_every_controller_that_chooses_online():
    steps = [
        {"controller": name, "step": step, "model": model}
        for name in ("tom", "switching:0.1", "learned:0.1")
        for step, model in enumerate(("tom", "naive"))
    ]
    records = pd.DataFrame(steps).assign(scenario="merger", seed=0, planning_seconds=1e-3, decision_seconds=1e-4)
    above, *rows = timeline(records, "merger").axes
    assert [row.get_title(loc="left") for row in rows] == ["switching:0.1", "learned:0.1"]
    assert len({line.get_color() for line in above.lines}) == 3
