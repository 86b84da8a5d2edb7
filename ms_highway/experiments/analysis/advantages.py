"""Evaluate what a learned value of computation sees: in every state of an episode, and around its start."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np

from ms_highway.envs import ENVIRONMENTS, environment_id
from ms_highway.experiments.runner import episode, make_environment
from ms_highway.game.game import Game
from ms_highway.metareasoning.learned_value import LearnedValue
from ms_highway.metareasoning.rule import first_memory
from ms_highway.metareasoning.situation import describe
from ms_highway.metareasoning.values import load_values
from ms_highway.runtime.arrays import Array

BEHIND = (-5.0, 15.0)  # m
FASTER = (-4.0, 4.0)  # m/s
CELLS = 61  # around a start, in each direction


class Advantages(NamedTuple):
    """What planning a step with each rung is worth more than with the cheapest one, net of its price.

    Attributes:
        compared: what the choice is by, less a margin for doubt, an array [..., rungs].
        expected: without the margin, an array [..., rungs].
        chosen: the rung that is chosen, an array [...].
    """

    compared: Array
    expected: Array
    chosen: Array


@dataclass(frozen=True)
class Seen:
    """What learned values see of an episode that they choose for.

    Attributes:
        models: names of the rungs.
        along: before every step.
        used: the model that planned each step.
        rewards: after each step.
        behind: how far the human is behind the robot [m]: columns of what is around the start.
        faster: how much faster than the robot it is [m/s]: rows of what is around the start.
        around: where the human starts there.
        start: ``(behind, faster)`` of the start itself.
    """

    models: tuple[str, ...]
    along: Advantages
    used: list[str]
    rewards: np.ndarray
    behind: np.ndarray
    faster: np.ndarray
    around: Advantages
    start: tuple[float, float]


def see(scenario: str, price: float, values: str, seed: int = 0, cells: int = CELLS) -> Seen:
    """Drive an episode by learned values, and estimate advantages in it and around its start.

    Args:
        scenario: its name.
        price: lambda [reward per second].
        values: ``"shipped"``, or a file of `ms_highway.metareasoning.values`.
        seed: of the episode.
        cells: number of columns and of rows around the start.

    Raises:
        ValueError: for an unknown scenario, an impossible price, or values of another ladder.
    """
    environment_id(scenario)
    learned = load_values(values, ENVIRONMENTS[scenario].scenario.humans)
    costs: Any = dict(zip(learned.ladder, learned.costs, strict=True)) if learned.costs else "measured"
    env = make_environment(scenario, f"learned:{price}:{values}", costs=costs)
    inner: Any = env.unwrapped
    env.reset(seed=seed)
    start = np.asarray(inner.car_states, float)
    rule, states, records = inner.robot.controller.rule, [start], []
    for record in episode(env, seed):
        records.append(record)
        states.append(inner.car_states)
    (x, _, _, speed), (place, _, _, human_speed) = start[:2]
    behind, faster = np.linspace(*BEHIND, cells), np.linspace(*FASTER, cells)
    around = np.tile(start, (cells, cells, 1, 1))
    around[:, :, 1, 0], around[:, :, 1, 3] = x - behind, speed + faster[:, None]
    return Seen(
        tuple(model.name for model in rule.ladder),
        estimate(rule, inner.game, np.array(states[:-1])),
        [record["model"] for record in records],
        np.array([record["reward"] for record in records]),
        behind,
        faster,
        estimate(rule, inner.game, around),
        (x - place, human_speed - speed),
    )


def estimate(rule: LearnedValue, game: Game, states: np.ndarray) -> Advantages:
    """Estimate the advantages for the first human in some states, an array [..., cars, 4]."""
    found = _estimate(rule, game, np.asarray(states, np.float32).reshape(-1, *states.shape[-2:]))
    return jax.tree.map(lambda part: np.reshape(part, (*states.shape[:-2], *part.shape[1:])), found)


@jax.jit
def _estimate(rule: LearnedValue, game: Game, states: Array) -> Advantages:
    memory = first_memory(rule, game.number)

    def one(state: Array) -> Advantages:
        seen = describe(game, state, surroundings=rule.baseline == "cheapest")
        decision, bold = rule.choose(memory, seen), replace(rule, cautious=False).choose(memory, seen)
        return Advantages(decision.gains[0], bold.gains[0], decision.memory.rungs[0])

    return jax.vmap(one)(states)
