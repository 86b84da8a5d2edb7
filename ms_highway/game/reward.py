"""Features of a driving state and rewards that are linear in them: r = theta . phi(x).

Everything is written for car 0 with car 1 as its partner; swap the two to look at the scene through the partner's
eyes. Lengths enter the features in the scene's ``length_unit`` U, so that weights do not depend on metres.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial, reduce
from typing import TypeAlias

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.dynamics import Motion, observe
from ms_highway.game.scene import Scene
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.unrolled import fold, total

__all__ = [
    "COMFORT",
    "FEATURES",
    "OWN_FEATURES",
    "PAPER_FEATURES",
    "Feature",
    "Reward",
    "add_feature",
    "features",
    "features_for",
    "linear_reward",
    "motion_features",
    "motion_reward",
    "reward",
    "weight_names",
]

PAPER_FEATURES = (
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
"""Names of the paper's features, in the order of a weight vector."""

TRAFFIC_FEATURES = ("direction", "headway", "closing_speed", "induced_braking")

FEATURES = (*PAPER_FEATURES, *TRAFFIC_FEATURES)
"""Names of the package's features: the paper's, and those that real traffic needs, which weigh nothing in the paper."""

COMFORT = ("comfort_steering", "comfort_acceleration")
"""Names of the weights of comfort, which belongs to controls rather than to states, see `Reward`."""

Feature: TypeAlias = Callable[[Scene, Motion, Motion], Float[jax.Array, ""]]
"""A feature of one's own, one number at one moment: of the scene, the motion of car 0, and that of all others, arrays
[others], its partner first."""

OWN_FEATURES: dict[str, Feature] = {}
"""Features of one's own by name, see `add_feature`."""

COMPUTATION = "computation"  # what environments call the price of planning, beside features
CAR_SHARPNESS = 1.5
OBSTACLE_SHARPNESS = 4.0
OBSTACLE_SHARE = 0.5  # an obstacle's risk counts half of a car's
CARS_AT_ONCE = 2  # XLA still unrolls and vectorises the loops over two cars, and no longer those over three
CORNERS = np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)], dtype=np.float32)
MIDDLES = np.array([(0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5), (0, 0)], dtype=np.float32)  # of the edges, and the body's
HEADING_SHARE = 0.01  # of directional against lateral alignment with a lane
TIME_HEADWAY = 1.0  # s, between bumpers
STANDSTILL_GAP = 0.06  # length units (2 m), between the bumpers of a standing queue
SMALLEST_GAP = 0.03  # length units (1 m), below which induced braking does not grow any more
ATTENTION = 0.6  # length units (20 m), the gap by which the attention to a neighbour falls to 1 / e
OWN_LANE = 0.25  # lane widths, standard deviation of how far to the side a car is still in the own lane


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Reward:
    """A linear reward with the two numbers that its features are measured against.

    Attributes:
        weights: theta, one weight per name of a feature.
        speed_limit: the speed that the speed feature is highest at [m/s].
        gap: how far behind the leader the gap feature is highest [m].
        comfort: what plans pay, beside the features, for half the square of each scaled control's difference from
            keeping the velocity.
        names: of the features, `PAPER_FEATURES` or `FEATURES`, and then those of one's own; others are not even
            computed (static).
        own: the functions of the features of one's own, which the last names belong to (static).
    """

    weights: Float[Array, "features"]
    speed_limit: float | Float[Array, ""]
    gap: float | Float[Array, ""]
    comfort: Float[Array, "2"]
    names: tuple[str, ...] = field(metadata={"static": True})
    own: tuple[Feature, ...] = field(default=(), metadata={"static": True})


