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
from jaxtyping import Float, Int

from ms_highway.game.road import RoadScene, project
from ms_highway.metareasoning.belief import updated_belief
from ms_highway.planning.road.settings import IDM, ROAD_MODELS, TOM
from ms_highway.planning.road.traffic import FAR, expected_traits
from ms_highway.planning.road.traits import followed, jointly, observe

SHOWN = 0.3
"""Probability of theory of mind from which a driver has shown that it makes way; it is 1/4 at first."""

YIELDING = 2.0  # m/s^2, of braking to make way, at most

Belief = Float[Any, "traffic models"]
"""Probability of each model for the car on each path."""


def first_belief(scene: RoadScene) -> Belief:
    """Return the same probability of all models."""
    models = len(ROAD_MODELS)
    return jnp.full((len(scene.names), models), 1 / models, jnp.float32)


def updated_road_belief(
    belief: Belief, before: RoadScene, path: Float[Any, "steps 3"], now: RoadScene, time_step: float
) -> Belief:
    """Return the belief about the cars in sight now; about new ones nothing is known, those out of sight are dropped.

    Args:
        belief: about the cars in sight a step before.
        before: the road then.
        path: x, y and heading that the robot planned then.
        now: the road now.
        time_step: between the two [s].
    """
    place, found, observed = observe(before, now, time_step)
    predicted = _accelerations(before, path, time_step)[place]
    expected, executed = (jnp.stack([jnp.zeros_like(each), each], axis=-1) for each in (predicted, observed))
    mixed = updated_belief(jnp.asarray(belief)[place], expected, executed, time_step)
    return jnp.where(found[:, None], mixed, first_belief(now))


def counted_on(rungs: Int[Any, "traffic"], belief: Belief) -> Int[Any, "traffic"]:
    """Return the rungs, but idm for drivers under theory of mind who have not shown that they make way."""
    return np.where((rungs == TOM) & (belief[:, TOM] < SHOWN), IDM, rungs)


def _accelerations(scene: RoadScene, path: Float[Any, "steps 3"], time_step: float) -> Belief:
    """Return the acceleration of each car under each model."""
    traits = expected_traits(scene)
    _, aside, _ = project(scene.route, *jnp.asarray(path).T)
    idm, turn, tom = (followed(scene, traits, seen) for seen in (None, jnp.full(1, FAR), aside))
    tom = jnp.minimum(idm, jnp.maximum(tom, turn - YIELDING))
    return jnp.stack([jnp.zeros_like(idm), *(jointly(scene, each, time_step) for each in (idm, turn, tom))], axis=-1)
