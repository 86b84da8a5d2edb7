"""Evaluate what a learned value of computation sees: in every state of an episode, and in a slice of the states."""

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float, Int

from ms_highway.envs.base import InteractionEnv
from ms_highway.game.game import Game
from ms_highway.metareasoning.learned_value import LearnedValue
from ms_highway.metareasoning.rule import first_memory
from ms_highway.metareasoning.situation import describe
from ms_highway.runtime.arrays import Array

__all__ = ["Advantages", "Slice", "along_episode", "estimate", "slice_of_starts"]

BEHIND = (-5.0, 15.0)  # m
FASTER = (-4.0, 4.0)  # m/s
CELLS = 61  # of a slice, in each direction


@dataclass(frozen=True)
class Advantages:
    """What planning a step with each rung is worth more than with the cheapest one, net of its price.

    Attributes:
        models: names of the rungs.
        price: lambda [reward per second].
        mean: of the networks' estimates.
        deviation: standard deviation among the networks.
        chosen: the rung that is chosen.
    """

    models: tuple[str, ...]
    price: float
    mean: Float[np.ndarray, "*states rungs"]
    deviation: Float[np.ndarray, "*states rungs"]
    chosen: Int[np.ndarray, "*states"]


@dataclass(frozen=True)
class Slice:
    """Advantages around a start, by where the human is.

    Attributes:
        behind: how far the human is behind the robot [m], the slice's columns.
        faster: how much faster than the robot it is [m/s], the slice's rows.
        advantages: of every row and column.
        start: ``(behind, faster)`` of the start itself.
    """

    behind: Float[np.ndarray, "columns"]
    faster: Float[np.ndarray, "rows"]
    advantages: Advantages
    start: tuple[float, float]


def estimate(rule: LearnedValue, game: Game, states: Float[np.ndarray, "states cars 4"]) -> Advantages:
    """Estimate the advantages in some states."""
    means, deviations, chosen = _estimate(rule, game, np.asarray(states, np.float32))
    names = tuple(model.name for model in rule.ladder)
    return Advantages(names, float(rule.price), np.asarray(means), np.asarray(deviations), np.asarray(chosen))


@jax.jit
def _estimate(
    rule: LearnedValue, game: Game, states: Float[jax.Array, "states cars 4"]
) -> tuple[Float[Array, "states rungs"], Float[Array, "states rungs"], Int[Array, "states"]]:
    memory, alone = first_memory(rule), jax.tree.map(lambda part: part[:, None], rule.network)

    def one(state: Float[jax.Array, "cars 4"]) -> tuple[Array, Array, Array]:
        seen = describe(game, state)
        decision = rule.choose(memory, seen)
        each = jax.vmap(lambda network: replace(rule, network=network).choose(memory, seen).gains)(alone)
        return decision.gains, each.std(axis=0), decision.memory.rung

    return jax.vmap(one)(states)


def along_episode(
    env: InteractionEnv, rule: LearnedValue, seed: int
) -> tuple[Advantages, list[str], Float[np.ndarray, "steps"]]:
    """Drive an episode with the environment's controller.

    Returns:
        The advantages before each step, the model that planned it, and the reward after it.
    """
    env.reset(seed=seed)
    states, done = [], False
    while not done:
        states.append(env.car_states)
        _, _, terminated, truncated, _ = env.step(0)
        done = terminated or truncated
    rewards = np.array([record["reward"] for record in env.history])
    return estimate(rule, env.game, np.array(states)), [record["model"] for record in env.history], rewards


def slice_of_starts(rule: LearnedValue, game: Game, start: Float[np.ndarray, "cars 4"], cells: int = CELLS) -> Slice:
    """Estimate the advantages where the human starts elsewhere along the road, and at another speed.

    Args:
        rule: at a price.
        game: that is played.
        start: of all cars, robot first and human second.
        cells: number of columns and of rows.
    """
    robot, human = np.asarray(start, float)[:2]
    behind, faster = np.linspace(*BEHIND, cells), np.linspace(*FASTER, cells)
    states = np.tile(np.asarray(start, float), (cells, cells, 1, 1))
    states[:, :, 1, 0] = robot[0] - behind
    states[:, :, 1, 3] = robot[3] + faster[:, None]
    flat = estimate(rule, game, states.reshape(-1, *np.shape(start)))
    shape = (cells, cells)
    advantages = replace(
        flat,
        mean=flat.mean.reshape(*shape, -1),
        deviation=flat.deviation.reshape(*shape, -1),
        chosen=flat.chosen.reshape(shape),
    )
    return Slice(behind, faster, advantages, (robot[0] - human[0], human[3] - robot[3]))
