"""Infer which model each driver on a road follows, from its acceleration, by `ms_highway.metareasoning.belief`.

What the models optimise takes too long to be predicted for everybody in every step; what tells them apart is the
robot::

    naive   keeps its speed
    idm     follows the car ahead, and the robot where it is in its lane
    turn    follows the car ahead, whatever the robot does
    tom     follows the car ahead, and makes way for the robot where its plan leads into its lane

all by the Intelligent Driver Model. Cars that the robot does not concern say nothing about the last three.
"""

from typing import Any

import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.arrays import Belief, Rungs
from ms_highway.game.road import RoadScene, locate
from ms_highway.metareasoning.belief import first_belief, updated_belief
from ms_highway.planning.car_following import FAR
from ms_highway.planning.road.settings import IDM, TOM
from ms_highway.planning.road.traffic import assumed_traits
from ms_highway.planning.road.traits import followed, jointly, observed_step
from ms_highway.runtime.arrays import Scalar

SHOWN = 0.3
"""Probability of theory of mind from which a driver has shown that it makes way; it is 1/4 at first."""

YIELDING = 2.0  # m/s^2, of braking to make way, at most


def updated_road_belief(
    belief: Belief, before: RoadScene, path: Float[Any, "steps 3"], now: RoadScene, time_step: Scalar
) -> Belief:
    """Return the belief about the cars in sight now; about new ones nothing is known, those out of sight are dropped.

    Args:
        belief: about the cars in sight a step before, a row for each path.
        before: the road then.
        path: x, y and heading that the robot planned then.
        now: the road now.
        time_step: between the two [s].
    """
    place, found, observed = observed_step(before, now, time_step)
    predicted = _accelerations(before, path, time_step)[place]
    along = jnp.array([0.0, 1.0])  # accelerations among controls
    mixed = updated_belief(
        jnp.asarray(belief)[place], predicted[..., None] * along, observed[..., None] * along, time_step
    )
    return jnp.where(found[:, None], mixed, first_belief(len(found)))


def counted_rungs(rungs: Rungs, belief: Belief) -> Rungs:
    """Return the rungs, but idm for drivers under theory of mind who have not shown that they make way."""
    return np.where((rungs == TOM) & (belief[:, TOM] < SHOWN), IDM, rungs)


def _accelerations(scene: RoadScene, path: Float[Any, "steps 3"], time_step: Scalar) -> Float[Any, "traffic models"]:
    """Return the acceleration of each car under each model."""
    traits = assumed_traits(scene)
    _, aside, _ = locate(scene.route, *jnp.asarray(path).T)
    idm, turn, tom = (followed(scene, traits, seen) for seen in (None, jnp.full(1, FAR), aside))
    tom = jnp.minimum(idm, jnp.maximum(tom, turn - YIELDING))
    return jnp.stack([jnp.zeros_like(idm), *(jointly(scene, each, time_step) for each in (idm, turn, tom))], axis=-1)
