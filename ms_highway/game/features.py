"""Compute the features of driving states and rewards that are linear in them, r = theta
. phi.

Everything is computed for car 0 with car 1 as its partner. Lengths enter the features
in the scene's ``length_unit`` U, so that weights do not depend on metres.
"""

from collections.abc import Callable
from functools import cache, partial

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.collision_risk import collision_risk
from ms_highway.game.dynamics import Motion, observe
from ms_highway.game.reward import TRAFFIC_FEATURES, Feature, Reward
from ms_highway.game.scene import Scene
from ms_highway.runtime.arrays import Array, Times

HEADING_SHARE = 0.01  # of directional relative to lateral alignment with a lane
SOFT_EDGE = (
    0.2  # m, depth off the road beyond which the smooth feature is nearly quadratic
)
# m, width over which smooth indicators of a lane rise, and the nearest lane changes
SOFT_LANE = 0.5
SOFT_SLANT = (
    0.02  # rad, heading beyond which the smooth width of a car grows nearly linearly
)
STANDSTILL_GAP = 0.06  # length units (2 m), between the bumpers of a standing queue
MIN_GAP = 0.03  # length units (1 m), below which induced braking grows no further
ATTENTION_GAP = (
    0.6  # length units (20 m), gap at which the attention to a neighbour is 1 / e
)
# lane widths, standard deviation of the lateral distance of cars in the own lane
LANE_SPREAD = 0.25


def reward(
    scene: Scene, parameters: Reward, states: Float[Array, "*batch cars 4"]
) -> Float[jax.Array, "*batch"]:
    """Compute car 0's reward in each state, theta . phi."""
    return motion_reward(scene, parameters, *_apart(states))


def features(
    scene: Scene, parameters: Reward, states: Float[Array, "*batch cars 4"]
) -> Float[jax.Array, "*batch features"]:
    """Compute the features phi of car 0 in each state, in the order of the reward's
    names.

    * speed: ``-f (f - 2 s) / s^2`` with ``f = v cos(heading)`` and s the speed limit;
    * lane_alignment: ``-min_lane (y - y_lane)^2 / U^2 + 0.01 cos(heading)``;
    * collision_risk, collision: see `ms_highway.game.collision_risk`;
    * off_road: ``(depth of the outermost corner beyond the road's edge)^2 / U^2``;
    * target_lane: ``-(y - y_target)^2 / U^2``; gap: ``-(x - (x_leader - gap))^2 /
      U^2``;
    * merged: 1 if ``y + width / 2 sin(heading)`` is beyond the inner edge of the target
      lane;
    * partner_target_lane, partner_merged: the same for the partner;
    * direction, headway, closing_speed, induced_braking: see `_traffic`;
    * user-defined features: see `ms_highway.game.reward.add_feature`.

    ``collision``, ``merged`` and ``partner_merged`` are indicators and have no
    gradient.
    """
    return jnp.stack(motion_features(scene, parameters, *_apart(states)), axis=-1)


def motion_reward(
    scene: Scene, parameters: Reward, own: Motion, others: Motion, smooth: bool = False
) -> Times:
    """Compute the reward of a car along its motion, theta . phi.

    Args:
        scene: road, obstacles and bodies.
        parameters: the reward.
        own: motion of the car, arrays [*times].
        others: motion of all others, its partner first, arrays [others, *times].
        smooth: whether indicators, the nearest lane and the edges of the road are
            smoothed, for plans; features of traffic are smooth by themselves.
    """
    columns = motion_features(scene, parameters, own, others, smooth)
    return jnp.sum(
        jnp.asarray(parameters.weights) * jnp.stack(columns, axis=-1), axis=-1
    )


def _apart(states: Float[Array, "*batch cars 4"]) -> tuple[Motion, Motion]:
    """Return the motions of car 0, arrays [*batch], and of the others, arrays [others,
    *batch].
    """
    cars = observe(jnp.moveaxis(jnp.asarray(states), -2, 0))
    return Motion(*(field[0] for field in cars)), Motion(*(field[1:] for field in cars))


