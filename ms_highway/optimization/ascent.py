"""How the controls of a plan are improved: plain gradient ascent, or Newton steps with a line search."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, TypeAlias, TypeVar

import jax
from jax import numpy as jnp
from jaxtyping import Float, PyTree

from ms_highway.optimization.newton import newton_steps
from ms_highway.optimization.second_derivatives import Path
from ms_highway.runtime.arrays import Array

__all__ = ["Planner", "Solver", "ascend", "climb", "project"]

Controls = TypeVar("Controls", bound=PyTree)
Solver: TypeAlias = Literal["gradient", "newton"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Planner:
    """How a control sequence is improved.

    Attributes:
        control_scale: the unit of each control; a step is taken in ``u / control_scale``, so that a larger scale
            means a bolder step in that control. ``(1, 1)`` in the units of the reward is the plain gradient.
        control_limit: bound on the magnitude of each control, infinite for none.
        grip: the total acceleration that tyres hold [m/s^2], within which plans stay without reversing, see
            `ms_highway.game.dynamics.within_grip`; None where neither is looked at.
        step_size: length of a gradient step per unit of gradient.
        horizon: number of controls that are planned, K in the paper (static).
        iterations: number of gradient steps (static).
        solver: ``gradient``, the paper's, or ``newton``, see `climb` (static).
    """

    control_scale: Float[Array, "2"]
    control_limit: Float[Array, "2"]
    grip: float | Float[Array, ""] | None = None
    step_size: float | Float[Array, ""] = 0.03
    horizon: int = field(default=5, metadata={"static": True})
    iterations: int = field(default=20, metadata={"static": True})
    solver: Solver = field(default="gradient", metadata={"static": True})


def project(planner: Planner, controls: Float[jax.Array, "*batch 2"]) -> Float[jax.Array, "*batch 2"]:
    """The nearest scaled controls within the limits of each control; for all limits see `game.game.bounded`."""
    limit = jnp.asarray(planner.control_limit) / jnp.asarray(planner.control_scale)
    return jnp.clip(controls, -limit, limit)


def ascend(
    planner: Planner,
    direction: Callable[[Controls], Controls],
    start: Controls,
    bounded: Callable[[Controls], Controls],
) -> Controls:
    """Controls after ``iterations`` projected steps, ``z <- bounded(z + step_size * direction(z))``.

    Args:
        planner: step size and number of steps.
        direction: the direction of ascent at given controls; the gradient of the objective for plain ascent.
        start: the first controls, an array [..., 2] or a pytree of them, in units of ``control_scale``.
        bounded: the nearest controls within the limits.

    Returns:
        The improved controls, like ``start``, in units of ``control_scale`` and within the limits.
    """

    def improve(_: int, controls: Controls) -> Controls:
        slopes = direction(controls)
        return bounded(jax.tree.map(lambda u, slope: u + planner.step_size * slope, controls, slopes))

    return jax.lax.fori_loop(0, planner.iterations, improve, start)


def climb(
    planner: Planner,
    path: Callable[[Float[jax.Array, "steps 2"]], Path],
    reward: Callable[[Path], Float[jax.Array, ""]],
    cost: Callable[[Float[jax.Array, "steps 2"]], Float[jax.Array, ""]],
    start: Float[jax.Array, "steps 2"],
    bounded: Callable[[Float[jax.Array, "*batch steps 2"]], Float[jax.Array, "*batch steps 2"]],
) -> Float[jax.Array, "steps 2"]:
    """Controls whose path earns more, found by the planner's solver.

    * ``gradient``: `ascend` along the reward's gradient g, the paper's solver.
    * ``newton``: 16 steps along ``sum_i v_i v_i^T g / max(|l_i|, 12)``, with the eigenpairs (l_i, v_i) of the Hessian,
      which is worked out anew every 8 steps. Such a step climbs also where the reward is not concave (the saddle-free
      Newton step of Dauphin et al. 2014). Of the step and its halves, projected on the limits, the one that earns most
      is taken, or none. Unlike the gradient, this search sees the reward's jumps, such as the cost of a collision.

    Args:
        planner: solver and step size.
        path: the path under scaled controls.
        reward: what a path earns; no step may look at another.
        cost: what is paid for the controls themselves, a sum over them.
        start: the first controls, scaled.
        bounded: the nearest controls within the limits.
    """

    def earned(controls: Float[jax.Array, "steps 2"]) -> Float[jax.Array, ""]:
        return reward(path(controls)) - cost(controls)

    if planner.solver == "gradient":
        return ascend(planner, jax.grad(earned), start, bounded)
    return newton_steps(path, reward, cost, start, bounded)
