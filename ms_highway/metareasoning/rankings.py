"""Predict the most important humans by the top of the ladder, and all others by the first rung."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from math import inf

import jax
import numpy as np
from jax import numpy as jnp
from jax.scipy.special import ndtr
from jaxtyping import Float

from ms_highway.game.dynamics import coast, observe
from ms_highway.game.game import Game, move, move_all, trajectory_reward
from ms_highway.game.neighbours import far_behind
from ms_highway.metareasoning.rule import Decision, Memory, Outcome, unestimated
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import HumanModel
from ms_highway.planning.plans import one_step_later
from ms_highway.runtime.arrays import Controls, HumansControl, Index, PerHuman, Scalar, State, Trajectories

LANES_AWAY = 1.5  # lanes to the side, beyond which a robot that changes lanes does not collide with a car
BARRIER_RATE = 1.0  # 1/s, at which a barrier may be approached
SPREAD = np.array([0.27, 0.09], np.float32)  # bodies per s^2, along and across the road
"""Standard deviation of human accelerations that constant velocity leaves out.

On either axis, 90 % of the humans' paths over 2 s stayed within 1.645 times it, in 18 episodes of the package's crowds
that were planned naively."""


@dataclass(frozen=True)
class MostImportant(ABC):
    """Predict the most important humans by the top of the ladder, and all others by the first rung.

    Attributes:
        count: number of humans on the top rung.
        costs: planning time, for records.
        ladder: human models (static).
    """

    count: Index
    costs: Costs
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})

    @property
    def limit(self) -> Scalar:
        """Unimportance above which a human stays on the first rung."""
        return inf

    @abstractmethod
    def unimportance(self, game: Game, outcome: Outcome) -> PerHuman:
        """Return what is lowest for the most important human."""

    def look(self, game: Game, memory: Memory, outcome: Outcome) -> HumansControl:
        """Return unimportances and distances."""
        return jnp.stack([self.unimportance(game, outcome), _distances(game, outcome)], axis=1)

    def choose(self, memory: Memory, seen: HumansControl) -> Decision:
        """See `ms_highway.metareasoning.rule.Rule.choose`; among equals, the nearest human comes first."""
        order = jnp.lexsort((seen[:, 1], seen[:, 0]))
        important = (jnp.argsort(order) < self.count) & (seen[:, 0] <= self.limit)
        return unestimated(memory, jnp.where(important, len(self.ladder) - 1, 0))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Nearest(MostImportant):
    """The nearest humans are the most important ones."""

    def unimportance(self, game: Game, outcome: Outcome) -> PerHuman:
        """Return the distance of every human."""
        return _distances(game, outcome)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TimeToCollision(MostImportant):
    """The humans with the shortest time to collision are the most important ones."""

    def unimportance(self, game: Game, outcome: Outcome) -> PerHuman:
        """Return the time until bodies meet in x, at constant velocities, as if the cars were in the same lane.

        A robot that merges is yet to come into that lane: lateral offsets are ignored up to one and a half lanes.
        The time is 0 for cars abreast, and infinite for those that go apart or are further to the side.
        """
        (ahead, aside), (along, _) = _relative(game, outcome.after)
        gap = jnp.maximum(jnp.abs(ahead) - jnp.asarray(game.scene.car_size)[0], 0.0)
        closing = -jnp.sign(ahead) * along
        time = jnp.where(closing > 0, gap / jnp.where(closing > 0, closing, 1.0), jnp.inf)
        beside = jnp.abs(aside) < LANES_AWAY * jnp.asarray(game.scene.lane_width)
        return jnp.where(beside, jnp.where(gap > 0, time, 0.0), jnp.inf)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Influence(MostImportant):
    """The humans that influence the robot's plan most are the most important ones (Refaat et al. 2019).

    The rest of the last plan would be improved along its gradient. A human's influence is the length of the change of
    this gradient when the human is left out, while all others do what the last plan expected of them.
    """

    def unimportance(self, game: Game, outcome: Outcome) -> PerHuman:
        """Return the negative influence of every human."""
        last, state = 1 + game.number, jnp.asarray(outcome.after)
        robot, humans = one_step_later(outcome.plan)
        others = move_all(game, state[1:last], humans)
        absent = jnp.stack(coast(game.dynamics, far_behind(state[0]), game.planner.horizon))

        def slope(others: Trajectories) -> Controls:
            return jax.grad(lambda own: trajectory_reward(game, state, move(game, state[0], own), others))(robot)

        without = jax.vmap(lambda human: slope(others.at[human].set(absent)))(jnp.arange(game.number))
        return -jnp.linalg.norm(without - slope(others), axis=(1, 2))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Barrier(MostImportant):
    """The humans that constrain the robot most by a control barrier function are the most important ones.

    Chahine, Firoozi, Xiao, Schwager, Rus, "Local Non-Cooperative Games with Principled Player Selection for Scalable
    Motion Planning" (arXiv 2310.12958), found such a priority best. With offset z in car lengths and widths, and the
    rate k, the lowest value of this condition comes first::

        (d/dt + k)^2 h = h'' + 2 k h' + k^2 h,  h = z . z - 1

    Accelerations are those of the last step. The ellipse in place of a circle, and k, are ours.
    """

    def unimportance(self, game: Game, outcome: Outcome) -> PerHuman:
        """Return the value of every human's barrier condition."""
        size, rate = jnp.asarray(game.scene.car_size)[:, None], BARRIER_RATE
        place, velocity = _relative(game, outcome.after) / size
        before = _relative(game, outcome.before)[1] / size
        bend = jnp.sum(velocity**2 + place * (velocity - before) / game.world.time_step, axis=0)
        return 2 * bend + 4 * rate * jnp.sum(place * velocity, axis=0) + rate**2 * (jnp.sum(place**2, axis=0) - 1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Risk(MostImportant):
    """The humans that may well collide with the robot's plan are the most important ones, so many of them at most.

    After the idea of H-PRAP (Yang, Lee, Han, "Heterogeneous Predictor-based Risk-Aware Planning with Conformal
    Prediction in Dense, Uncertain Environments", arXiv 2507.11920): an index of collision risk in closed form over a
    horizon, by a Gaussian that quantiles of prediction errors calibrate, says who is worth an expensive prediction
    within a budget. Equation, calibration (see `SPREAD`) and threshold are ours: with offset z of a human at constant
    velocity from the rest of the last plan, in car lengths and widths, and standard deviation ``s = SPREAD t^2 / 2``::

        risk = max over t of prod over both axes of Phi((z + 1) / s) - Phi((z - 1) / s)

    It is no exact probability: in 8 other episodes, 3 % of the humans at a risk of 0.01 to 0.2 met the plan,
    13 % of those at 0.2 to 0.5, and all 14 above.

    Attributes:
        threshold: risk from which a human is predicted by the top rung.
    """

    threshold: Scalar = 0.05

    @property
    def limit(self) -> Scalar:
        """See `MostImportant.limit`."""
        return -self.threshold

    def unimportance(self, game: Game, outcome: Outcome) -> PerHuman:
        """Return the negative risk of every human."""
        state = jnp.asarray(outcome.after)[: 1 + game.number]
        own = move(game, state[0], one_step_later(outcome.plan).robot)[:2, None]
        others = coast(game.dynamics, state[1:], own.shape[-1])
        away = (jnp.stack(others[:2]) - own) / jnp.asarray(game.scene.car_size)[:, None, None]
        time = game.dynamics.time_step * jnp.arange(1, own.shape[-1] + 1)
        spread = SPREAD[:, None, None] * time**2 / 2
        overlap = ndtr((away + 1) / spread) - ndtr((away - 1) / spread)
        return -jnp.max(jnp.prod(overlap, axis=0), axis=-1)


def _relative(game: Game, state: State) -> Float[jax.Array, "2 2 humans"]:
    """Return the humans' positions and velocities from the robot's, along and across the road."""
    cars = observe(jnp.asarray(state)[: 1 + game.number])
    moving = jnp.stack([cars.speed * cars.cosine, cars.speed * cars.sine])
    both = jnp.stack([jnp.stack(cars[:2]), moving])
    return both[..., 1:] - both[..., :1]


def _distances(game: Game, outcome: Outcome) -> PerHuman:
    places = jnp.asarray(outcome.after)[: 1 + game.number, :2]
    return jnp.linalg.norm(places[1:] - places[0], axis=1)
