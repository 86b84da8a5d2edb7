"""Infer which model each driver on a road follows, from its acceleration, by `ms_highway.metareasoning.belief`.

What the rungs optimise takes too long to be predicted for everybody in every step; what tells them apart is the robot::

    naive   keeps its speed
    idm     follows the car ahead, and the robot where it is in its lane
    turn    follows the car ahead, whatever the robot does
    tom     follows the car ahead, and makes way for the robot where its plan leads into its lane

all by the Intelligent Driver Model. Cars that the robot does not concern tell nothing about the last three.
"""

from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.road import RoadScene, Traits, project
from ms_highway.metareasoning.belief import updated_belief
from ms_highway.planning.road.settings import RUNGS
from ms_highway.planning.road.traffic import FAR, headways, wanted_speeds
from ms_highway.planning.road.traits import followed, jointly, matched, observed_accelerations
from ms_highway.runtime.arrays import Array

__all__ = ["SHOWN", "Belief", "counted_on", "first_belief", "updated_road_belief"]

SHOWN = 0.3
"""Probability of theory of mind from which a driver has shown that it makes way; it is 1/4 at first."""

YIELDING = 2.0  # m/s^2, of braking to make way, at most


class Belief(NamedTuple):
    """Probability of each model for the car on each path.

    Attributes:
        names: of the cars, see `ms_highway.game.road.RoadScene`.
        probabilities: of `RUNGS`.
    """

    names: Int[Array, "traffic"]
    probabilities: Float[Array, "traffic models"]


def first_belief(scene: RoadScene) -> Belief:
    """Return the same probability of all models."""
    return Belief(jnp.asarray(scene.names), jnp.full((len(scene.names), len(RUNGS)), 1 / len(RUNGS), jnp.float32))


def updated_road_belief(
    belief: Belief, before: RoadScene, path: Float[Array, "steps 3"], now: RoadScene, time_step: float
) -> Belief:
    """Return the belief about the cars in sight now; about new ones nothing is known, those out of sight are dropped.

    Args:
        belief: about the cars in sight a step before.
        before: the road then.
        path: x, y and heading that the robot planned then.
        now: the road now.
        time_step: between the two [s].
    """
    place, found = matched(before.names, now.names)
    observed = observed_accelerations(before, now, place, time_step)
    predicted = _accelerations(before, jnp.asarray(path), time_step)[place]
    mixed = updated_belief(
        jnp.asarray(belief.probabilities)[place],
        jnp.stack([jnp.zeros_like(predicted), predicted], axis=-1),
        jnp.stack([jnp.zeros_like(observed), observed], axis=-1),
        time_step,
    )
    new = first_belief(now)
    return Belief(new.names, jnp.where(found[:, None], mixed, new.probabilities))


def counted_on(
    rungs: Int[np.ndarray, "traffic"], probabilities: Float[np.ndarray, "traffic models"]
) -> Int[np.ndarray, "traffic"]:
    """Return the rungs, but idm for drivers under theory of mind who have not shown that they make way."""
    top = RUNGS.index("tom")
    return np.where((rungs == top) & (probabilities[:, top] < SHOWN), RUNGS.index("idm"), rungs)


def _accelerations(
    scene: RoadScene, path: Float[jax.Array, "steps 3"], time_step: float
) -> Float[jax.Array, "traffic models"]:
    """Return the acceleration of each car under each model."""
    speed = wanted_speeds(scene)
    traits = Traits(speed, jnp.broadcast_to(headways(scene), speed.shape))
    _, aside, _ = project(scene.route, path[:, 0], path[:, 1], path[:, 2])
    idm, turn, tom = followed(scene, traits), followed(scene, traits, jnp.full(1, FAR)), followed(scene, traits, aside)
    tom = jnp.minimum(idm, jnp.maximum(tom, turn - YIELDING))
    return jnp.stack([jnp.zeros_like(idm), *(jointly(scene, each, time_step) for each in (idm, turn, tom))], axis=-1)
