"""Programs that demonstrate driving: they know where the other cars will be, and act for a known reward.

Drivers plan a window of as many steps as the game's planner looks ahead, execute all of it, and plan the next. A
window earns R_H, the sum of the reward over its steps less the discomfort of its controls, see `driven_reward`.
"""

from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float

from ms_highway.game.dynamics import Motion, observe
from ms_highway.game.game import Game, bounded, constant_velocity, discomfort, driven_reward, move
from ms_highway.game.reward import motion_reward
from ms_highway.game.scenario import COMMON_WEIGHTS
from ms_highway.optimization.second_derivatives import Path, damped_inverse, eigenpairs, expand

__all__ = ["DRIVER_WEIGHTS", "Optimum", "maxent", "optimal", "window"]

DRIVER_WEIGHTS = {
    **{name: weight for name, weight in COMMON_WEIGHTS.items() if name != "collision"},
    "comfort_steering": 0.1,
    "comfort_acceleration": 0.1,
}
"""Weights of the demonstrated reward: the paper's, less the indicator of a collision, which is not differentiable, and
some comfort, without which some controls would not matter at all."""

STEPS = 50  # of the search for an optimum, at most
FLOOR = 0.05  # of the eigenvalues of Hessians, half the least that comfort gives them
TOLERANCE = 1e-3  # reward per scaled control, the slope at which an optimum counts as found
SHARES = np.append(0.5 ** np.arange(12), 0.0).astype(np.float32)  # of a Newton step that its line search tries
NOISE = 1e-6  # of a reward, relative, in float32
DRAWS = 20  # length of the chain that a sample ends


class Optimum(NamedTuple):
    """A local optimum of a window.

    Attributes:
        controls: scaled.
        gradient: of the reward there.
        hessian: of the reward there, in the ravelled controls.
    """

    controls: Float[jax.Array, "steps 2"]
    gradient: Float[jax.Array, "steps 2"]
    hessian: Float[jax.Array, "controls controls"]


Search: TypeAlias = tuple[int, Float[jax.Array, "steps 2"], Optimum]
"""Steps taken, where the next looks, and what the last found."""


def window(
    car: Float[np.ndarray, "4"], routes: Float[np.ndarray, "others steps 4"]
) -> tuple[Float[jax.Array, "4"], Motion]:
    """A driver's state and the motion of the others after each step, in coordinates that begin at the driver.

    Float32 resolves these better than places far down the road.
    """
    ahead = np.array([car[0], 0.0, 0.0, 0.0])
    return jnp.asarray(car - ahead, dtype=jnp.float32), observe((routes - ahead).astype(np.float32))


@jax.jit
def optimal(game: Game, car: Float[jax.Array, "4"], others: Motion) -> Optimum:
    """The local optimum of a window that is uphill from keeping the velocity.

    Newton steps, whose Hessian's eigenvalues l become ``-max(|l|, 0.05)``, with a line search, until the slope
    vanishes. Where float32 no longer tells which controls earn more, whole steps go on to where it does.

    Args:
        game: whose reward and motion; car 0 is driven.
        car: its state.
        others: motion of the others after each step, arrays [others, steps].
    """

    def along(path: Path) -> Float[jax.Array, ""]:
        return jnp.sum(motion_reward(game.scene, game.robot, Motion(*path), others))

    def climbing(search: Search) -> Bool[jax.Array, ""]:
        count, controls, last = search
        moved = (count == 0) | (controls != last.controls).any()
        return moved & (count < STEPS) & (jnp.abs(last.gradient).max() > TOLERANCE)

    def improve(search: Search) -> Search:
        count, controls, _ = search
        # The chain rule spares most of what XLA would have to compile for the Hessian of everything at once.
        expansion = expand(partial(move, game, car), along, controls, partial(discomfort, game, car))
        gradient, hessian = expansion.gradient.reshape(controls.shape), expansion.hessian
        step = (damped_inverse(hessian, FLOOR) @ gradient.ravel()).reshape(controls.shape)
        candidates = bounded(game, car, controls + SHARES[:, None, None] * step)
        rewards = jax.vmap(lambda controls: driven_reward(game, car, controls, others))(candidates)
        gains, noise = rewards - rewards[-1], NOISE * (1 + jnp.abs(rewards[-1]))
        settling = (gains.max() <= noise) & (gains[0] >= -noise)
        chosen = candidates[jnp.where(settling, 0, jnp.argmax(gains))]
        return count + 1, chosen, Optimum(controls, gradient, hessian)

    start = bounded(game, car, constant_velocity(game, car))
    unknown = Optimum(start, jnp.full_like(start, jnp.inf), jnp.zeros((start.size, start.size)))
    return jax.lax.while_loop(climbing, improve, (0, start, unknown))[-1]


def maxent(
    game: Game, car: Float[jax.Array, "4"], others: Motion, key: jax.Array, temperature: float
) -> Float[jax.Array, "steps 2"]:
    """Scaled controls drawn from ``p(u) ~ exp(R_H(u) / temperature)`` around the optimum, within the limits of plans.

    The end of an independence Metropolis-Hastings chain, which starts at the optimum and proposes from the Laplace
    approximation ``N(u*, temperature (-H)^-1)``, the eigenvalues l of H set to ``-max(|l|, 0.05)``.

    Args:
        game: whose reward and motion; car 0 is driven.
        car: its state.
        others: motion of the others after each step, arrays [others, steps].
        key: of the random numbers.
        temperature: how far from optimal, in reward.
    """
    return _sample(game, car, others, optimal(game, car, others), key, temperature)


@jax.jit
def _sample(
    game: Game, car: Float[jax.Array, "4"], others: Motion, best: Optimum, key: jax.Array, temperature: float
) -> Float[jax.Array, "steps 2"]:
    values, vectors = eigenpairs(best.hessian)
    spread = vectors * jnp.sqrt(temperature / jnp.maximum(jnp.abs(values), FLOOR))
    proposing, accepting = jax.random.split(key)
    normal = jax.random.normal(proposing, (DRAWS, len(values))).at[0].set(0.0)
    proposals = best.controls + (normal @ spread.T).reshape(DRAWS, *best.controls.shape)
    earned = jax.vmap(lambda controls: driven_reward(game, car, controls, others))(proposals)
    inside = (proposals == bounded(game, car, proposals)).all(axis=(1, 2))
    excess = earned / temperature + jnp.sum(normal**2, axis=1) / 2  # log density over the proposal's
    excess = jnp.where(inside & jnp.isfinite(excess), excess, -jnp.inf).at[0].set(excess[0])

    def choose(now: jax.Array, draw: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        proposal, threshold = draw
        return jnp.where(threshold < excess[proposal] - excess[now], proposal, now), None

    thresholds = jnp.log(jax.random.uniform(accepting, (DRAWS,)))
    last, _ = jax.lax.scan(choose, jnp.array(0), (jnp.arange(DRAWS), thresholds))
    return proposals[last]
