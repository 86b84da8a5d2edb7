"""Agents that learn to choose human models, beside every other way to choose, from the same starts."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from pathlib import Path

import pandas as pd

from ms_highway.benchmarks.dqn_peer import Trained, Training, steps_per_second, trained
from ms_highway.experiments.analysis.regret import best_for_all, meta_reward, regrets
from ms_highway.experiments.analysis.tradeoff import coin
from ms_highway.experiments.frontier import Outcomes, controller_name
from ms_highway.experiments.simulated import run_episodes, summarised
from ms_highway.runtime.files import read_json, replacing

__all__ = ["LONGEST_PERIOD", "Budget", "periods", "standings", "train_all"]

LONGEST_PERIOD = 20  # steps


@dataclass(frozen=True)
class Budget:
    """How long agents are trained.

    Attributes:
        seconds: of training; how many steps that is, is measured first.
        steps: instead of seconds.
        times: every agent is trained for each of these multiples, from scratch.
    """

    seconds: float = 180.0
    steps: int | None = None
    times: Sequence[float] = (1.0, 10.0)

    def name(self, times: float) -> str:
        """Return what a multiple of the budget is called, such as ``180 s``."""
        return f"{times * self.seconds:g} s" if self.steps is None else f"{round(times * self.steps)} steps"


def periods(models: Sequence[str]) -> list[str]:
    """Return the short names of the controllers that plan with the last model in every k-th step, else the first."""
    return [f"period:{models[-1]}=1,{models[0]}={rest}" for rest in range(1, LONGEST_PERIOD)]


def train_all(
    trainings: Sequence[Training], budget: Budget, seeds: range, directory: Path, process: Executor
) -> Iterator[tuple[str, Trained | None]]:
    """Train agents one after the other; read what earlier runs have left in a directory, and keep what is done there.

    Args:
        trainings: what is trained.
        budget: for how long.
        seeds: of the episodes in which agents choose.
        directory: of the kept files, one per agent.
        process: in which agents are trained, see `ms_highway.benchmarks.processes.own_process`.

    Yields:
        The name of each agent, first without what it chose, when its training begins, and then with it.

    Raises:
        ImportError: without stable-baselines3.
        ValueError: if a kept file cannot be read.
    """
    for training in trainings:
        once = float(budget.steps or 0)
        for times in budget.times:
            name = f"DQN, {training.settings}, {budget.name(times)}"
            yield name, None
            file = directory / re.sub(r"\W+", "_", f"{training.scenario}, {name}, seed {training.seed}")
            file = file.with_name(f"{file.name}.json")
            agent = _read(file) if file.exists() else None
            if agent is None or not set(seeds) <= agent.orders.keys():
                once = once or budget.seconds * process.submit(steps_per_second, training).result()
                agent = process.submit(trained, training, round(times * once), seeds).result()
                with replacing(file) as path:
                    path.write_text(json.dumps(asdict(training) | asdict(agent)) + "\n")
            yield name, agent


def _read(file: Path) -> Trained:
    try:
        kept = read_json(file)
        orders = {int(seed): tuple(order) for seed, order in kept["orders"].items()}
        rewards = {int(seed): float(reward) for seed, reward in kept["rewards"].items()}
        return Trained(int(kept["steps"]), float(kept["seconds"]), orders, rewards)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"{file} cannot be read ({error}); remove it or choose another directory") from error


def standings(
    outcomes: Outcomes,
    agents: Mapping[str, Trained],
    controllers: Sequence[str],
    switching: Sequence[str],
    seeds: Sequence[int],
    price: float,
) -> pd.DataFrame:
    """Compare agents with fixed models, the best fixed period, chance, switching and the best orders that are known.

    What an agent earns is simulated with the order of models that it chose.

    Args:
        outcomes: the scenario, after a search for its best orders.
        agents: what agents chose, by name.
        controllers: short names of others; chance has the shares of the first, or else of the best of switching.
        switching: short names of controllers of which the best is compared.
        seeds: of the starts.
        price: lambda of the meta-reward [reward per second of planning].

    Returns:
        Rows as `ms_highway.experiments.analysis.regret.regrets`, with a column ``remark``.
    """
    models = [model.name for model in outcomes.batch.loop.rule.ladder]
    period, switcher = (_best(outcomes, names, seeds, price) for names in (periods(models), switching))
    blind = _coin(outcomes, controllers[0] if controllers else switcher, seeds)
    said = dict.fromkeys([*models, *controllers], "") | {
        period: f"best period of 2 to {LONGEST_PERIOD}",
        blind: f"shares of {controllers[0] if controllers else switcher}",
        switcher: "best lambda",
        **{name: f"{agent.steps:,} steps, {agent.seconds:.0f} s" for name, agent in agents.items()},
    }
    orders = {
        name: {seed: controller_name(models, agent.orders[seed]) for seed in seeds} for name, agent in agents.items()
    }
    known = [name for name in said if name not in agents]
    outcomes.of([(name, seed) for name in known for seed in seeds])
    outcomes.of([(order, seed) for own in orders.values() for seed, order in own.items()])
    common = best_for_all(outcomes.table, seeds, price)
    said[common] = ", ".join(filter(None, (said.get(common), "best for all starts")))
    rows = regrets(outcomes.table, known, seeds, price, orders)
    return rows.assign(remark=[said.get(str(name), "") for name in rows.index])


def _best(outcomes: Outcomes, names: Sequence[str], seeds: Sequence[int], price: float) -> str:
    """Return which of some controllers has the highest mean meta-reward."""
    rows = outcomes.of([(name, seed) for name in names for seed in seeds])
    return str(meta_reward(rows, price).groupby("controller").mean().idxmax())


def _coin(outcomes: Outcomes, controller: str, seeds: Sequence[int]) -> str:
    """Return the short name of the random controller with a controller's shares of the models."""
    keys = [(controller, seed) for seed in seeds]
    episodes = summarised(outcomes.batch, keys, run_episodes(outcomes.batch, keys))
    means = episodes.groupby(["scenario", "controller"], as_index=False).mean(numeric_only=True)
    return coin(means, outcomes.batch.scenario.name, controller)
