"""Keep bodies apart on physical ground: overlaps, and what plans pay near bodies.

Cars are rectangles and obstacles are circles, whose diameter is the obstacle's width. A
car pays for every overlap with an obstacle, and with a car whose direction differs by
less than 7 degrees. At larger angles, another car's corner may reach a car's side
between two of its points; then the other car pays, if it plans as well.
"""

from dataclasses import dataclass

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float

from ms_highway.game.dynamics import Motion
from ms_highway.game.scene import Scene
from ms_highway.geometry.bodies import (
    CORNERS,
    Directions,
    circles_overlap,
    place_in_frame,
    point_offsets,
    separation_of_directed,
    square_distance,
)
from ms_highway.runtime.arrays import (
    Array,
    Numbers,
    Numeric,
    Times,
)


@dataclass(frozen=True)
class ContactSettings:
    """Set what plans pay for coming close to bodies on physical ground."""

    margin: float = 2.0
    """D of `square_distance` below which plans pay for coming close to a body [1].

    It is 0.52 m beside and 1.04 m ahead of a car of 5 by 2.5 m, and 0.90 and 1.42 m
    from the edge of a cone. Cars side by side in lanes of 3.3 m are farther apart; in
    lanes of less than 3.02 m, they pay all the time.
    """
    cost: float = 10.0
    """Cost per step of a point on another car's side, at D = 1 [reward].

    Chosen on 20 to 60 starts of Merger and Give Way: bodies stay 0.1 m apart or more
    under every model. At three times this cost, naive plans and theory of mind earn
    less.
    """
    obstacle_weight: float = 3.0
    """Weight of an obstacle: its centre counts alone, a car counts with several points.
    """


CONTACT = ContactSettings()


def overlap(
    scene: Scene,
    own: Motion,
    others: Motion,
    clearance: float = 0.0,
) -> Bool[jax.Array, "*times"]:
    """Return whether the car's body overlaps another car's or an obstacle's.

    Args:
        scene: obstacles and sizes of bodies.
        own: motion of the car, arrays [*times].
        others: motion of the other cars, arrays [others, *times].
        clearance: by which all bodies are longer and wider than they are [m].
    """
    length, width = jnp.asarray(scene.car_size) + clearance
    size = (length, width)
    gaps = separation_of_directed(own[:4], others[:4], size, size)
    with_cars = jnp.any(gaps < 0, axis=0)
    if not len(scene.obstacles):
        return with_cars
    radius = (jnp.asarray(scene.obstacle_size)[1] + clearance) / 2
    along, across = _obstacles_in_frame(scene, own)
    overlaps = circles_overlap(along, across, size, radius)  # [obstacles, *times]
    return with_cars | jnp.any(overlaps, axis=0)


def contact_cost(scene: Scene, own: Motion, others: Motion) -> Times:
    """Compute the cost of plans near other bodies, ``sum c(D)`` with::

        c(D) = cost max(margin - D, 0)^3

    by `ContactSettings`. The sum is over the car's `contact_points` and all other cars,
    and over the obstacles, each of which counts ``obstacle_weight`` times. D is the
    `square_distance` of a point from a car, or of an obstacle's centre from the car,
    which is then longer and wider by the obstacle's diameter.

    Args:
        scene: obstacles and sizes of bodies.
        own: motion of the car, arrays [*times].
        others: motion of the other cars, arrays [others, *times].
    """
    # D of the car's points from all other cars [others, points, *times].
    points = contact_points(scene)
    along, across = point_offsets(own[:4], points, others[:4])
    car_size = jnp.asarray(scene.car_size)
    from_cars = _distance_from(car_size, along, across)
    cost = jnp.sum(_cost(from_cars), axis=(0, 1))
    if not len(scene.obstacles):
        return cost

    # D of the obstacles from the car [obstacles, *times].
    from_obstacles = _distance_of_obstacles(scene, own)
    cost_of_obstacles = jnp.sum(_cost(from_obstacles), axis=0)
    return cost + CONTACT.obstacle_weight * cost_of_obstacles


def contact_points(scene: Scene) -> Float[jax.Array, "points 2"]:
    """Return the points of a car whose distances from other cars cost plans [m].

    They are in the car's own frame. Corners see all cars that drive along the same
    road, and the centre sees those that cross.
    """
    centre = np.zeros((1, 2), np.float32)
    in_sizes = np.concatenate([CORNERS / 2, centre])
    return jnp.asarray(in_sizes) * jnp.asarray(scene.car_size)


def car_residuals(
    scene: Scene,
    points: Float[Array, "2 points steps"],
    others: Motion,
) -> Float[jax.Array, "others points steps"]:
    """Return quantities whose squares have `contact_cost`'s second derivatives in D.

    The derivatives of D are left to the caller; its second ones are left out
    (Gauss-Newton).

    Args:
        scene: sizes of bodies.
        points: x and y of the car's `contact_points`, in the coordinates of the road
            [m].
        others: motion of the other cars, arrays [others, steps].
    """
    other = Motion(*(part[:, None] for part in others))
    x = points[0]
    y = points[1]
    along, across = place_in_frame(other[:4], x, y)
    car_size = jnp.asarray(scene.car_size)
    distance = _distance_from(car_size, along, across)
    return _residual(distance)


def obstacle_residuals(
    scene: Scene,
    own: Motion,
) -> Float[jax.Array, "obstacles steps"]:
    """Return the same as `car_residuals` for obstacles."""
    residual = _residual(_distance_of_obstacles(scene, own))
    return CONTACT.obstacle_weight**0.5 * residual


def _cost(distance: Numbers) -> Numbers:
    depth = jnp.maximum(CONTACT.margin - distance, 0.0)
    return CONTACT.cost * depth**3


def _residual(distance: Numbers) -> jax.Array:
    """Return ``sqrt(c'' / 2) D`` of the cost c, with c'' taken as constant."""
    now = jax.lax.stop_gradient(distance)
    depth = jnp.maximum(CONTACT.margin - now, 0.0)
    second_derivative = 6 * CONTACT.cost * depth
    return jnp.sqrt(second_derivative / 2) * distance


def _distance_of_obstacles(
    scene: Scene,
    own: Motion,
) -> Float[jax.Array, "obstacles *times"]:
    """Return D of the obstacles' centres from the car, widened by their diameter."""
    diameter = jnp.asarray(scene.obstacle_size)[1]
    size = jnp.asarray(scene.car_size) + diameter
    along, across = _obstacles_in_frame(scene, own)
    return jnp.asarray(_distance_from(size, along, across))


def _distance_from(size: Array, along: Numeric, across: Numeric) -> Numbers:
    """Return the `square_distance` of places along and across a body of a size [m]."""
    half_length = size[0] / 2
    half_width = size[1] / 2
    return square_distance(along / half_length, across / half_width)


def _obstacles_in_frame(scene: Scene, own: Motion) -> Directions:
    """Return where obstacles are, along and across the car [obstacles, *times] [m]."""
    ones = np.ones(own.x.ndim, int)
    x, y = jnp.asarray(scene.obstacles).T.reshape(2, -1, *ones)
    return place_in_frame(own[:4], x, y)