def add_feature(name: str, function: Feature) -> None:
    """Make a feature of one's own known by its name, to rewards, configurations and commands of this process.

    It is computed where a reward weighs it, and then Algorithm 1 leaves nothing out of its derivatives, see
    `ms_highway.metareasoning.switching.decide`. A weight that is learned is positive, so that it tells what drivers
    want more of. Added again, it takes the place of the one that had its name, in rewards that are made from then on.

    Args:
        name: one word.
        function: see `Feature`; written with `jax.numpy`, and twice differentiable where plans shall climb it. It is
            told one moment, and mapped over all of them. Lengths are metres, and may be divided by
            ``scene.length_unit`` for weights of the size of the others. To be pickled, it must be one of a module.
            It is tried out on a straight scene without a leader: ``scene.bend`` and ``scene.leader`` may be None. Any
            number of others may be there, one at least.

    Raises:
        ValueError: if the name is taken by the package or no word; if the function is not hashable, cannot be computed,
            or does not return one number.
    """
    taken = (*FEATURES, *COMFORT, COMPUTATION)
    if not isinstance(name, str) or not name.isidentifier() or name in taken:
        raise ValueError(f"a feature cannot be called {name!r}; choose one word other than {', '.join(taken)}")
    own, others = (Motion(*np.zeros((5, *shape), np.float32)) for shape in ((), (3,)))
    scene = Scene(np.zeros(3), 0.0, np.zeros((2, 2)), np.ones(2), np.ones(2), 0.5, 0.0, 1.0)
    try:
        hash(function)
        value = jax.eval_shape(function, scene, own, others)
    except Exception as error:  # a user's function may fail in any way
        told = str(error).partition("\n")[0]
        raise ValueError(
            f"the feature {name!r} cannot be computed: {type(error).__name__}: {told}; "
            "give a function of (scene, own, others), written with jax.numpy"
        ) from error
    number = isinstance(value, jax.ShapeDtypeStruct)
    if not number or value.shape or jnp.iscomplexobj(value):
        told = f"{value.dtype} of shape {value.shape}" if number else f"{type(value).__name__}"
        raise ValueError(f"the feature {name!r} returns {told} for one moment; it must return one number")
    OWN_FEATURES[name] = function


def weight_names() -> tuple[str, ...]:
    """Names of all weights that are known: of features, the package's and one's own, and of comfort."""
    return (*FEATURES, *OWN_FEATURES, *COMFORT)


def linear_reward(
    values: Mapping[str, float],
    speed_limit: float,
    gap: float = 0.0,
    names: tuple[str, ...] | None = None,
) -> Reward:
    """A reward from weights by name, of `weight_names`; what is without a weight gets 0.

    Args:
        values: the weights.
        speed_limit: see `Reward` [m/s].
        gap: see `Reward` [m].
        names: of the features to compute; without, see `features_for`.

    Raises:
        ValueError: for a name that is no feature, or a weight that is not finite, or whose feature is not computed.
    """
    known = weight_names()
    unknown = sorted(map(str, {*values, *(names or ())} - set(known)))
    if unknown:
        raise ValueError(
            f"unknown reward features {unknown}; the features are {', '.join(known)}; "
            "add one of your own with ms_highway.add_feature, or --import the module that does"
        )
    for name, value in values.items():
        if isinstance(value, (bool, str)) or not np.isscalar(value) or not np.isfinite(value):
            raise ValueError(f"the weight of {name} is {value!r}; it must be a finite number")
    names = names or features_for(values)
    if names != tuple(name for name in (*FEATURES, *OWN_FEATURES) if name in names):
        raise ValueError(f"the features {', '.join(names)} are not in the order of FEATURES, then those of one's own")
    left_out = [name for name, value in values.items() if value != 0 and name not in (*names, *COMFORT)]
    if left_out:
        raise ValueError(f"{', '.join(left_out)} would not be computed; add them to the names of the features")
    weights, comfort = (np.array([values.get(name, 0.0) for name in group], np.float32) for group in (names, COMFORT))
    own = tuple(OWN_FEATURES[name] for name in names if name in OWN_FEATURES)
    return Reward(weights, speed_limit, gap, comfort, names, own)


def features_for(*rewards: Mapping[str, float], least: tuple[str, ...] = PAPER_FEATURES) -> tuple[str, ...]:
    """Names of the features that have to be computed for all of these weights by name.

    Args:
        rewards: the weights; what all of them weigh with 0 is left out.
        least: what is computed in any case, `PAPER_FEATURES` or `FEATURES`.
    """
    weighed = {name for values in rewards for name, value in values.items() if value != 0}
    packaged = least if weighed.isdisjoint(TRAFFIC_FEATURES) else FEATURES
    return (*packaged, *(name for name in OWN_FEATURES if name in weighed))


def reward(scene: Scene, parameters: Reward, states: Float[Array, "*batch cars 4"]) -> Float[jax.Array, "*batch"]:
    """Car 0's reward in each state: theta . phi."""
    return motion_reward(scene, parameters, *_apart(states))