def motion_features(
    scene: Scene, parameters: Reward, own: Motion, others: Motion, smooth: bool = False
) -> list[Times]:
    """Compute the features of a car along its motion, one array for each of the
    reward's names.

    Takes the arguments of `motion_reward`. Constants are inverted once, not divided by
    at every state.
    """
    per_unit = 1 / scene.length_unit
    forward = own.speed * own.cosine / parameters.speed_limit
    risk, collision = collision_risk(scene, own, others, smooth)
    behind = jnp.zeros_like(own.x)
    if scene.leader is not None:
        behind = (own.x - others.x[scene.leader - 1] + parameters.gap) * per_unit
    aside, merged = _merging(scene, own, others, smooth)
    traffic = (
        _traffic(scene, parameters, own, others)
        if TRAFFIC_FEATURES[0] in parameters.names
        else []
    )
    return [
        -forward * (forward - 2),
        HEADING_SHARE * own.cosine - _off_lanes(scene, own, smooth) * per_unit**2,
        risk,
        collision,
        (depth_off_road(scene, own, smooth) * per_unit) ** 2,
        -(aside[0] ** 2),
        -(behind**2),
        merged[0],
        -(aside[1] ** 2),
        merged[1],
        *traffic,
        *(
            _at_every_moment(function, scene, own, others)
            for function in parameters.own
        ),
    ]


def _at_every_moment(
    function: Feature, scene: Scene, own: Motion, others: Motion
) -> Times:
    """Compute a user-defined feature along a motion; it is mapped over times, so that
    it sees one moment at a time.
    """
    mapped: Callable[[Motion, Motion], jax.Array] = partial(function, scene)
    for _ in range(own.x.ndim):
        mapped = jax.vmap(mapped, in_axes=-1, out_axes=-1)
    return jnp.asarray(mapped(own, others), own.x.dtype)


def check_own_features(
    scene: Scene,
    parameters: Reward,
    humans: int,
    state: Float[Array, "cars 4"],
    gradients: bool = True,
) -> None:
    """Check that user-defined features, as the robot and every human sees a state, are
    finite with their gradients.

    Args:
        scene: road, obstacles and bodies.
        parameters: the reward; without a user-defined feature, nothing is computed.
        humans: their number.
        state: of all cars.
        gradients: whether gradients are checked, too; plans need them.

    Raises:
        ValueError: naming the feature.
    """
    names = parameters.names[len(parameters.names) - len(parameters.own) :]
    for name, function in zip(names, parameters.own, strict=True):
        for car in range(1 + humans):
            others = [
                other for other in range(len(state)) if other != car
            ]  # a human's partner is the robot
            seen = np.asarray(state, np.float32)[np.array([car, *others])]
            place = (
                f"of car {car} in the state"
                f" {np.round(np.asarray(state, float), 2).tolist()}"
            )
            try:
                value, finite = _with_gradient(function)(scene, seen)
            except Exception as error:  # a user's function may fail in any way
                reason = str(error).partition("\n")[0]
                raise ValueError(
                    f"the feature {name!r} {place} cannot be computed: {reason}"
                ) from error
            if not np.isfinite(value):
                raise ValueError(
                    f"the feature {name!r} {place} is {float(value):g}; return a finite"
                    " number"
                )
            if gradients and not finite:
                remedy = (
                    "keep roots and divisions away from 0, such as jnp.sqrt(x + 1e-6)"
                )
                raise ValueError(
                    f"the feature {name!r} {place} has a gradient that is not finite;"
                    f" {remedy}"
                )


@cache
def _with_gradient(
    function: Feature,
) -> Callable[[Scene, Array], tuple[jax.Array, jax.Array]]:
    """Compile what returns a feature of car 0 in a state, and whether its gradient is
    finite.
    """

    def found(scene: Scene, state: Array) -> tuple[jax.Array, jax.Array]:
        both = _apart(state)
        value, slopes = jax.value_and_grad(
            lambda both: jnp.asarray(function(scene, *both), jnp.float32)
        )(both)
        return (
            value,
            jnp.stack(
                [jnp.isfinite(part).all() for part in jax.tree.leaves(slopes)]
            ).all(),
        )

    return jax.jit(found)


