"""The tables and figures of results in README and page are those of the files that are kept beside the page."""

import json
import runpy
from types import SimpleNamespace

import pandas as pd
import pytest
from pages import README, RESULTS, ROOT

from ms_highway.experiments.analysis.tradeoff import meta_rewards

KEPT = RESULTS.parent
COLLECTED = SimpleNamespace(**runpy.run_path(str(KEPT / "collect.py")))
TEXT = RESULTS.read_text()
FLOWING = " ".join(TEXT.split())


def test_every_table_with_a_name_is_that_of_the_files():
    tables = COLLECTED.tables()
    for name, table in tables.items():
        page = README if name == "shown" else RESULTS
        assert f"<!-- table: {name} -->\n{table}\n\n" in page.read_text()
    assert sum(page.read_text().count("<!-- table:") for page in (README, RESULTS)) == len(tables)
    assert tables["shown"].count("\n") - 1 <= 8


def test_every_run_tells_its_settings_and_what_made_it():
    made = json.loads((KEPT / "settings.json").read_text())
    assert list(made) == list(COLLECTED.RUNS)
    for run in made.values():
        assert run["settings"]["semantics"] in ("paper", "released")
        assert all(one["command"].startswith("ms-highway ") for one in run["provenance"])
        assert run["provenance"]


def test_results_that_are_collected_again_are_the_kept_ones(tmp_path):
    results, kept = tmp_path / "results", tmp_path / "kept"
    kept.mkdir()
    for run, made in json.loads((KEPT / "settings.json").read_text()).items():
        (results / run).mkdir(parents=True)
        for name, content in made.items():
            (results / run / f"{name}.json").write_text(json.dumps(content))
    for name in COLLECTED.TABLES:
        table = pd.read_csv(KEPT / f"{name}.csv", dtype=str, keep_default_na=False)
        for run, rows in table.groupby("run"):
            rows.drop(columns="run").to_csv(results / run / f"{name}.csv", index=False)
    for name in COLLECTED.ROADS:
        (results / name).mkdir()
        for scene, drivers in json.loads((KEPT / f"{name}.json").read_text()).items():
            (results / name / f"{scene}.json").write_text(json.dumps({scene: drivers}))
    COLLECTED.collect(results, kept)
    for file in kept.iterdir():
        assert file.read_text() == (KEPT / file.name).read_text()
    COLLECTED.collect(tmp_path, kept)  # without any run, all stay
    for file in kept.iterdir():
        assert file.read_text() == (KEPT / file.name).read_text()


def test_tables_are_written_below_their_names(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("before\n\n<!-- table: one -->\n| old |\n| --- |\n\nafter\n")
    COLLECTED.rewrite(page, {"one": "| new |\n| --- |\n| 1 |", "two": "| no place |"})
    assert page.read_text() == "before\n\n<!-- table: one -->\n| new |\n| --- |\n| 1 |\n\nafter\n"


@pytest.mark.parametrize(
    ("scenario", "controller"),
    [
        ("merger", "schedule:tom=7,naive"),
        ("give_way", "schedule:tom=10,naive"),
        ("merger", "switching:0.02"),
        ("merger", "switching:0.1"),
        ("merger", "switching:0.01"),
        ("give_way", "switching:0.002"),
        ("give_way", "switching:0.01"),
    ],
)
def test_shares_of_reward_and_planning_are_those_of_the_summary_they_come_from(scenario, controller):
    rows = COLLECTED.comparison("curve").summaries.query("scenario == @scenario").set_index("controller")
    share = (rows.loc[controller, ["reward", "counted_ms"]] / rows.loc["tom", ["reward", "counted_ms"]]).astype(float)
    assert f"{100 * share['reward']:.0f} % at {100 * share['counted_ms']:.0f} %" in FLOWING


def test_the_sentences_of_the_readme_are_those_of_the_summaries_they_come_from():
    text = " ".join(README.read_text().split())
    compared = COLLECTED.comparison("compare").summaries.query("scenario == 'merger'").set_index("controller")
    gains = compared["reward"] - compared["reward"]["naive"]
    kept = gains["switching:0.1"] / gains["tom"]
    thinking = compared["share_tom"]["switching:0.1"]
    assert (
        f"{100 * kept:.0f} % of what always-`tom` gains over `naive`, with theory of mind in {100 * thinking:.0f} % of"
        in text
    )


def test_collisions_in_the_text_are_those_that_were_counted():
    counts = {
        run: COLLECTED.comparison(run).summaries.set_index(["scenario", "controller"])["collision_episodes"]
        for run in COLLECTED.LIMITS
    }
    assert f"in {counts['limit_9']['merger', 'tom']} of 300 episodes of Merger" in FLOWING
    assert (counts["limit_50"][["merger", "give_way"]] == 0).all()
    assert (counts["limit_9"]["stay_back"] == 300).all()


def test_always_tom_is_better_than_switching_by_the_meta_reward_as_the_text_says():
    for scenario in ("merger", "give_way"):
        table = meta_rewards(COLLECTED.comparison("curve").summaries, scenario)
        assert (table["tom"] > table["switching"]).all()
        assert [table.index.min(), table.index.max()] == [0.001, 3]
    assert all("every lambda from 0.001 to 3" in " ".join(page.read_text().split()) for page in (README, RESULTS))


def test_learned_values_stay_behind_the_best_orders_by_as_little_as_the_text_says():
    behind = COLLECTED.kept_table("regrets", "frontier")
    for scenario in ("merger", "give_way"):
        for price, share in ((0.1, 0.01), (1.0, 0.01), (10.0, 0.03)):
            own = behind[(behind["scenario"] == scenario) & (behind["price"] == price)].set_index("controller")
            always = own["reward"]["tom"]
            learned = own["regret"][f"learned:{price:g}"]
            assert learned < share * always
            assert learned < own.loc[own["kind"].isin(["switching", "horizon"]), "regret"].min()
    assert "at most 1 % of always-tom's reward at prices of 0.1 and 1, and 3 % at 10" in FLOWING


def test_no_figure_is_without_a_page():
    shown = README.read_text() + TEXT
    figures = list((ROOT / "notebooks" / "figures").iterdir())
    assert figures
    assert all(f"figures/{figure.name})" in shown for figure in figures)
