"""Programs that demonstrate driving: they know where the other cars will be, and act for a known reward.

Drivers plan a window of as many steps as the game's planner looks ahead, execute all of it, and plan the next. A
window earns R_H, the sum of the reward over its steps less the discomfort of its controls, see `driven_reward`.
"""

from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float

from ms_highway.derivatives import damped_inverse, eigenpairs
from ms_highway.dynamics import Motion, observe
from ms_highway.game import Game, constant_velocity, driven_reward
from ms_highway.planner import project
from ms_highway.scenario import COMMON_WEIGHTS

__all__ = ["DRIVER_WEIGHTS", "TEMPERATURE", "Optimum", "maxent", "optimal", "window"]

DRIVER_WEIGHTS = {
    **{name: weight for name, weight in COMMON_WEIGHTS.items() if name != "collision"},
    "comfort_steering": 0.1,
    "comfort_acceleration": 0.1,
}
"""Weights of the demonstrated reward: the paper's, less the indicator of a collision, which is not differentiable, and
some comfort, without which some controls would not matter at all."""

TEMPERATURE = 1e-3  # reward; makes controls vary by up to 0.005 1/m and 3 m/s^2

STEPS = 100  # of the search for an optimum, at most
FLOOR = 0.05  # of the eigenvalues of Hessians, half the least that comfort gives them
TOLERANCE = 1e-3  # reward per scaled control, the slope at which an optimum counts as found
SHARES = 0.5 ** np.arange(12, dtype=np.float32)  # of a Newton step that its line search tries
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
    vanishes. Where float32 no longer tells which of two controls earns more, the one with less slope is better.

    Args:
        game: whose reward and motion; car 0 is driven.
        car: its state.
        others: motion of the others after each step, arrays [others, steps].
    """

    def earned(controls: Float[jax.Array, "steps 2"]) -> Float[jax.Array, ""]:
        return driven_reward(game, car, controls, others)

    slope = jax.grad(earned)

    def expanded(controls: Float[jax.Array, "steps 2"]) -> Optimum:
        hessian = jax.hessian(earned)(controls).reshape(controls.size, controls.size)
        return Optimum(controls, slope(controls), hessian)

    def climbing(search: tuple[int, Bool[jax.Array, ""], Optimum]) -> Bool[jax.Array, ""]:
        count, moved, now = search
        return moved & (count < STEPS) & (jnp.abs(now.gradient).max() > TOLERANCE)

    def improve(search: tuple[int, Bool[jax.Array, ""], Optimum]) -> tuple[int, Bool[jax.Array, ""], Optimum]:
        count, _, now = search
        step = (damped_inverse(now.hessian, FLOOR) @ now.gradient.ravel()).reshape(now.controls.shape)
        candidates = project(game.planner, now.controls + SHARES[:, None, None] * step)
        gains = jax.vmap(earned)(candidates) - earned(now.controls)
        best = jnp.argmax(gains)
        noise = 1e-6 * (1 + jnp.abs(earned(now.controls)))
        flatter = jnp.abs(slope(candidates[0])).max() < jnp.abs(now.gradient).max()
        settle = (gains[best] <= noise) & (gains[0] >= -noise) & flatter
        chosen = jnp.where(settle, candidates[0], candidates[best])
        moved = settle | (gains[best] > 0)
        return count + 1, moved, expanded(jnp.where(moved, chosen, now.controls))

    start = expanded(project(game.planner, constant_velocity(game, car)))
    return jax.lax.while_loop(climbing, improve, (0, jnp.array(True), start))[-1]


@jax.jit
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
    best = optimal(game, car, others)
    values, vectors = eigenpairs(best.hessian)
    spread = vectors * jnp.sqrt(temperature / jnp.maximum(jnp.abs(values), FLOOR))
    proposing, accepting = jax.random.split(key)
    normal = jax.random.normal(proposing, (DRAWS, len(values))).at[0].set(0.0)
    proposals = best.controls + (normal @ spread.T).reshape(DRAWS, *best.controls.shape)
    earned = jax.vmap(lambda controls: driven_reward(game, car, controls, others))(proposals)
    inside = (proposals == project(game.planner, proposals)).all(axis=(1, 2))
    excess = earned / temperature + jnp.sum(normal**2, axis=1) / 2  # log density over the proposal's
    excess = jnp.where(inside & jnp.isfinite(excess), excess, -jnp.inf).at[0].set(excess[0])

    def choose(now: jax.Array, draw: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        proposal, threshold = draw
        return jnp.where(threshold < excess[proposal] - excess[now], proposal, now), None

    thresholds = jnp.log(jax.random.uniform(accepting, (DRAWS,)))
    last, _ = jax.lax.scan(choose, jnp.array(0), (jnp.arange(DRAWS), thresholds))
    return proposals[last]
