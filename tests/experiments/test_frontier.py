"""The search for the best orders of models, and regrets, by `ms-highway frontier`."""

import json
import shutil
from itertools import product

import imageio.v3 as imageio
import numpy as np
import pandas as pd
import pytest
from commands import run

from ms_highway.experiments.frontier import BEST_PER_START
from ms_highway.experiments.runner import episode, make_environment

LADDER = ["naive", "turn"]
PRICES = 0.03, 0.1
OTHERS = ["period:turn=1,naive=3", "random:naive=0.75,turn=0.25"]
SEARCH = f"""frontier merger --set ladder=naive,turn --seeds 3 --prices 0.03 0.1 --lambdas 0.001 0.1 --controllers \
{OTHERS[0]} {OTHERS[1]} --population 16 --rounds 6 --out"""


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    directory = tmp_path_factory.mktemp("frontier") / "out"
    run(f"{SEARCH} {directory}")
    return directory


@pytest.mark.slow
@pytest.mark.parametrize("price", PRICES)
def test_regrets_compare_to_the_best_tried_order_of_each_start_which_earns_the_same_in_the_environment(searched, price):
    tried = pd.read_csv(searched / "merger_episodes.csv")
    tried["net"] = tried["reward"] - price * tried["counted_seconds"]
    found = pd.read_csv(searched / "orders.csv").query("price == @price").set_index("seed")
    np.testing.assert_allclose(found["meta_reward"], tried.groupby("seed")["net"].max())
    behind = pd.read_csv(searched / "regrets.csv").query("price == @price").set_index("controller")
    assert behind.loc[BEST_PER_START, "regret"] == 0
    own = tried.groupby("controller")["net"].mean()[["naive", "turn", *OTHERS, "switching:0.001", "switching:0.1"]]
    np.testing.assert_allclose(behind.loc[own.index, "regret"], found["meta_reward"].mean() - own)
    assert behind["regret"].between(behind["regret_low"], behind["regret_high"]).all()
    for seed, row in found.iterrows():
        steps = pd.DataFrame(episode(make_environment("merger", row["controller"], ladder=LADDER), seed))
        assert steps["reward"].mean() == pytest.approx(row["reward"], abs=1e-3)
        assert steps["counted_seconds"].mean() == pytest.approx(row["counted_seconds"])


@pytest.mark.slow
def test_a_killed_search_resumes_and_gives_the_same_results(searched, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    directory, file = tmp_path / "out", "merger_episodes.csv"
    directory.mkdir()
    shutil.copy(searched / "settings.json", directory)
    lines = (searched / file).read_text().splitlines(keepends=True)
    (directory / file).write_text("".join(lines[: len(lines) // 2]))
    run(f"{SEARCH} {directory}")
    for name in (file, "orders.csv", "regrets.csv"):
        assert (directory / name).read_bytes() == (searched / name).read_bytes()
    assert len(json.loads((directory / "provenance.json").read_text())) == 1
    assert imageio.imread(directory / "merger_frontier.png").std() > 5
    printed = capsys.readouterr().out
    for price, word in product(PRICES, ("switching:", BEST_PER_START, *OTHERS)):
        assert word in printed.partition(f"a second of planning costs {price:g}")[2]
