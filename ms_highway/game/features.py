"""Compute the features of driving states, and linear rewards r = theta . phi.

Everything is computed for car 0 with car 1 as its partner. Lengths enter the features
in the scene's ``length_unit`` U, so that weights do not depend on metres.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.collision_risk import collision_risk
from ms_highway.game.dynamics import Motion, observe
from ms_highway.game.reward import TRAFFIC_FEATURES, Feature, Reward
from ms_highway.game.scene import Scene
from ms_highway.runtime.arrays import Array, Scalar, Times

HEADING_SHARE = 0.01
"""Weight of directional relative to lateral alignment with a lane, the paper's."""


@dataclass(frozen=True)
class SmoothForms:
    """Set how plans smooth jumps and kinks of features, so that these have slopes."""

    edge: float = 0.2
    """Depth off the road beyond which the smooth feature is nearly quadratic [m]."""
    lane: float = 0.5
    """Width over which indicators of a lane rise and the nearest lane changes [m]."""
    slant: float = 0.02
    """Heading beyond which a car's smooth width grows nearly linearly [rad]."""


SMOOTH = SmoothForms()


@dataclass(frozen=True)
class FollowingSettings:
    """Set the features of following and being followed, see `_traffic`.

    A length unit is the paper's, 100/3 m.
    """

    standstill_gap: float = 0.06
    """Gap between the bumpers of a standing queue [length units]: 2 m."""
    min_gap: float = 0.03
    """Gap below which induced braking grows no further [length units]: 1 m."""
    attention_gap: float = 0.6
    """Gap at which the attention to a neighbour is 1 / e [length units]: 20 m."""
    lane_spread: float = 0.25
    """Standard deviation of the lateral distance of cars in a lane [lane widths]."""


FOLLOWING = FollowingSettings()


def reward(
    scene: Scene,
    parameters: Reward,
    states: Float[Array, "*batch cars 4"],
) -> Float[jax.Array, "*batch"]:
    """Compute car 0's reward in each state, theta . phi."""
    return jnp.asarray(motion_reward(scene, parameters, *_apart(states)))