def _traffic(
    scene: Scene, parameters: Reward, own: Motion, others: Motion
) -> list[Times]:
    """Compute the features of following and being followed in real traffic.

    With g the gap between bumpers in length units U, v the own speed, v_j the other's,
    and the attention ``w = exp(-g / 0.6) exp(-(dy / (lane width / 4))^2 / 2)``, which
    decays with the gap and the lateral distance:

    * direction: ``cos(heading)``; ``lane_alignment`` holds a fixed share of it;
    * headway: ``-sum w (g - (0.06 + v h / U))^2`` over the cars ahead: the difference
      between the gap and the wanted one, 2 m plus the way in h seconds, 1 by default;
    * closing_speed: ``-sum w ((v - v_j) / s)^2`` over the cars ahead, with the speed
      limit s;
    * induced_braking: ``-sum w (max(v_j - v, 0)^2 / (2 U^2 max(g, 0.03)))^2`` over the
      cars behind: the braking [U/s^2] that keeps them from hitting this car.
    """
    along, gap, attended = attention(scene, own, others)
    ahead, behind = (
        jnp.where(place, attended, 0.0) for place in (along > 0, along <= 0)
    )
    per_unit = 1 / scene.length_unit
    speed = own.speed * per_unit
    faster = jnp.maximum(others.speed * per_unit - speed, 0.0)
    braking = faster**2 / (2 * jnp.maximum(gap, MIN_GAP))
    return [
        own.cosine,
        -jnp.sum(
            ahead * (gap - STANDSTILL_GAP - parameters.headway * speed) ** 2, axis=0
        ),
        -jnp.sum(
            ahead * ((own.speed - others.speed) / parameters.speed_limit) ** 2, axis=0
        ),
        -jnp.sum(behind * braking**2, axis=0),
    ]


def _off_lanes(scene: Scene, car: Motion, smooth: bool) -> Times:
    """Return the squared distance from the nearest lane [m^2]; the smooth form has no
    kink between lanes.
    """
    squares = (car.y[..., None] - jnp.asarray(scene.lanes)) ** 2
    nearest = squares.min(axis=-1)
    if not smooth:
        return nearest
    nearest = jax.lax.stop_gradient(
        nearest
    )  # subtracted only to keep exponentials finite
    return nearest - SOFT_LANE**2 * jnp.log(
        jnp.sum(jnp.exp((nearest[..., None] - squares) / SOFT_LANE**2), axis=-1)
    )


def attention(scene: Scene, own: Motion, others: Motion) -> tuple[Times, Times, Times]:
    """Return how far ahead others are, the gaps to them [length units], and the
    attention to them, see `_traffic`.
    """
    per_unit = 1 / scene.length_unit
    along = (others.x - own.x) * per_unit
    across = (others.y - own.y) / (LANE_SPREAD * scene.lane_width)
    gap = jnp.maximum(jnp.abs(along) - scene.car_size[0] * per_unit, 0.0)
    return along, gap, jnp.exp(-gap / ATTENTION_GAP - across**2 / 2)


def depth_off_road(scene: Scene, car: Motion, smooth: bool) -> Times:
    """Return how far the outermost corner is beyond the edge of the road, 0 on the road
    [m].

    The smooth form is its `soft_positive` with `SOFT_EDGE`.
    """
    length, width = scene.car_size
    slant = (
        jnp.sqrt(car.sine**2 + SOFT_SLANT**2) - SOFT_SLANT
        if smooth
        else jnp.abs(car.sine)
    )
    reach = (length * slant + width * jnp.abs(car.cosine)) / 2
    low = jnp.min(jnp.asarray(scene.lanes))
    high = jnp.max(jnp.asarray(scene.lanes))
    depth = (
        jnp.abs(car.y - (low + high) / 2) + reach - (high - low + scene.lane_width) / 2
    )
    return (
        soft_positive(depth, SOFT_EDGE) if smooth else jnp.where(depth > 0, depth, 0.0)
    )


def soft_positive(excess: Array, soft: float) -> Array:
    """Return ``z^2 / (z + soft)`` of the positive part z of an excess: quadratic at
    first, then nearly linear.
    """
    positive = jnp.where(excess > 0, excess, 0.0)
    return positive**2 / (positive + soft)


def _merging(
    scene: Scene, own: Motion, others: Motion, smooth: bool
) -> tuple[Times, Times]:
    """Return the distances of the car and its partner from the target lane [length
    units], and whether they are in it.

    The indicator is 1 where ``y + width / 2 sin(heading)`` is beyond the lane's inner
    edge, else 0; its smooth form is a sigmoid of the depth beyond the edge.
    """
    y = jnp.stack([own.y, others.y[0]])
    sine = jnp.stack([own.sine, others.sine[0]])
    side = jnp.where(scene.target_lane <= jnp.mean(jnp.asarray(scene.lanes)), -1.0, 1.0)
    aside = y - scene.target_lane
    depth = side * (aside + scene.car_size[1] / 2 * sine) + scene.lane_width / 2
    merged = (
        jax.nn.sigmoid(depth / SOFT_LANE)
        if smooth
        else jax.lax.stop_gradient(depth > 0).astype(y.dtype)
    )
    return aside / scene.length_unit, merged
