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
from ms_highway.choice.situation import distance_rank
from ms_highway.planning.costs import Costs
from ms_highway.runtime.arrays import Gains, Rungs

Humans = Annotated[
    int, Meta(ge=0, description="it must be a number of humans, 0 or more")
]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Price(Priced[object]):
    """Take the highest rung that is worth more than the rung in use, or stay.

    The worth of a rung is its gain less the price of its time, for each human alone.
    The paper's Algorithm 1 (`ms_highway.choice.quadratic`) estimates only the top rung
    and the one below the rung in use: it goes to the top, or else one rung down.
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
        rungs = jnp.arange(len(each))

        # Gain of the rung in use. Without a new estimate, the remembered one counts.
        own = jnp.take_along_axis(gains, in_use, axis=1)
        remembered = jnp.asarray(memory.gain)[:, None]
        own = jnp.where(jnp.isfinite(own), own, remembered)

        # What each rung is worth more than that one, [humans, rungs].
        known = gains > NOT_ESTIMATED
        gained = jnp.where(known, gains, own) - own
        more_time = each - each[in_use]
        worth = gained - self.price * more_time

        # The highest of the rungs that are worth more; -1 stands for none.
        is_better = known & (worth > 0)
        highest = jnp.where(is_better, rungs, -1).max(axis=1)
        return jnp.where(highest >= 0, highest, in_use[:, 0])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PriceFromFirst(Priced[object]):
    """Take the highest rung whose gain over the first one is worth its whole time.

    Time is not counted from that of the first rung on: among several humans, the first
    rung costs nothing. The rung in use does not matter: where humans come and go, as on
    stock roads, it may be another human's.
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
        rungs = jnp.arange(gains.shape[1])
        is_worth = gains >= prices  # [humans, rungs]
        return jnp.where(is_worth, rungs, 0).max(axis=1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PriceTogether(Priced[GameEvidence]):
    """Give one higher rung to the k nearest humans, and the first rung to all others.

    The worth of a rung is its gain less the price of its time. For each rung, the
    worths are added up from the nearest human outwards; k and the rung have the highest
    sum. As learned gains assume the same rung for all nearer humans, the sum is what
    the rung is worth for all k. A human without estimates adds nothing to it, but gets
    the rung if farther humans raise the sum. If a cost is unknown, all humans get the
    first rung.

    Attributes:
        most_humans: largest k. The networks that come with the package were learned for
            this number of the nearest humans.
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
        rank = distance_rank(evidence.game, evidence.outcome.after)
        nearest = jnp.argsort(rank)[: self.most_humans]
        gained = gains[nearest]  # [nearest, rungs]

        # A human is known if all its gains are; nobody is if a cost is unknown.
        each = jnp.asarray(costs.each)
        is_known = jnp.isfinite(gained - each)
        known = is_known.all(axis=1, keepdims=True)

        # What each rung is worth more than the first one.
        prices = self.price * each
        net_gains = jnp.where(known, gained, 0.0) - prices
        worth = jnp.where(known, net_gains - net_gains[:, :1], 0.0)

        # The same for a human and all nearer ones together. The first rung is worth 0,
        # so it wins where nothing is worth its price.
        totals = jnp.cumsum(worth, axis=0)
        best = jnp.argmax(totals)
        farthest, rung = jnp.unravel_index(best, totals.shape)
        return jnp.where(rank <= farthest, rung, 0).astype(jnp.int32)


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
        rank = distance_rank(evidence.game, evidence.outcome.after)
        top = gains.shape[1] - 1
        return jnp.where(rank < self.count, top, 0)
