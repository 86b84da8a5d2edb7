"""Features of a driving state and rewards that are linear in them: r = theta . phi(x).

Everything is written for car 0 with car 1 as its partner; swap the two to look at the scene through the partner's
eyes. Lengths enter the features in the scene's ``length_unit`` U, so that weights do not depend on metres.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.dynamics import Array
from ms_highway.scene import Scene

__all__ = ["FEATURES", "Reward", "features", "reward", "weights"]

FEATURES = (
    "speed",
    "lane_alignment",
    "collision_risk",
    "collision",
    "off_road",
    "target_lane",
    "gap",
    "merged",
    "partner_target_lane",
    "partner_merged",
)
"""Names of the features, in the order of a weight vector."""

CAR_SHARPNESS = 1.5
OBSTACLE_SHARPNESS = 4.0
OBSTACLE_SHARE = 0.5  # an obstacle's risk counts half of a car's
HEADING_SHARE = 0.01  # of directional against lateral alignment with a lane


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Reward:
    """A linear reward with the two numbers that its features are measured against.

    Attributes:
        weights: theta, one weight per name in `FEATURES`.
        speed_limit: the speed that the speed feature is highest at [m/s].
        gap: how far behind the leader the gap feature is highest [m].
    """

    weights: Float[Array, "features"]
    speed_limit: float | Float[Array, ""]
    gap: float | Float[Array, ""]


def weights(values: Mapping[str, float]) -> Float[np.ndarray, "features"]:
    """A weight vector from weights by name; a feature without a weight gets 0.

    Raises:
        ValueError: for a name that is no feature.
    """
    unknown = sorted(set(values) - set(FEATURES))
    if unknown:
        raise ValueError(f"unknown reward features {unknown}; the features are {', '.join(FEATURES)}")
    return np.array([values.get(name, 0.0) for name in FEATURES], dtype=np.float32)


def reward(scene: Scene, parameters: Reward, states: Float[Array, "*batch cars 4"]) -> Float[jax.Array, "*batch"]:
    """Car 0's reward in each state: theta . phi."""
    return features(scene, parameters, states) @ jnp.asarray(parameters.weights)


def features(
    scene: Scene, parameters: Reward, states: Float[Array, "*batch cars 4"]
) -> Float[jax.Array, "*batch features"]:
    """The features phi of car 0 in each state, in the order of `FEATURES`.

    * speed: ``-f (f - 2 s) / s^2`` with ``f = v cos(heading)`` and s the speed limit;
    * lane_alignment: ``-min_lane (y - y_lane)^2 / U^2 + 0.01 cos(heading)``;
    * collision_risk: see `_collision_risk`; collision: 1 if a body point is inside another car or an obstacle;
    * off_road: ``(depth of the outermost corner beyond the road's edge)^2 / U^2``;
    * target_lane: ``-(y - y_target)^2 / U^2``; gap: ``-(x - (x_leader - gap))^2 / U^2``;
    * merged: 1 if ``y + width / 2 sin(heading)`` is beyond the inner edge of the target lane;
    * partner_target_lane, partner_merged: the same of the partner.

    ``collision``, ``merged`` and ``partner_merged`` are indicators and have no gradient.
    """
    states = jnp.asarray(states)
    unit = scene.length_unit
    own, partner = states[..., 0, :], states[..., 1, :]
    x, y, heading, speed = jnp.moveaxis(own, -1, 0)
    forward = speed * jnp.cos(heading) / parameters.speed_limit
    lane_offset = jnp.min((y[..., None] - jnp.asarray(scene.lanes)) ** 2, axis=-1) / unit**2
    risk, collision = _collision_risk(scene, states)
    leader_x = x if scene.leader is None else states[..., scene.leader, 0]
    gap_error = jnp.zeros_like(x) if scene.leader is None else (x - (leader_x - parameters.gap)) / unit
    columns = [
        -forward * (forward - 2),
        -lane_offset + HEADING_SHARE * jnp.cos(heading),
        risk,
        collision,
        (_depth_off_road(scene, own) / unit) ** 2,
        -(((y - scene.target_lane) / unit) ** 2),
        -(gap_error**2),
        _merged(scene, own),
        -(((partner[..., 1] - scene.target_lane) / unit) ** 2),
        _merged(scene, partner),
    ]
    return jnp.stack(columns, axis=-1)


