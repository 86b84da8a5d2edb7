"""The tables and sentences of README and results page agree with the files that are
kept beside the page.
"""

import json
import re
import runpy
from itertools import chain
from types import SimpleNamespace

import pandas as pd
from test_pages import README, RESULTS, TEXTS

from ms_highway.benchmarks.road.episodes import Block, row, run_episode
from ms_highway.benchmarks.road.peers import RecordedStart
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.frontier import Outcomes

KEPT = RESULTS.parent
COLLECTED = SimpleNamespace(**runpy.run_path(str(KEPT / "collect.py")))
FLOWING = " ".join((TEXTS[README] + TEXTS[RESULTS]).split())


def kept_texts():
    return {file: file.read_text() for file in KEPT.iterdir() if file.is_file()}


def summaries(run, scenario):
    return (
        COLLECTED.comparison(run)
        .summaries.query(f"scenario == '{scenario}'")
        .set_index("controller")
    )


def test_every_named_table_agrees_with_the_files():
    tables = COLLECTED.tables()
    for name, table in tables.items():
        assert (
            f"<!-- table: {name} -->\n{table}\n\n"
            in TEXTS[README if name == "physical" else RESULTS]
        )
    assert (TEXTS[README] + TEXTS[RESULTS]).count("<!-- table:") == len(tables)


def test_every_run_is_kept_with_settings_and_commands(tmp_path):
    before = kept_texts()
    made = json.loads(before[KEPT / "settings.json"])
    assert list(made) == list(COLLECTED.RUNS)
    for run in made.values():
        assert run["settings"]["semantics"] in ("paper", "physical", "released")
        assert all(
            one["command"].startswith("ms-highway ") for one in run["provenance"]
        )
    COLLECTED.collect(tmp_path)  # without any run
    assert kept_texts() == before


def test_sentences_on_shares_agree_with_the_summaries():
    for scenario, names in {
        "merger": [
            "learned:1",
            "schedule:tom=7,naive",
            "switching:0.02",
            "switching:0.1",
            "switching:0.01",
        ],
        "give_way": [
            "learned:1",
            "schedule:tom=10,naive",
            "switching:0.002",
            "switching:0.01",
        ],
    }.items():
        rows = summaries("curve", scenario)[["reward", "counted_ms"]]
        for _, share in (100 * rows.loc[names] / rows.loc["tom"]).iterrows():
            assert f"{share['reward']:.0f} % at {share['counted_ms']:.0f} %" in FLOWING


def test_sentences_on_switching_agree_with_the_summaries():
    merger = summaries("compare", "merger")
    gains = merger["reward"] - merger["reward"]["naive"]
    kept = 100 * gains / gains["tom"]
    effort = 100 * merger["counted_ms"] / merger["counted_ms"]["tom"]
    for name, sentence in {
        "learned:1": (
            "keeps {:.0f} % of what theory of mind gains over `naive`, for {:.0f} % of"
            " its planning"
        ),
        "switching:0.1": "`switching`, keeps {:.0f} % for {:.0f} % in Merger",
    }.items():
        assert sentence.format(kept[name], effort[name]) in FLOWING


def test_learned_values_have_the_small_regret_that_the_text_says():
    behind = (
        COLLECTED.kept_table("regrets", "frontier")
        .set_index(["scenario", "price", "controller"])
        .sort_index()
    )
    for scenario in ("merger", "give_way"):
        for price, share in ((0.1, 0.01), (1.0, 0.01), (10.0, 0.042)):
            own = behind.loc[scenario, price]
            learned = own["regret"][f"learned:{price:g}"]
            assert learned < share * own["reward"]["tom"]
            assert (
                learned
                < own.loc[own["kind"].isin(["switching", "horizon"]), "regret"].min()
            )
    assert (
        "by at most 1 % of always-tom's reward at prices of 0.1 and 1, and 4.2 % at 10"
        in FLOWING
    )


def test_the_glossary_explains_exactly_the_columns_of_all_csv_files():
    glossary = TEXTS[RESULTS].partition("## Columns of CSV files")[2]
    explained = "".join(re.findall(r"^\|( `[^|]*)", glossary, re.MULTILINE))
    kept = [pd.read_csv(KEPT / f"{name}.csv", nrows=0) for name in COLLECTED.TABLES]
    block = Block(
        "recorded", "idm", "replay", (RecordedStart("name", "file", "problem"),)
    )
    road = set(row(block, run_episode(Block("highway-fast-v0", "idm"), 0)))
    found = {
        *chain(*kept),
        *Comparison({"dense_merge": []}).columns(),
        *Outcomes.index,
        *Outcomes.columns,
        "meta_reward",
        *road,
    }
    columns_of_models = {
        re.sub("^(gain|share|humans)_.*", r"\1_MODEL", name) for name in found
    }
    assert columns_of_models == set(re.findall(r"`(\w+)`", explained))
