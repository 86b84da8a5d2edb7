"""Choose rungs at a price per second of planning, or for the nearest humans.

`ms_highway.choice.budget` chooses within a time, `ms_highway.choice.rule.Order` takes
the rungs from a table.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import jax
from jax import numpy as jnp
from msgspec import Meta

from ms_highway.choice.rule import NOT_ESTIMATED, Chooser, GameEvidence, Memory, Priced
from ms_highway.choice.situation import nearness
from ms_highway.planning.costs import Costs
from ms_highway.runtime.arrays import Gains, Rungs

Humans = Annotated[
    int, Meta(ge=0, description="it must be a number of humans, 0 or more")
]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Price(Priced[object]):
    """Take the most expensive rung that is worth more than the rung in use, or stay.

    The worth of a rung is its gain less the price of its time, for each human alone. So
    Algorithm 1 goes to the top rung if that is worth more, or else one rung down if
    that is, as it estimates no other rung.
    """

    def choose(
        self,
        memory: Memory,
        gains: Gains,
        costs: Costs,
        evidence: object,
    ) -> Rungs:
        """Choose among the rungs with an estimate and a cost."""
        each = jnp.asarray(costs.each)  # [rungs]
        in_use = jnp.asarray(memory.rungs)[:, None]  # [humans, 1]
        places = jnp.arange(len(each))

        # Gain of the rung in use. Without a new estimate, the remembered one counts.
        own = jnp.take_along_axis(gains, in_use, axis=1)
        own = jnp.where(jnp.isfinite(own), own, jnp.asarray(memory.gain)[:, None])

        # What each rung is worth more than that one, [humans, rungs].
        known = gains > NOT_ESTIMATED
        gained = jnp.where(known, gains, own) - own
        worth = gained - self.price * (each - each[in_use])
        best = jnp.where(known & (worth > 0), places, -1).max(axis=1)
        return jnp.where(best >= 0, best, in_use[:, 0])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PriceFromFirst(Priced[object]):
    """Take the most expensive rung whose gain over the first one is worth its time.

    The rung in use does not matter: where humans come and go, as on stock roads, it may
    be another one's.
    """

    def choose(
        self,
        memory: Memory,
        gains: Gains,
        costs: Costs,
        evidence: object,
    ) -> Rungs:
        """Choose for each human alone; without such a rung, it is the first one."""
        prices = self.price * jnp.asarray(costs.each)
        places = jnp.arange(gains.shape[1])
        return jnp.where(gains >= prices, places, 0).max(axis=1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PriceTogether(Priced[GameEvidence]):
    """Take one rung for some of the nearest humans together, whichever are worth most.

    All others get the first rung. The worth of a rung is its gain less the price of its
    time, and that of a human without estimates is 0. For each rung, the worths are
    added up from the nearest human outwards. The rung and the number of humans with the
    highest sum are chosen.

    Attributes:
        most_humans: largest number of humans, the nearest ones, with a higher rung than
            the first. A gap may open only if two of them yield together.
    """

    most_humans: ClassVar[int] = 4

    def choose(
        self,
        memory: Memory,
        gains: Gains,
        costs: Costs,
        evidence: GameEvidence,
    ) -> Rungs:
        """Choose by the distances after the last step."""
        rank = nearness(evidence.game, evidence.outcome.after)
        nearest = jnp.argsort(rank)[: self.most_humans]
        gained = gains[nearest]  # [nearest, rungs]
        net = gained - jnp.asarray(costs.each)
        known = jnp.isfinite(net).all(axis=1, keepdims=True)

        # What each rung is worth more than the first one.
        values = jnp.where(known, gained, 0.0) - self.price * jnp.asarray(costs.each)
        worth = jnp.where(known, values - values[:, :1], 0.0)

        # The same for a human and all nearer ones.
        totals = jnp.cumsum(worth, axis=0)
        fewer, rung = jnp.unravel_index(jnp.argmax(totals), totals.shape)
        return jnp.where(rank <= fewer, rung, 0).astype(jnp.int32)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Nearest(Chooser[GameEvidence]):
    """Predict the nearest humans by the top rung, all others by the first one.

    Attributes:
        count: number of humans on the top rung.
    """

    count: Humans

    def choose(
        self,
        memory: Memory,
        gains: Gains,
        costs: Costs,
        evidence: GameEvidence,
    ) -> Rungs:
        """Choose by the distances after the last step."""
        rank = nearness(evidence.game, evidence.outcome.after)
        top = gains.shape[1] - 1
        return jnp.where(rank < self.count, top, 0)