def features(
    scene: Scene, parameters: Reward, states: Float[Array, "*batch cars 4"]
) -> Float[jax.Array, "*batch features"]:
    """The features phi of car 0 in each state, in the order of the reward's names.

    * speed: ``-f (f - 2 s) / s^2`` with ``f = v cos(heading)`` and s the speed limit;
    * lane_alignment: ``-min_lane (y - y_lane)^2 / U^2 + 0.01 cos(heading)``;
    * collision_risk: see `_collision_risk`; collision: 1 if a body point is inside another car or an obstacle;
    * off_road: ``(depth of the outermost corner beyond the road's edge)^2 / U^2``;
    * target_lane: ``-(y - y_target)^2 / U^2``; gap: ``-(x - (x_leader - gap))^2 / U^2``;
    * merged: 1 if ``y + width / 2 sin(heading)`` is beyond the inner edge of the target lane;
    * partner_target_lane, partner_merged: the same of the partner;
    * direction, headway, closing_speed, induced_braking: see `_traffic`;
    * those of one's own: see `add_feature`.

    ``collision``, ``merged`` and ``partner_merged`` are indicators and have no gradient. Nor has ``collision_risk`` in
    where the points of the body are: derivatives are those in states, not in the shape of cars.
    """
    return jnp.stack(motion_features(scene, parameters, *_apart(states)), axis=-1)


def motion_reward(scene: Scene, parameters: Reward, own: Motion, others: Motion) -> Float[jax.Array, "*times"]:
    """The reward of a car along its motion, theta . phi.

    Args:
        scene: where.
        parameters: whose reward.
        own: motion of the car, arrays [*times].
        others: motion of all others, its partner first, arrays [others, *times].
    """
    columns = motion_features(scene, parameters, own, others)
    weighted = [weight * column for weight, column in zip(jnp.unstack(parameters.weights), columns, strict=True)]
    return reduce(jnp.add, weighted)


def _apart(states: Float[Array, "*batch cars 4"]) -> tuple[Motion, Motion]:
    """Motions of car 0, arrays [*batch], and of the others, arrays [others, *batch]."""
    cars = observe(jnp.moveaxis(jnp.asarray(states), -2, 0))
    return Motion(*(field[0] for field in cars)), Motion(*(field[1:] for field in cars))


def motion_features(scene: Scene, parameters: Reward, own: Motion, others: Motion) -> list[Float[jax.Array, "*times"]]:
    """The features of a car along its motion, one array for each of the reward's names.

    Takes what `motion_reward` takes. Constants are inverted first: a division by each would be repeated at every state.
    """
    per_unit, per_limit = 1 / scene.length_unit, 1 / parameters.speed_limit
    forward = own.speed * own.cosine * per_limit
    lane = reduce(lambda a, b: jnp.where(jnp.abs(own.y - a) <= jnp.abs(own.y - b), a, b), jnp.unstack(scene.lanes))
    risk, collision = _collision_risk(scene, own, others)
    leader_x = own.x if scene.leader is None else others.x[scene.leader - 1]
    gap_error = jnp.zeros_like(own.x) if scene.leader is None else (own.x - (leader_x - parameters.gap)) * per_unit
    partner = Motion(*(field[0] for field in others))
    traffic = _traffic(scene, parameters, own, others) if TRAFFIC_FEATURES[0] in parameters.names else []
    return [
        -forward * (forward - 2),
        -(((own.y - lane) * per_unit) ** 2) + HEADING_SHARE * own.cosine,
        risk,
        collision,
        (_depth_off_road(scene, own) * per_unit) ** 2,
        -(((own.y - scene.target_lane) * per_unit) ** 2),
        -(gap_error**2),
        _merged(scene, own),
        -(((partner.y - scene.target_lane) * per_unit) ** 2),
        _merged(scene, partner),
        *traffic,
        *(_at_every_moment(function, scene, own, others) for function in parameters.own),
    ]


def _at_every_moment(function: Feature, scene: Scene, own: Motion, others: Motion) -> Float[jax.Array, "*times"]:
    """A feature of one's own along a motion; as it is told one moment at a time, no moment looks at another."""
    mapped: Callable[[Motion, Motion], jax.Array] = partial(function, scene)
    for _ in range(own.x.ndim):
        mapped = jax.vmap(mapped, in_axes=-1, out_axes=-1)
    return jnp.asarray(mapped(own, others), own.x.dtype)


