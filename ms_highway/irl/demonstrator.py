"""Simulate a demonstrator that draws its controls by a known reward.

It knows the other cars' future motion. It plans a segment as long as the planner's
horizon, executes all of it, and plans the next one. The return R_H of a segment is the
sum of the reward over its steps, less the discomfort of its controls.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.dynamics import Motion, observe
from ms_highway.game.features import motion_reward
from ms_highway.game.game import Game, bounded, constant_velocity, discomfort, move
from ms_highway.game.scenario import COMMON_WEIGHTS
from ms_highway.irl.recording import Controls, States
from ms_highway.numerics.objective import Objective
from ms_highway.numerics.second_derivatives import damped_inverse
from ms_highway.runtime.arrays import Flag, Index, Matrix, Scalar, Trajectory

DRIVER_WEIGHTS = {
    **{name: weight for name, weight in COMMON_WEIGHTS.items() if name != "collision"},
    "comfort_steering": 0.1,
    "comfort_acceleration": 0.1,
}
"""Weights of the demonstrated reward: the paper's, without the indicator of a
collision, which is not differentiable, and with comfort, without which some controls
would have no effect on the reward.
"""


@dataclass(frozen=True)
class OptimumSearch:
    """Set how the optimum of a segment is found."""

    max_steps: int = 50
    """Newton steps, at most."""
    tolerance: float = 1e-3
    """Gradient at which an optimum counts as found [reward per scaled control]."""
    noise: float = 1e-6
    """Rounding errors of a reward in float32, relative."""
    curvature_floor: float = 0.05
    """Least size of the eigenvalues of Hessians: half of the curvature of comfort."""

    @property
    def shares(self) -> Float[np.ndarray, "shares"]:
        """Shares of a Newton step that are tried; the last one stays."""
        return np.append(0.5 ** np.arange(12), 0.0).astype(np.float32)


SEARCH = OptimumSearch()


class Optimum(NamedTuple):
    """A local optimum over n = 2 * steps controls.

    Attributes:
        controls: scaled.
        gradient: of the reward there.
        hessian: of the reward there, in the ravelled controls.
    """

    controls: Controls
    gradient: Controls
    hessian: Matrix


class Search(NamedTuple):
    """A search for an optimum.

    Attributes:
        steps: number of Newton steps taken.
        controls: where to expand the reward next.
        last: where it was expanded last.
    """

    steps: Index
    controls: Controls
    last: Optimum


def seen_from(car: States, routes: States) -> tuple[States, Motion]:
    """Return a driver's state and the motion of the others, with x from the driver.

    The motion is that after each step. Float32 resolves these numbers better than
    positions far along the road.

    Args:
        car: state of the driver.
        routes: states of the others after each step [others, steps, 4].
    """
    origin = np.array([car[0], 0.0, 0.0, 0.0])
    own = jnp.asarray(car - origin, dtype=jnp.float32)
    others = (routes - origin).astype(np.float32)
    return own, observe(others)


def segment_return(game: Game, car: States, others: Motion) -> Objective:
    """Return R_H of a segment as an objective of the driver's controls.

    Args:
        game: gives the reward and the dynamics of the driver, its car 0.
        car: state of the driver.
        others: motion of the others after each step, arrays [others, steps].
    """

    def reward(path: Trajectory) -> Scalar:
        own = Motion(*path)
        rewards = motion_reward(game.scene, game.robot, own, others)
        return jnp.sum(rewards)

    return Objective(
        path=partial(move, game, car),
        reward=reward,
        cost=partial(discomfort, game, car),
        bounded=partial(bounded, game, car),
        slope=jax.grad(reward),
    )


@jax.jit
def optimal(game: Game, car: States, others: Motion) -> Optimum:
    """Find the local optimum of R_H that is uphill from keeping the velocity.

    Takes Newton steps, each with its own Hessian, until no component of the gradient
    exceeds 1e-3, no step earns more, or 50 steps are taken. Where float32 cannot tell
    which controls earn more, it takes whole steps.

    Args:
        game: see `segment_return`.
        car: see `segment_return`.
        others: see `segment_return`.
    """
    objective = segment_return(game, car, others)

    def goes_on(search: Search) -> Flag:
        is_new = search.controls != search.last.controls
        moved = (search.steps == 0) | is_new.any()
        steep = jnp.abs(search.last.gradient).max() > SEARCH.tolerance
        may_go_on = search.steps < SEARCH.max_steps
        return moved & may_go_on & steep

    def improve(search: Search) -> Search:
        controls = search.controls

        # A Newton step uphill.
        expansion = objective.expand(controls)
        gradient = expansion.gradient.reshape(controls.shape)
        inverse = damped_inverse(expansion.hessian, SEARCH.curvature_floor)
        step = (inverse @ gradient.ravel()).reshape(controls.shape)

        # The share of it that earns most, or all of it where differences are rounding.
        candidates, rewards = objective.search_line(controls, step, SEARCH.shares)
        gains = rewards - rewards[-1]
        noise = SEARCH.noise * (1 + jnp.abs(rewards[-1]))
        settling = (gains.max() <= noise) & (gains[0] >= -noise)
        best = jnp.where(settling, 0, jnp.argmax(gains))
        chosen = candidates[best]
        here = Optimum(controls, gradient, expansion.hessian)
        return Search(search.steps + 1, chosen, here)

    start = objective.bounded(constant_velocity(game, car))
    unknown = Optimum(
        controls=start,
        gradient=jnp.full_like(start, jnp.inf),
        hessian=jnp.zeros((start.size, start.size)),
    )
    first = Search(0, start, unknown)
    return jax.lax.while_loop(goes_on, improve, first).last


@jax.jit
def maxent(
    game: Game,
    car: States,
    others: Motion,
    key: jax.Array,
    temperature: Scalar,
) -> Controls:
    """Draw scaled controls u within limits from ``p(u) ~ exp(R_H(u) / temperature)``.

    They are around the optimum u*. Draws 20 proposals from the Laplace approximation
    ``N(u*, temperature (-H)^-1)``, in which each eigenvalue l of H is replaced by
    ``-max(|l|, 0.05)``, and resamples one of them by importance. Where no proposal is
    within the limits, it returns the optimum.

    Args:
        game: see `segment_return`.
        car: see `segment_return`.
        others: see `segment_return`.
        key: of the random numbers.
        temperature: in units of the reward.
    """
    draws = 20
    unlikely = -1e30  # log density of the optimum: drawn only if nothing is possible

    # Proposals from the Laplace approximation; the first is the optimum itself.
    best = optimal(game, car, others)
    values, vectors = jnp.linalg.eigh(best.hessian)
    curvatures = jnp.maximum(jnp.abs(values), SEARCH.curvature_floor)
    spread = vectors * jnp.sqrt(temperature / curvatures)
    proposing, accepting = jax.random.split(key)
    normal = jax.random.normal(proposing, (draws, len(values)))
    normal = normal.at[0].set(0.0)
    deviations = (normal @ spread.T).reshape(draws, *best.controls.shape)
    proposals = best.controls + deviations

    # Log density of each proposal, relative to that from which it was drawn.
    objective = segment_return(game, car, others)
    returns = jax.vmap(objective.earned)(proposals)
    log_ratio = returns / temperature + jnp.sum(normal**2, axis=1) / 2

    # Only those within the limits may be chosen, or else the optimum.
    is_unchanged = proposals == bounded(game, car, proposals)
    is_within = is_unchanged.all(axis=(1, 2))
    is_possible = is_within & jnp.isfinite(log_ratio)
    log_ratio = jnp.where(is_possible, log_ratio, -jnp.inf)
    log_ratio = log_ratio.at[0].set(unlikely)
    chosen = jax.random.categorical(accepting, log_ratio)
    return proposals[chosen]
