"""Describe the situation of every human of a crowd by numbers, from which the value of a model is estimated."""

import jax
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.crowd import Crowd, others_of, pair
from ms_highway.game.neighbours import headways, neighbours
from ms_highway.metareasoning.situation import describe, description_names
from ms_highway.runtime.arrays import Array

__all__ = ["describe_humans", "human_description_names"]

PLACES = ("ahead", "behind", "ahead left", "behind left", "ahead right", "behind right")


def human_description_names() -> tuple[str, ...]:
    """Return the names of the numbers of `describe_humans`, in their order."""
    gaps = [f"{driver}: time gap {place}" for driver in ("robot", "human") for place in PLACES]
    return (*description_names(), *gaps, "share of humans nearer to the robot")


def describe_humans(crowd: Crowd, state: Float[Array, "cars 4"]) -> Float[jax.Array, "humans numbers"]:
    """Compute what a choice of models looks at for every human, `human_description_names`.

    Of each: the situation of the robot with this human, `ms_highway.metareasoning.situation.describe`; the time gaps of
    both to the cars around them, as ``log(1 + gap / s)``; and how many humans are nearer to the robot.
    """
    state, (length, _) = jnp.asarray(state), crowd.game.scene.car_size
    distances = jnp.linalg.norm(state[1 : 1 + crowd.humans, :2] - state[0, :2], axis=-1)

    def gaps(car: int | Int[jax.Array, ""]) -> Float[jax.Array, "6"]:
        others = state[jnp.asarray(others_of(len(state)))[car]]
        present, width = jnp.ones(len(others), bool), jnp.asarray(crowd.game.scene.lane_width)
        return jnp.log1p(headways(state[car], neighbours(state[car], others, present, width), length))

    def one(human: Int[jax.Array, ""]) -> Float[jax.Array, "numbers"]:
        nearer = jnp.mean(distances < distances[human])[None]
        return jnp.concatenate([describe(*pair(crowd, state, human)), gaps(0), gaps(1 + human), nearer])

    return jax.vmap(one)(jnp.arange(crowd.humans))
