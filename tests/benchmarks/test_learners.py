"""Agents that learn to choose models, beside other ways to choose: `ms-highway learners`."""

import json
import re

import numpy as np
import pandas as pd
import pytest

from ms_highway.benchmarks.dqn_peer import SETTINGS, OwnStarts, Training, trained
from ms_highway.cli import learners
from ms_highway.cli.main import main
from ms_highway.envs import MergerEnv
from ms_highway.experiments.analysis.regret import BEST_PER_START
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.settings import write_settings

LADDER, SEEDS = ["naive", "turn"], 3
COMMAND = ["learners", "merger", "--ladder", *LADDER, "--seeds", "3", "--population", "8", "--rounds", "2"]
COMMAND += ["--price", "0.1", "--steps", "1000", "--times", "1", "2"]
ORDERS = {"1000": [1] * 40, "2000": [1] * 5 + [0] * 35}  # by steps of training
OTHERS = ["--controllers", "schedule:turn=5,naive"]


def begin(directory):
    """Leave what a run leaves that was stopped while it trained."""
    common = Comparison({"merger": LADDER}, ladder=LADDER).common_config()
    write_settings(directory, {**common, "costs": "published", "price": 0.1})


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """Results with agents that were trained before, or so their files say."""
    directory = tmp_path_factory.mktemp("learners")
    begin(directory)
    for steps, order in ORDERS.items():
        agent = {"steps": int(steps), "seconds": 1.5, "orders": {}, "rewards": {}}
        for seed in range(SEEDS):
            agent["orders"][str(seed)], agent["rewards"][str(seed)] = order, 0.0
        (directory / f"merger_DQN_default_{steps}_steps_seed_0.json").write_text(json.dumps(agent))
    assert main([*COMMAND, *OTHERS, "--out", str(directory)]) == 0
    return directory


def test_an_agent_earns_what_the_order_that_it_chose_earns(compared):
    rows = pd.read_csv(compared / "learners.csv").set_index("controller")
    for name, same in (("DQN, default, 1000 steps", "turn"), ("DQN, default, 2000 steps", OTHERS[1])):
        assert rows.loc[name, "kind"] == "agent"
        columns = ["reward", "counted_seconds", "meta_reward", "regret"]
        np.testing.assert_array_equal(rows.loc[name, columns].astype(float), rows.loc[same, columns].astype(float))
    assert rows.loc["DQN, default, 2000 steps", "remark"] == "2,000 steps, 2 s"


def test_every_way_to_choose_is_compared_from_the_same_starts(compared):
    rows = pd.read_csv(compared / "learners.csv").set_index("controller")
    kinds = ["fixed", "schedule", "period", "random", "switching", "agent", "search"]
    assert list(dict.fromkeys(rows["kind"])) == kinds
    assert (rows["regret"] >= 0).all()
    assert rows.index[-1] == BEST_PER_START
    assert rows["remark"].str.contains("best for all starts").sum() == 1
    (chance,) = rows.index[rows["kind"] == "random"]
    assert chance == "random:naive=0.875,turn=0.125"  # as 5 of 40 steps
    episodes = pd.read_csv(compared / "merger_episodes.csv").set_index(["controller", "seed"])["reward"]
    periods = {name for name, _ in episodes.index if name.startswith("period:turn=1,naive=")}
    assert len(periods) == 19
    meta = {name: rows.loc[name, "meta_reward"] for name in rows.index if name in periods}
    seconds = pd.read_csv(compared / "merger_episodes.csv").set_index(["controller", "seed"])["counted_seconds"]
    assert max(meta.values()) == pytest.approx(max((episodes[name] - 0.1 * seconds[name]).mean() for name in periods))


def test_training_never_starts_from_a_numbered_seed_and_is_reproducible():
    environment = MergerEnv({"action": {"type": "HumanModelAction", "lambda": 1.0}})
    numbered = {environment.reset(seed=seed)[0].tobytes() for seed in range(20)}
    starts = []
    for seed in (0, 0, 1):
        own = OwnStarts(environment, seed)
        starts.append([own.reset(seed=number)[0].tobytes() for number in range(20)])
    assert starts[0] == starts[1]
    assert not set(starts[0]) & set(starts[2])
    assert not numbered & {*starts[0], *starts[2]}
    assert len(set(starts[0])) == 20


def test_the_settings_that_the_help_names_are_those_that_there_are():
    assert tuple(SETTINGS) == learners.SETTINGS


@pytest.mark.slow
def test_an_agent_is_trained_again_to_the_same_choices_and_drives_as_it_is_simulated(tmp_path):
    pytest.importorskip("stable_baselines3", reason='needs the extra learning: pip install -e ".[learning]"')
    arguments = [*COMMAND, "--settings", "highway-env", "--times", "1", "--steps", "600", "--out", str(tmp_path)]
    assert main(arguments) == 0
    (file,) = tmp_path.glob("merger_DQN_*.json")
    kept = json.loads(file.read_text())
    config = {key: kept["config"][key] for key in ("ladder", "semantics", "solver", "human_reward", "costs")}
    again = trained(Training("merger", 0.1, "highway-env", 0, config), 600, range(SEEDS))
    assert {str(seed): list(order) for seed, order in again.orders.items()} == kept["orders"]
    rows = pd.read_csv(tmp_path / "learners.csv").set_index("controller")
    (reward,) = rows.loc[rows["kind"] == "agent", "reward"]
    assert reward == pytest.approx(np.mean(list(kept["rewards"].values())), abs=1e-3)


def test_a_kept_agent_that_cannot_be_read_is_named(tmp_path, capsys):
    begin(tmp_path)
    (tmp_path / "merger_DQN_default_1000_steps_seed_0.json").write_text("[]")
    assert main([*COMMAND, "--out", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert re.search(r"merger_DQN_default_1000_steps_seed_0\.json cannot be read .*; remove it", line)
