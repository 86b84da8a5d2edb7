"""The simulated demonstrator: it knows the other cars' future motion and draws its controls by a known reward.

It plans a segment as long as the planner's horizon, executes all of it, and plans the next one. The return R_H of a
segment is the sum of the reward over its steps, less the discomfort of its controls.
"""

from functools import partial

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.dynamics import Motion, observe
from ms_highway.game.features import motion_reward
from ms_highway.game.game import Game, bounded, constant_velocity, discomfort, move
from ms_highway.game.scenario import COMMON_WEIGHTS
from ms_highway.irl.recording import Controls, States
from ms_highway.numerics.newton import Objective, Optimum, find_optimum
from ms_highway.runtime.arrays import Scalar, Trajectory

DRIVER_WEIGHTS = {
    **{name: weight for name, weight in COMMON_WEIGHTS.items() if name != "collision"},
    "comfort_steering": 0.1,
    "comfort_acceleration": 0.1,
}
"""Weights of the demonstrated reward: the paper's, without the indicator of a collision, which is not differentiable,
and with comfort, without which some controls would have no effect on the reward."""

FLOOR = 0.05  # least size of the eigenvalues of Hessians: half of the curvature of comfort
DRAWS = 20  # proposals from which one control is resampled
UNLIKELY = -1e30  # log density of the optimum itself: it is drawn only if no proposal is possible


def seen_from(car: States, routes: States) -> tuple[States, Motion]:
    """Return a driver's state and the motion of the others after each step, with x measured from the driver.

    Float32 resolves these better than positions far along the road.

    Args:
        car: state of the driver.
        routes: states of the others after each step [others, steps, 4].
    """
    ahead = np.array([car[0], 0.0, 0.0, 0.0])
    return jnp.asarray(car - ahead, dtype=jnp.float32), observe((routes - ahead).astype(np.float32))


def segment_return(game: Game, car: States, others: Motion) -> Objective:
    """Return R_H of a segment as an objective of the driver's controls.

    Args:
        game: gives the reward and the dynamics of the driver, its car 0.
        car: state of the driver.
        others: motion of the others after each step, arrays [others, steps].
    """

    def reward(path: Trajectory) -> Scalar:
        return jnp.sum(motion_reward(game.scene, game.robot, Motion(*path), others))

    path, cost, within = (partial(function, game, car) for function in (move, discomfort, bounded))
    return Objective(path, reward, cost, within, jax.grad(reward))


@jax.jit
def optimal(game: Game, car: States, others: Motion) -> Optimum:
    """Find the local optimum of R_H that is uphill from keeping the velocity; takes what `segment_return` takes."""
    return find_optimum(segment_return(game, car, others), constant_velocity(game, car), FLOOR)


@jax.jit
def maxent(game: Game, car: States, others: Motion, key: jax.Array, temperature: Scalar) -> Controls:
    """Draw scaled controls from ``p(u) ~ exp(R_H(u) / temperature)`` around the optimum u*, within the limits.

    Draws 20 proposals from the Laplace approximation ``N(u*, temperature (-H)^-1)``, in which each eigenvalue l of H is
    replaced by ``-max(|l|, 0.05)``, and resamples one of them by importance. Where no proposal is within the limits, it
    returns the optimum.

    Args:
        game: see `segment_return`.
        car: see `segment_return`.
        others: see `segment_return`.
        key: of the random numbers.
        temperature: in units of the reward.
    """
    best = optimal(game, car, others)
    values, vectors = jnp.linalg.eigh(best.hessian)
    spread = vectors * jnp.sqrt(temperature / jnp.maximum(jnp.abs(values), FLOOR))
    proposing, accepting = jax.random.split(key)
    normal = jax.random.normal(proposing, (DRAWS, len(values))).at[0].set(0.0)
    proposals = best.controls + (normal @ spread.T).reshape(DRAWS, *best.controls.shape)
    returns = jax.vmap(segment_return(game, car, others).earned)(proposals)
    inside = (proposals == bounded(game, car, proposals)).all(axis=(1, 2))
    excess = returns / temperature + jnp.sum(normal**2, axis=1) / 2  # log density over the proposal's
    excess = jnp.where(inside & jnp.isfinite(excess), excess, -jnp.inf).at[0].set(UNLIKELY)
    return proposals[jax.random.categorical(accepting, excess)]
