"""The search for the best orders of models, and regrets, by `ms-highway frontier`."""

import shutil

import numpy as np
import pandas as pd
import pytest
from commands import run

from ms_highway.experiments.frontier import BEST_PER_START
from ms_highway.experiments.runner import episode, make_environment

PRICES = 0.03, 0.1
CONTROLLERS = ["naive", "turn", "random:naive=0.75,turn=0.25", "switching:0.1"]
SEARCH = (
    "frontier merger --set ladder=naive,turn --seeds 3 --prices 0.03 0.1 --lambdas 0.1"
    " --population 16 --rounds 4 "
)
SEARCH += f"--controllers {CONTROLLERS[2]} --out"


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    directory = tmp_path_factory.mktemp("frontier")
    run(f"{SEARCH} {directory}")
    return directory


@pytest.mark.slow
def test_regrets_compare_to_the_best_tried_order_of_each_start(searched):
    """Such an order earns the same in the environment."""
    tried = pd.read_csv(searched / "merger_episodes.csv")
    for price in PRICES:
        tried["net"] = tried["reward"] - price * tried["counted_seconds"]

        # The best orders are the best of all that were tried.
        orders = pd.read_csv(searched / "orders.csv").query("price == @price")
        best = orders.set_index("seed")
        highest = tried.groupby("seed")["net"].max()
        np.testing.assert_allclose(best["meta_reward"], highest)

        # Regrets are what controllers lack to them.
        regrets = pd.read_csv(searched / "regrets.csv").query("price == @price")
        regrets = regrets.set_index("controller")
        assert regrets.loc[BEST_PER_START, "regret"] == 0
        own = tried.groupby("controller")["net"].mean()[CONTROLLERS]
        lacking = best["meta_reward"].mean() - own
        np.testing.assert_allclose(regrets.loc[own.index, "regret"], lacking)
        ends = regrets["regret_low"], regrets["regret_high"]
        assert regrets["regret"].between(*ends).all()

        for seed, row in best.iterrows():
            ladder = ["naive", "turn"]
            env = make_environment("merger", row["controller"], ladder=ladder)
            steps = pd.DataFrame(episode(env, seed))
            counted = steps["counted_seconds"].mean()
            assert steps["reward"].mean() == pytest.approx(row["reward"], abs=1e-3)
            assert counted == pytest.approx(row["counted_seconds"])


@pytest.mark.slow
def test_a_killed_search_resumes_and_gives_the_same_results(
    searched, tmp_path, capsys, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "200")
    episodes = "merger_episodes.csv"
    shutil.copy(searched / "settings.json", tmp_path)
    lines = (searched / episodes).read_text().splitlines(keepends=True)
    (tmp_path / episodes).write_text("".join(lines[: len(lines) // 2]))
    run(f"{SEARCH} {tmp_path}")
    for name in (episodes, "orders.csv", "regrets.csv"):
        assert (tmp_path / name).read_bytes() == (searched / name).read_bytes()
    assert (tmp_path / "merger_frontier.png").exists()
    printed = capsys.readouterr().out
    for name in (*CONTROLLERS[2:], BEST_PER_START):
        assert printed.count(name) >= len(PRICES)
