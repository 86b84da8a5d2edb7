"""Newton's method with a line search: a fixed number of steps for plans, or steps until an optimum is found."""

from typing import NamedTuple, TypeAlias

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.numerics.objective import Objective, best_of
from ms_highway.numerics.second_derivatives import damped_inverse
from ms_highway.runtime.arrays import Controls, Flag, Matrix

STEPS = 16  # of a plan
HESSIAN_EVERY = 8  # steps
FLOOR = 12.0  # of the Hessian's eigenvalues; 1 / 12 is the longest step per unit of gradient
SHARES = np.array([1, 1 / 2, 1 / 4, 1 / 8, 0], dtype=np.float32)  # of a Newton step that its line search tries

MAX_STEPS = 50  # of the search for an optimum
FINE_SHARES = np.append(0.5 ** np.arange(12), 0.0).astype(np.float32)  # of its steps
TOLERANCE = 1e-3  # reward per scaled control, the gradient at which an optimum counts as found
NOISE = 1e-6  # of a reward, relative, in float32


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


def newton_steps(objective: Objective, start: Controls) -> Controls:
    """Improve controls by 16 Newton steps, see `ms_highway.numerics.solvers.optimize_controls`."""

    def with_hessian(_: int, controls: Controls) -> Controls:
        metric = damped_inverse(objective.expand(controls).hessian, FLOOR)

        def improve(_: int, controls: Controls) -> Controls:
            step = (metric @ objective.gradient(controls).ravel()).reshape(controls.shape)
            return best_of(*objective.search_line(controls, step, SHARES))

        return jax.lax.fori_loop(0, HESSIAN_EVERY, improve, controls)

    return jax.lax.fori_loop(0, STEPS // HESSIAN_EVERY, with_hessian, objective.bounded(start))


Search: TypeAlias = tuple[int, Controls, Optimum]
"""Number of steps taken, the controls to expand at next, and the gradient and Hessian at the last controls."""


def find_optimum(objective: Objective, start: Controls, floor: float) -> Optimum:
    """Find the local optimum that is uphill from the start.

    Takes Newton steps, each with its own Hessian, until no component of the gradient exceeds 1e-3, no step earns more,
    or 50 steps are taken. Where float32 cannot tell which controls earn more, it takes whole steps.

    Args:
        objective: to maximise; the reward of each step of a path must not depend on other steps.
        start: the first controls, scaled.
        floor: the Hessian's eigenvalues l become ``-max(|l|, floor)``.
    """

    def climbing(search: Search) -> Flag:
        count, controls, last = search
        moved = (count == 0) | (controls != last.controls).any()
        return moved & (count < MAX_STEPS) & (jnp.abs(last.gradient).max() > TOLERANCE)

    def improve(search: Search) -> Search:
        count, controls, _ = search
        expansion = objective.expand(controls)
        gradient, metric = expansion.gradient.reshape(controls.shape), damped_inverse(expansion.hessian, floor)
        step = (metric @ gradient.ravel()).reshape(controls.shape)
        candidates, rewards = objective.search_line(controls, step, FINE_SHARES)
        gains, noise = rewards - rewards[-1], NOISE * (1 + jnp.abs(rewards[-1]))
        settling = (gains.max() <= noise) & (gains[0] >= -noise)
        chosen = candidates[jnp.where(settling, 0, jnp.argmax(gains))]
        return count + 1, chosen, Optimum(controls, gradient, expansion.hessian)

    start = objective.bounded(start)
    unknown = Optimum(start, jnp.full_like(start, jnp.inf), jnp.zeros((start.size, start.size)))
    return jax.lax.while_loop(climbing, improve, (0, start, unknown))[-1]