def _collision_risk(
    scene: Scene, states: Float[jax.Array, "*batch cars 4"]
) -> tuple[Float[jax.Array, "*batch"], Float[jax.Array, "*batch"]]:
    """Risk and indicator of car 0 colliding.

    Nine points of its body (corners, middles of the edges, centre) are measured in the frame of every other car and
    of every obstacle by ``D = (2 dx / length)^2 + (2 dy / width)^2``: below 1 lies the ellipse inscribed in the body.
    The risk is ``sum exp(-1.5 (D - 1))`` over the points and cars plus half of ``sum exp(-4 (D - 1))`` over the
    points and obstacles; the indicator says whether any D < 1.
    """
    own, others = states[..., 0, :], states[..., 1:, :]
    points = _rotate(_body_points(scene), own[..., None, 2])[..., None, :, :]  # [*batch, 1, 9, 2], from the centre
    from_cars = own[..., None, :2] - others[..., :2]
    from_obstacles = own[..., None, :2] - jnp.asarray(scene.obstacles)
    to_cars = _rotate(from_cars[..., None, :] + points, -others[..., None, 2])
    to_obstacles = from_obstacles[..., None, :] + points
    car_distance = jnp.sum((2 * to_cars / jnp.asarray(scene.car_size)) ** 2, axis=-1)  # D: [*batch, others, 9]
    obstacle_distance = jnp.sum((2 * to_obstacles / jnp.asarray(scene.obstacle_size)) ** 2, axis=-1)
    risk = jnp.sum(jnp.exp(-CAR_SHARPNESS * (car_distance - 1)), axis=(-2, -1)) + OBSTACLE_SHARE * jnp.sum(
        jnp.exp(-OBSTACLE_SHARPNESS * (obstacle_distance - 1)), axis=(-2, -1)
    )
    collision = jnp.any(car_distance < 1, axis=(-2, -1)) | jnp.any(obstacle_distance < 1, axis=(-2, -1))
    return risk, collision.astype(risk.dtype)


def _body_points(scene: Scene) -> Float[jax.Array, "9 2"]:
    """Corners, middles of the edges and centre of a car, in its own frame [m]."""
    q = scene.corner
    shares = [(q, q), (q, -q), (-q, q), (-q, -q), (0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5), (0.0, 0.0)]
    return jnp.array(shares) * jnp.asarray(scene.car_size)


def _rotate(vectors: Float[jax.Array, "*batch 2"], angle: Float[jax.Array, "*batch"]) -> Float[jax.Array, "*batch 2"]:
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return jnp.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def _depth_off_road(scene: Scene, car: Float[jax.Array, "*batch 4"]) -> Float[jax.Array, "*batch"]:
    """How far the outermost corner is beyond the edge of the road, 0 on the road [m]."""
    y, heading = car[..., 1], car[..., 2]
    length, width = scene.car_size
    reach = (length * jnp.abs(jnp.sin(heading)) + width * jnp.abs(jnp.cos(heading))) / 2
    margin = scene.lane_width / 2
    lanes = jnp.asarray(scene.lanes)
    right, left = y + reach - (jnp.max(lanes) + margin), (jnp.min(lanes) - margin) - (y - reach)
    return jnp.maximum(0.0, jnp.maximum(right, left))


def _merged(scene: Scene, car: Float[jax.Array, "*batch 4"]) -> Float[jax.Array, "*batch"]:
    """1 where the car has reached the target lane: ``y + width / 2 sin(heading)`` is beyond that lane's inner edge."""
    side = jnp.where(scene.target_lane <= jnp.mean(jnp.asarray(scene.lanes)), -1.0, 1.0)
    point = car[..., 1] + scene.car_size[1] / 2 * jnp.sin(car[..., 2])
    inside = side * (point - scene.target_lane) > -scene.lane_width / 2
    return jax.lax.stop_gradient(inside.astype(point.dtype))