def _traffic(scene: Scene, parameters: Reward, own: Motion, others: Motion) -> list[Float[jax.Array, "*times"]]:
    """The features that following and being followed in real traffic need.

    With g the gap between bumpers in length units U, v the own speed, v_j the other's, and the attention
    ``w = exp(-g / 0.6) exp(-(dy / (lane width / 4))^2 / 2)``, which falls with the gap and beside the own lane:

    * direction: ``cos(heading)``, along the road, which ``lane_alignment`` has a fixed share of;
    * headway: ``-sum w (g - (0.06 + v 1 s / U))^2`` over the cars ahead, their gap against two metres and a second;
    * closing_speed: ``-sum w ((v - v_j) / s)^2`` over the cars ahead, s the speed limit;
    * induced_braking: ``-sum w (max(v_j - v, 0)^2 / (2 U^2 max(g, 0.03)))^2`` over the cars behind: the braking [U/s^2]
      that keeps them from hitting this car.
    """
    per_unit = 1 / scene.length_unit
    along, across = (others.x - own.x) * per_unit, (others.y - own.y) / (OWN_LANE * scene.lane_width)
    gap = jnp.maximum(jnp.abs(along) - scene.car_size[0] * per_unit, 0.0)
    attention = jnp.exp(-gap / ATTENTION - across**2 / 2)
    ahead, behind = (jnp.where(place, attention, 0.0) for place in (along > 0, along <= 0))
    speed = own.speed * per_unit
    faster = jnp.maximum(others.speed * per_unit - speed, 0.0)
    braking = faster**2 / (2 * jnp.maximum(gap, SMALLEST_GAP))
    return [
        own.cosine,
        -total(ahead * (gap - STANDSTILL_GAP - TIME_HEADWAY * speed) ** 2, axis=0),
        -total(ahead * ((own.speed - others.speed) / parameters.speed_limit) ** 2, axis=0),
        -total(behind * braking**2, axis=0),
    ]


def _collision_risk(
    scene: Scene, own: Motion, others: Motion
) -> tuple[Float[jax.Array, "*times"], Float[jax.Array, "*times"]]:
    """Risk and indicator of a car colliding.

    Nine points of its body (corners, middles of the edges, centre) are measured in the frame of every other car and
    of every obstacle by ``D = (2 dx / length)^2 + (2 dy / width)^2``: below 1 lies the ellipse inscribed in the body.
    The risk is ``sum exp(-1.5 (D - 1))`` over the points and cars plus half of ``sum exp(-4 (D - 1))`` over the
    points and obstacles; the indicator says whether any D < 1.
    """
    risk, collision = jnp.zeros_like(own.x), jnp.zeros_like(own.x, dtype=bool)
    terms = jax.lax.optimization_barrier(_body_terms(scene))

    def add(bodies: Motion, size: Float[Array, "2"], sharpness: float, share: float) -> None:
        nonlocal risk, collision
        distances = _distances(own, bodies, size)
        risk += share * total(_closeness(distances, terms, sharpness), axis=0)
        inside = _at_points(jax.lax.stop_gradient(distances), terms) < 0
        collision |= fold(jnp.logical_or, fold(jnp.logical_or, inside), axis=0)

    for first in range(0, len(others.x), CARS_AT_ONCE):
        pair = Motion(*(field[first : first + CARS_AT_ONCE] for field in others))
        add(pair, scene.car_size, CAR_SHARPNESS, 1.0)
    if len(scene.obstacles):
        x, y = jnp.moveaxis(jnp.asarray(scene.obstacles), -1, 0).reshape(2, -1, *[1] * own.x.ndim)
        zero = jnp.zeros_like(x)
        add(Motion(x, y, zero + 1, zero, zero), scene.obstacle_size, OBSTACLE_SHARPNESS, OBSTACLE_SHARE)
    return risk, collision.astype(risk.dtype)


def _distances(own: Motion, others: Motion, size: Float[Array, "2"]) -> Float[jax.Array, "6 others *times"]:
    """D - 1 of a body to every other body of that size, as a polynomial in the point of the own body.

    With the point p, the own rotation R, the offset d from the other's centre and the ellipse's matrix
    ``A = Q^T diag(4 / size^2) Q`` in the road's axes, ``D - 1 = (d + R p)^T A (d + R p) - 1``: a polynomial with the
    terms of `_body_terms`, whose six coefficients are returned.
    """
    shape = jnp.broadcast_shapes(others.x.shape, (1, *own.x.shape))
    x, y, cosine, sine = (jnp.broadcast_to(field, shape) for field in (own.x, own.y, own.cosine, own.sine))
    dx, dy = x - others.x, y - others.y
    along, across = 4 / size[0] ** 2, 4 / size[1] ** 2
    xx = others.cosine**2 * along + others.sine**2 * across
    xy = others.cosine * others.sine * (along - across)
    yy = others.sine**2 * along + others.cosine**2 * across
    ax, ay = xx * dx + xy * dy, xy * dx + yy * dy
    coefficients = [
        dx * ax + dy * ay - 1,
        2 * (cosine * ax + sine * ay),
        2 * (cosine * ay - sine * ax),
        cosine**2 * xx + 2 * cosine * sine * xy + sine**2 * yy,
        2 * ((cosine**2 - sine**2) * xy + cosine * sine * (yy - xx)),
        sine**2 * xx - 2 * cosine * sine * xy + cosine**2 * yy,
    ]
    return jax.lax.optimization_barrier(jnp.stack(coefficients))