def features(
    scene: Scene,
    parameters: Reward,
    states: Float[Array, "*batch cars 4"],
) -> Float[jax.Array, "*batch features"]:
    """Compute the features phi of car 0 in each state.

    They are in the order of the reward's names:

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
    scene: Scene,
    parameters: Reward,
    own: Motion,
    others: Motion,
    smooth: bool = False,
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
    phi = jnp.stack(columns, axis=-1)
    return jnp.sum(jnp.asarray(parameters.weights) * phi, axis=-1)


def _apart(states: Float[Array, "*batch cars 4"]) -> tuple[Motion, Motion]:
    """Return the motions of car 0 [*batch] and of the others [others, *batch]."""
    cars = observe(jnp.moveaxis(jnp.asarray(states), -2, 0))
    return Motion(*(field[0] for field in cars)), Motion(*(field[1:] for field in cars))


def motion_features(
    scene: Scene,
    parameters: Reward,
    own: Motion,
    others: Motion,
    smooth: bool = False,
) -> list[Times]:
    """Compute the features of a car along its motion, one array per name.

    Takes the arguments of `motion_reward`. Constants are inverted once, not divided by
    at every state.
    """
    per_unit = 1 / scene.length_unit
    forward = own.speed * own.cosine / parameters.speed_limit
    risk, collision = collision_risk(scene, own, others, smooth)

    # How far the car is from its place behind the leader.
    behind = jnp.zeros_like(own.x)
    if scene.leader is not None:
        behind = (own.x - others.x[scene.leader - 1] + parameters.gap) * per_unit

    from_target, merged = _merging(scene, own, others, smooth)
    traffic = []
    if TRAFFIC_FEATURES[0] in parameters.names:
        traffic = _traffic(scene, parameters, own, others)

    # The paper's features, in the order of `PAPER_FEATURES`.
    speed = -forward * (forward - 2)
    off_lanes = _off_lanes(scene, own, smooth) * per_unit**2
    lane_alignment = HEADING_SHARE * own.cosine - off_lanes
    off_road = (depth_off_road(scene, own, smooth) * per_unit) ** 2
    columns = [
        speed,
        lane_alignment,
        risk,
        collision,
        off_road,
        -(from_target[0] ** 2),
        -(behind**2),
        merged[0],
        -(from_target[1] ** 2),
        merged[1],
        *traffic,
    ]
    for function in parameters.user_features:
        columns.append(_at_every_moment(function, scene, own, others))
    return columns


def _at_every_moment(
    function: Feature,
    scene: Scene,
    own: Motion,
    others: Motion,
) -> Times:
    """Compute a user-defined feature along a motion.

    It is mapped over times, so that it sees one moment at a time.
    """
    mapped: Callable[[Motion, Motion], Scalar] = partial(function, scene)
    for _ in range(own.x.ndim):
        mapped = jax.vmap(mapped, in_axes=-1, out_axes=-1)
    return jnp.asarray(mapped(own, others), own.x.dtype)


def check_user_features(
    scene: Scene,
    parameters: Reward,
    humans: int,
    state: Float[Array, "cars 4"],
    gradients: bool = True,
) -> None:
    """Check that user-defined features and their gradients are finite in a state.

    The robot and every human sees the state from its own side.

    Args:
        scene: road, obstacles and bodies.
        parameters: the reward; without a user-defined feature, nothing is computed.
        humans: their number.
        state: of all cars.
        gradients: whether gradients are checked, too; plans need them.

    Raises:
        ValueError: naming the feature.
    """
    first = len(parameters.names) - len(parameters.user_features)
    names = parameters.names[first:]
    for name, function in zip(names, parameters.user_features, strict=True):
        for car in range(1 + humans):
            # A human's partner is the robot, which comes first among the others.
            others = [other for other in range(len(state)) if other != car]
            order = np.array([car, *others])
            from_side = np.asarray(state, np.float32)[order]
            shown = np.round(np.asarray(state, float), 2).tolist()
            subject = f"the feature {name!r} of car {car} in the state {shown}"
            _check_user_feature(function, scene, from_side, subject, gradients)


def _check_user_feature(
    function: Feature,
    scene: Scene,
    state: Float[np.ndarray, "cars 4"],
    subject: str,
    gradients: bool,
) -> None:
    """Check a feature of car 0 in one state, see `check_user_features`.

    Raises:
        ValueError: beginning with the subject.
    """
    try:
        value, finite = _with_gradient(function)(scene, state)
    except Exception as error:  # a user's function may fail in any way
        reason = str(error).partition("\n")[0]
        raise ValueError(f"{subject} cannot be computed: {reason}") from error
    if not np.isfinite(value):
        raise ValueError(f"{subject} is {float(value):g}; return a finite number")
    if gradients and not finite:
        remedy = "keep roots and divisions away from 0, such as jnp.sqrt(x + 1e-6)"
        raise ValueError(f"{subject} has a gradient that is not finite; {remedy}")


@cache
def _with_gradient(
    function: Feature,
) -> Callable[[Scene, Array], tuple[jax.Array, jax.Array]]:
    """Compile the value of a feature of car 0, and whether its gradient is finite."""

    def value_and_finite(scene: Scene, state: Array) -> tuple[jax.Array, jax.Array]:
        motions = _apart(state)
        value, slopes = jax.value_and_grad(
            lambda both: jnp.asarray(function(scene, *both), jnp.float32)
        )(motions)
        finite = [jnp.isfinite(part).all() for part in jax.tree.leaves(slopes)]
        return value, jnp.stack(finite).all()

    return jax.jit(value_and_finite)


def _traffic(
    scene: Scene,
    parameters: Reward,
    own: Motion,
    others: Motion,
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
    # w of every other car, 0 for those behind or ahead [others, *times].
    along, gap, attended = attention(scene, own, others)
    ahead = jnp.where(along > 0, attended, 0.0)
    behind = jnp.where(along <= 0, attended, 0.0)
    per_unit = 1 / scene.length_unit
    speed = own.speed * per_unit
    faster = jnp.maximum(others.speed * per_unit - speed, 0.0)
    braking = faster**2 / (2 * jnp.maximum(gap, FOLLOWING.min_gap))

    gap_error = gap - FOLLOWING.standstill_gap - parameters.headway * speed
    headway = -jnp.sum(ahead * gap_error**2, axis=0)
    approach = (own.speed - others.speed) / parameters.speed_limit
    closing_speed = -jnp.sum(ahead * approach**2, axis=0)
    induced_braking = -jnp.sum(behind * braking**2, axis=0)
    return [own.cosine, headway, closing_speed, induced_braking]


def _off_lanes(scene: Scene, car: Motion, smooth: bool) -> Times:
    """Return the squared distance from the nearest lane [m^2].

    The smooth form, ``-w^2 log sum exp(-d^2 / w^2)`` over the lanes, has no kink
    between them.
    """
    squares = (car.y[..., None] - jnp.asarray(scene.lanes)) ** 2  # [*times, lanes]
    nearest = squares.min(axis=-1)
    if not smooth:
        return nearest

    # The nearest is subtracted only to keep exponentials finite.
    nearest = jax.lax.stop_gradient(nearest)
    closeness = jnp.exp((nearest[..., None] - squares) / SMOOTH.lane**2)
    return nearest - SMOOTH.lane**2 * jnp.log(jnp.sum(closeness, axis=-1))


def attention(scene: Scene, own: Motion, others: Motion) -> tuple[Times, Times, Times]:
    """Return how far ahead others are, the gaps to them, and the attention to them.

    Distances are in length units. See `_traffic` for the attention.
    """
    per_unit = 1 / scene.length_unit
    along = (others.x - own.x) * per_unit
    across = (others.y - own.y) / (FOLLOWING.lane_spread * scene.lane_width)
    car_length = scene.car_size[0] * per_unit
    gap = jnp.maximum(jnp.abs(along) - car_length, 0.0)
    attended = jnp.exp(-gap / FOLLOWING.attention_gap - across**2 / 2)
    return along, gap, attended


def depth_off_road(scene: Scene, car: Motion, smooth: bool) -> Times:
    """Return how far the outermost corner is beyond the edge of the road [m].

    It is 0 on the road. The smooth form is its `soft_positive`.
    """
    # How far the body reaches to the side of its centre.
    length, width = scene.car_size
    if smooth:
        slant = jnp.sqrt(car.sine**2 + SMOOTH.slant**2) - SMOOTH.slant
    else:
        slant = jnp.abs(car.sine)
    reach = (length * slant + width * jnp.abs(car.cosine)) / 2

    # How far that is beyond the edge, half a lane beyond the outermost lane's centre.
    low = jnp.min(jnp.asarray(scene.lanes))
    high = jnp.max(jnp.asarray(scene.lanes))
    from_middle = jnp.abs(car.y - (low + high) / 2)
    depth = from_middle + reach - (high - low + scene.lane_width) / 2
    if smooth:
        return soft_positive(depth, SMOOTH.edge)
    return jnp.where(depth > 0, depth, 0.0)


def soft_positive(excess: Array, soft: float) -> Array:
    """Return ``z^2 / (z + soft)`` of the positive part z of an excess.

    It is quadratic at first, then nearly linear.
    """
    positive = jnp.where(excess > 0, excess, 0.0)
    return positive**2 / (positive + soft)


def _merging(
    scene: Scene,
    own: Motion,
    others: Motion,
    smooth: bool,
) -> tuple[Times, Times]:
    """Return how far the car and its partner are from the target lane, and in it.

    The distances are in length units. The indicator of being in the lane is 1 where ``y
    + width / 2 sin(heading)`` is beyond its inner edge, else 0; its smooth form is a
    sigmoid of the depth beyond the edge.
    """
    y = jnp.stack([own.y, others.y[0]])
    sine = jnp.stack([own.sine, others.sine[0]])

    # The target lane is the left one, entered at y below its inner edge, or the right.
    side = jnp.where(scene.target_lane <= jnp.mean(jnp.asarray(scene.lanes)), -1.0, 1.0)
    offset = y - scene.target_lane
    depth = side * (offset + scene.car_size[1] / 2 * sine) + scene.lane_width / 2
    if smooth:
        merged = jax.nn.sigmoid(depth / SMOOTH.lane)
    else:
        merged = jax.lax.stop_gradient(depth > 0).astype(y.dtype)
    return offset / scene.length_unit, merged
