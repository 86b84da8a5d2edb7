"""The search for the best orders of models, and regrets: `ms-highway frontier`."""

import json
import shutil
from itertools import product
from types import SimpleNamespace

import imageio.v3 as imageio
import numpy as np
import pandas as pd
import pytest
from commands import run

from ms_highway.envs.registry import controller_config
from ms_highway.experiments.analysis.regret import BEST_PER_START
from ms_highway.experiments.frontier import controller_name, search
from ms_highway.experiments.runner import episode, make_environment

LADDER = ["naive", "turn"]
SEEDS, STEPS, PRICES = 3, 40, (0.03, 0.1)
OTHERS = ["period:turn=1,naive=3", "random:naive=0.75,turn=0.25"]
SEARCH = f"""frontier merger --set ladder=naive,turn --seeds 3 --prices 0.03 0.1 --lambdas 0.001 0.1 --controllers \
{OTHERS[0]} {OTHERS[1]} --population 16 --rounds 6 --out"""


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    directory = tmp_path_factory.mktemp("frontier") / "out"
    run(f"{SEARCH} {directory}")
    return directory


@pytest.fixture(scope="module")
def tried(searched):
    """All that was tried, with the meta-reward at each price."""
    table = pd.read_csv(searched / "merger_episodes.csv")
    return table.assign(**{str(price): table["reward"] - price * table["counted_seconds"] for price in PRICES})


@pytest.mark.slow
@pytest.mark.parametrize("price", PRICES)
def test_nothing_that_was_tried_from_a_start_is_better_than_its_best_order(searched, tried, price):
    found = pd.read_csv(searched / "orders.csv").query("price == @price").set_index("seed")["meta_reward"]
    np.testing.assert_allclose(found, tried.groupby("seed")[str(price)].max())
    behind = pd.read_csv(searched / "regrets.csv").query("price == @price").set_index("controller")
    assert behind.loc[BEST_PER_START, "regret"] == 0
    own = tried.groupby("controller")[str(price)].mean()[["naive", "turn", *OTHERS, "switching:0.001", "switching:0.1"]]
    np.testing.assert_allclose(behind.loc[own.index, "regret"], found.mean() - own)
    assert (behind["regret"] >= 0).all()
    assert (behind.loc[own.index, "regret_low"] < behind.loc[own.index, "regret"]).all()
    orders = tried[~tried["controller"].str.startswith(("switching", "random"))].groupby("controller")[str(price)]
    everywhere = orders.mean()[orders.size() == SEEDS]  # the best order for all starts is the best of these
    assert 20 < len(everywhere) < len(orders)
    said = behind.loc[behind["kind"].isin(["fixed", "schedule", "period"]), "meta_reward"]
    assert said.idxmax() == everywhere.idxmax()
    assert said.max() == pytest.approx(everywhere.max())


@pytest.mark.slow
def test_the_best_orders_earn_in_the_environment_what_the_search_says(searched):
    for row in pd.read_csv(searched / "orders.csv").query("price == 0.03").to_dict("records"):
        env = make_environment("merger", row["controller"], ladder=LADDER)
        steps = pd.DataFrame(episode(env, row["seed"]))
        assert steps["reward"].mean() == pytest.approx(row["reward"], abs=1e-3)
        assert steps["counted_seconds"].mean() == pytest.approx(row["counted_seconds"])


class Toy:
    """Outcomes that are known: a human at a time is worth thinking about, from step to step another one."""

    def __init__(self, humans):
        self.batch = SimpleNamespace(rungs=["naive", "tom"], steps=STEPS, humans=humans)
        self.table = {}

    def of(self, keys):
        for name, seed in keys:
            config = controller_config(name)
            models = list(config.get("models", [config.get("model")]))
            models += [models[-1]] * (STEPS - len(models))
            names = [model.split("/") if "/" in model else [model] * self.batch.humans for model in models]
            thinks = np.array(names) == "tom"
            pays = (np.arange(STEPS) // 4 + seed) % (self.batch.humans + 1)
            earned = [thinks[step, human - 1] for step, human in enumerate(pays) if human]
            self.table[name, seed] = sum(earned) / STEPS, thinks.sum() / STEPS
        return pd.DataFrame([self.table[key] for key in keys], columns=["reward", "counted_seconds"])

    def best(self, seed, price):
        return max(reward - price * seconds for (_, own), (reward, seconds) in self.table.items() if own == seed)


def test_the_search_finds_orders_that_are_better_than_all_with_a_single_switch():
    alone = Toy(1)
    assert list(search(alone, [0, 1], [0.5], 32, 8)) == list(range(1, 10))
    for seed in (0, 1):
        single = Toy(1)
        ends = product((("naive", "tom"), ("tom", "naive")), range(1, STEPS))
        single.of([(f"schedule:{one}={end},{other}", seed) for (one, other), end in ends])
        assert alone.best(seed, 0.5) > 2 * single.best(seed, 0.5)


def test_a_search_among_several_humans_changes_the_models_of_all_and_of_one():
    several = Toy(2)
    assert list(search(several, [0], [0.1], 16, 2)) == [1, 2, 3]
    names = {name for name, _ in several.table}
    assert {"naive", "tom"} <= names
    assert any("/" in name for name in names)


@pytest.mark.slow
def test_a_search_that_was_killed_goes_on_to_the_same_results(searched, tmp_path, capsys, monkeypatch):
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
    for price, word in product(PRICES, ("best lambda", "best for all starts", BEST_PER_START, *OTHERS)):
        assert word in printed.partition(f"a second of planning costs {price:g}")[2]
    assert printed.count("lambda = price") == 1  # switching:0.1 at a price of 0.1


def test_the_name_of_an_order_stands_for_its_models_step_by_step():
    random = np.random.default_rng(0)
    for order in random.integers(2, size=(20, STEPS, 1)):
        models = list(controller_config(controller_name(LADDER, order))["models"])
        assert [*models, *[models[-1]] * (STEPS - len(models))] == [LADDER[rung] for rung in order[:, 0]]
    assert controller_name(LADDER, np.ones((STEPS, 2), int)) == "turn"
    assert controller_name(LADDER, np.array([[0, 1], [0, 1], [1, 1]])) == "schedule:naive/turn=2,turn"