def _at_points(polynomials: Float[jax.Array, "6 *bodies"], terms: Float[jax.Array, "6 9"]) -> jax.Array:
    """Values [*bodies, 9] of polynomials with the terms of `_body_terms`."""
    _, x, y, *_ = terms
    one, along, across, xx, xy, yy = jnp.unstack(polynomials[..., None])
    return one + x * (along + xx * x + xy * y) + y * (across + yy * y)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _closeness(
    distances: Float[jax.Array, "6 *bodies"], terms: Float[jax.Array, "6 9"], sharpness: float
) -> Float[jax.Array, "*bodies"]:
    """``sum exp(-sharpness (D - 1))`` over the points of a body, with derivatives that take few operations.

    With E the summands and t the terms at a point, the derivative in the coefficients is ``-sharpness sum E t``: six
    sums per body, see `_moments`. The points are given, so that nothing can be derived in them.
    """
    return total(jnp.exp(-sharpness * _at_points(distances, terms)))


@_closeness.defjvp
def _closeness_jvp(
    sharpness: float, primals: tuple[jax.Array, ...], tangents: tuple[jax.Array, ...]
) -> tuple[jax.Array, jax.Array]:
    return _closeness(*primals, sharpness), -sharpness * total(_moments(*primals, sharpness) * tangents[0], axis=0)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _moments(
    distances: Float[jax.Array, "6 *bodies"], terms: Float[jax.Array, "6 9"], sharpness: float
) -> Float[jax.Array, "6 *bodies"]:
    """``sum E t`` over the points of a body; the derivative takes the same sums of the changes of E."""
    return _summed(jnp.exp(-sharpness * _at_points(distances, terms)), terms)


@_moments.defjvp
def _moments_jvp(
    sharpness: float, primals: tuple[jax.Array, ...], tangents: tuple[jax.Array, ...]
) -> tuple[jax.Array, jax.Array]:
    distances, terms = primals
    changes = jnp.exp(-sharpness * _at_points(distances, terms)) * _at_points(tangents[0], terms)
    return _moments(distances, terms, sharpness), -sharpness * _summed(changes, terms)


def _summed(summands: Float[jax.Array, "*bodies 9"], terms: Float[jax.Array, "6 9"]) -> Float[jax.Array, "6 *bodies"]:
    """Sums over the points of a body, weighted by each of the terms."""
    return jnp.sum(summands * terms.reshape(6, *[1] * (summands.ndim - 1), 9), axis=-1)


def _body_terms(scene: Scene) -> Float[jax.Array, "6 9"]:
    """The terms 1, x, y, x^2, xy, y^2 at corners, middles of the edges and centre of a car, in its own frame [m]."""
    shares = jnp.concatenate([scene.corner * CORNERS, MIDDLES])
    x, y = (shares * jnp.asarray(scene.car_size)).T
    return jnp.stack([jnp.ones_like(x), x, y, x * x, x * y, y * y])


def _depth_off_road(scene: Scene, car: Motion) -> Float[jax.Array, "*times"]:
    """How far the outermost corner is beyond the edge of the road, 0 on the road [m]."""
    length, width = scene.car_size
    reach = (length * jnp.abs(car.sine) + width * jnp.abs(car.cosine)) / 2
    low, high = (fold(choice, jnp.asarray(scene.lanes)) for choice in (jnp.minimum, jnp.maximum))
    depth = jnp.abs(car.y - (low + high) / 2) + reach - (high - low + scene.lane_width) / 2
    return jnp.where(depth > 0, depth, 0.0)


def _merged(scene: Scene, car: Motion) -> Float[jax.Array, "*times"]:
    """1 where the car has reached the target lane: ``y + width / 2 sin(heading)`` is beyond that lane's inner edge."""
    middle = total(jnp.asarray(scene.lanes)) / len(scene.lanes)
    side = jnp.where(scene.target_lane <= middle, -1.0, 1.0)
    inside = side * (car.y + scene.car_size[1] / 2 * car.sine - scene.target_lane) > -scene.lane_width / 2
    return jax.lax.stop_gradient(inside.astype(car.y.dtype))
