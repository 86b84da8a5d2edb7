"""Predict the nearest humans by the top of the ladder, and all others by the first rung."""

from dataclasses import dataclass, field

import jax
from jax import numpy as jnp

from ms_highway.choice.rule import Decision, Memory, Outcome, Rule, unestimated
from ms_highway.choice.situation import nearness
from ms_highway.game.game import Game
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import Index


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Nearest(Rule):
    """Predict the nearest humans by the top of the ladder, and all others by the first rung.

    Attributes:
        count: number of humans on the top rung.
        ladder: human models (static).
    """

    count: Index
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})

    def decide(self, game: Game, memory: Memory, outcome: Outcome) -> Decision:
        """Choose by the distances after the last step."""
        rank = nearness(game, outcome.after)
        return unestimated(memory, jnp.where(rank < self.count, len(self.ladder) - 1, 0))
