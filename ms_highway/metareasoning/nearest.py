"""Predict the nearest humans by the top of the ladder, and all others by the first rung."""

from dataclasses import dataclass, field

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.game import Game
from ms_highway.metareasoning.rule import Decision, Memory, Outcome, unestimated
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import Index


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Nearest:
    """Predict the nearest humans by the top of the ladder, and all others by the first rung.

    Attributes:
        count: number of humans on the top rung.
        ladder: human models (static).
    """

    count: Index
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})

    def look(self, game: Game, memory: Memory, outcome: Outcome) -> Float[jax.Array, "humans 1"]:
        """Return the distance of every human."""
        places = jnp.asarray(outcome.after)[: 1 + game.number, :2]
        return jnp.linalg.norm(places[1:] - places[0], axis=1, keepdims=True)

    def choose(self, memory: Memory, seen: Float[jax.Array, "humans 1"]) -> Decision:
        """See `ms_highway.metareasoning.rule.Rule.choose`; of equal distances, the first human counts as nearer."""
        place = jnp.argsort(jnp.argsort(seen[:, 0]))
        return unestimated(memory, jnp.where(place < self.count, len(self.ladder) - 1, 0))
