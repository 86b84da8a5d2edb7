"""Follow plans in pure JAX, as controllers do: fall back where one is not finite, start from the rest of the last."""

from typing import Generic, NamedTuple, TypeVar

import jax
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.control.fallback import BRAKING, braking_control, fallback_status
from ms_highway.game.game import Game
from ms_highway.planning.crowd import CrowdPlan
from ms_highway.planning.human_models import JointPlan

__all__ = ["Rest", "follow", "warm_plan"]

Plan = TypeVar("Plan", JointPlan, CrowdPlan)


class Rest(NamedTuple, Generic[Plan]):
    """What is left of a driver's last finite plan: its scaled controls, and their number; 0 after braking."""

    plan: Plan
    steps: Int[jax.Array, ""]


def follow(
    game: Game, car: Float[jax.Array, "4"], plan: Plan, rest: Rest[Plan]
) -> tuple[Float[jax.Array, "2"], Int[jax.Array, ""], Rest[Plan]]:
    """Return the scaled control to execute, its status and the remaining plan, see `ms_highway.control.fallback`."""
    finite = jnp.stack([jnp.isfinite(controls).all() for controls in plan]).all()
    status, left = fallback_status(finite, rest.steps, game.planner.horizon)
    followed = jax.tree.map(lambda new, old: jnp.where(finite, new, jnp.roll(old, -1, axis=-2)), plan, rest.plan)
    braking = braking_control(game, car) / game.planner.control_scale
    return jnp.where(status == BRAKING, braking, followed.robot[0]), status, Rest(followed, left)


def warm_plan(rest: Rest[Plan]) -> Plan:
    """Return what is left after the last step, its last control repeated; zero controls where nothing is left."""

    def after(controls: Float[jax.Array, "*cars horizon 2"]) -> Float[jax.Array, "*cars horizon 2"]:
        coming = jnp.minimum(jnp.arange(1, controls.shape[-2] + 1), jnp.maximum(rest.steps - 1, 0))
        return jnp.where(rest.steps > 0, controls[..., coming, :], 0.0)

    return jax.tree.map(after, rest.plan)
