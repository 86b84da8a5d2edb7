"""Projected gradient ascent over control sequences."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import jax
from jax import numpy as jnp
from jaxtyping import Float, PyTree

from ms_highway.dynamics import Array

__all__ = ["Planner", "ascend"]

Controls = TypeVar("Controls", bound=PyTree)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Planner:
    """How a control sequence is improved.

    Attributes:
        control_scale: the unit of each control; a step is taken in ``u / control_scale``, so that a larger scale
            means a bolder step in that control. ``(1, 1)`` in the units of the reward is the plain gradient.
        control_limit: bound on the magnitude of each control, infinite for none.
        step_size: length of a step per unit of gradient.
        horizon: number of controls that are planned, K in the paper (static).
        iterations: number of gradient steps (static).
    """

    control_scale: Float[Array, "2"]
    control_limit: Float[Array, "2"]
    step_size: float | Float[Array, ""] = 0.03
    horizon: int = field(default=5, metadata={"static": True})
    iterations: int = field(default=20, metadata={"static": True})


def ascend(planner: Planner, direction: Callable[[Controls], Controls], start: Controls) -> Controls:
    """Controls after ``iterations`` projected steps, ``z <- clip(z + step_size * direction(z))``.

    Args:
        planner: step size, number of steps and limits.
        direction: the direction of ascent at given controls; the gradient of the objective for plain ascent.
        start: the first controls, an array [..., 2] or a pytree of them, in units of ``control_scale``.

    Returns:
        The improved controls, like ``start``, in units of ``control_scale`` and within the limits.
    """
    limit = jnp.asarray(planner.control_limit) / jnp.asarray(planner.control_scale)

    def improve(_: int, controls: Controls) -> Controls:
        return jax.tree.map(
            lambda u, slope: jnp.clip(u + planner.step_size * slope, -limit, limit), controls, direction(controls)
        )

    return jax.lax.fori_loop(0, planner.iterations, improve, start)
