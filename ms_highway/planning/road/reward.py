"""Compute the smooth reward that plans are refined by; `ms_highway.planning.road.scoring` judges what comes of it."""

from dataclasses import dataclass

import jax
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.road import RoadScene, interpolate
from ms_highway.planning.road.motion import bodies
from ms_highway.planning.road.settings import CORNERING, RoadPlanning
from ms_highway.runtime.arrays import Array

__all__ = ["RoadReward", "efforts", "residuals", "reward_along", "stage_rewards"]

SPEED_SCALE, LATERAL_SCALE = 5.0, 1.0  # m/s and m, from which on the cost of a deviation grows linearly
EDGE_MARGIN = 0.3  # m, between corners and edges
LENGTH_MARGIN, CLOSING_TIME, WIDTH_MARGIN = 1.5, 0.2, 0.5  # m, s, m, by which bodies are enlarged
INFLUENCE = 1.5  # times the enlarged bodies: the distance from which on collisions cost nothing
TIME_GAP, STANDSTILL_GAP, BRAKING = 1.0, 2.0, 3.0  # s, m, m/s^2
CORRIDOR = 1.2  # m, standard deviation of the lateral distance of cars ahead
SHORTFALL = 10.0  # m

Scalar = float | Float[Array, ""]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RoadReward:
    """Weights of the costs of the robot's motion, all per second.

    Attributes:
        speed: of a deviation from the speed wished for [s^2/m^2]; linear beyond 5 m/s.
        excess: of its square above that speed, in addition [s^2/m^2].
        lateral: of the distance to the lane's centre [1/m^2]; linear beyond 1 m.
        heading: of the squared angle to the route [1/rad^2].
        acceleration: of its square [s^4/m^2].
        jerk: of its square, along and across [s^6/m^2].
        edges: of each corner's squared intrusion on the 0.3 m beside the road's edge [1/(0.3 m)^2]; linear beyond.
        collision: of the squared depth in another car's surroundings, 1/4 at 1.5 m along or 0.5 m aside of it.
        following: of the squared lack of distance to cars ahead [1/(10 m)^2]: of 2 m, 1 s, and what it takes to brake
            to their speed by 3 m/s^2.
    """

    speed: Scalar = 0.1
    excess: Scalar = 0.4
    lateral: Scalar = 1.0
    heading: Scalar = 10.0
    acceleration: Scalar = 0.02
    jerk: Scalar = 0.01
    edges: Scalar = 50.0
    collision: Scalar = 100.0
    following: Scalar = 10.0

    @property
    def of_efforts(self) -> Float[jax.Array, "3"]:
        """Weights of the squared `efforts`."""
        return jnp.stack([jnp.float32(weight) for weight in (self.acceleration, self.jerk, self.jerk)])


def stage_rewards(
    scene: RoadScene,
    planning: RoadPlanning,
    weights: RoadReward,
    states: Float[jax.Array, "steps 4"],
    controls: Float[jax.Array, "steps 2"],
    others: Float[jax.Array, "traffic 4 steps"],
    lane: int | Int[jax.Array, ""],
) -> Float[jax.Array, "steps"]:
    """Compute the robot's reward after each step of a plan.

    Args:
        scene: the road.
        planning: wishes and time step.
        weights: of the costs.
        states: of the robot after each control.
        controls: that it executes, see `ms_highway.planning.road.motion.drive`.
        others: predicted x, y, heading and speed of all traffic after each step, world coordinates.
        lane: number of the lane to drive on, see `ms_highway.game.road.RoadScene`.
    """
    motion = jnp.concatenate([states.T, efforts(scene, planning, states, controls)])
    return reward_along(scene, planning, weights, motion, others, lane)


def efforts(
    scene: RoadScene,
    planning: RoadPlanning,
    states: Float[jax.Array, "steps 4"],
    controls: Float[jax.Array, "steps 2"],
) -> Float[jax.Array, "3 steps"]:
    """Return the acceleration [m/s^2], and jerk along and across [m/s^3], the first against the applied control."""
    before = jnp.concatenate([jnp.asarray(scene.robot)[None, 3], states[:-1, 3]])
    change = jnp.diff(controls, axis=0, prepend=jnp.asarray(scene.applied)[None]) / planning.time_step
    return jnp.stack([controls[:, 1], change[:, 1], before**2 * change[:, 0]])


def reward_along(
    scene: RoadScene,
    planning: RoadPlanning,
    weights: RoadReward,
    motion: Float[jax.Array, "7 steps"],
    others: Float[jax.Array, "traffic 4 steps"],
    lane: int | Int[jax.Array, ""],
) -> Float[jax.Array, "steps"]:
    """Compute the reward after each step of a motion: the robot's state and its `efforts`, see `stage_rewards`."""
    return -jnp.sum(residuals(scene, planning, weights, motion, others, lane) ** 2, axis=0)


def residuals(
    scene: RoadScene,
    planning: RoadPlanning,
    weights: RoadReward,
    motion: Float[jax.Array, "7 steps"],
    others: Float[jax.Array, "traffic 4 steps"],
    lane: int | Int[jax.Array, ""],
) -> Float[jax.Array, "costs steps"]:
    """Return the roots of all costs at each step, those of `efforts` last, for Gauss-Newton steps."""
    s, d, heading, speed = motion[:4]
    wish, bend = _wished_speed(planning, scene, s), interpolate(scene.route.curvature, s)
    aside = d - interpolate(jnp.asarray(scene.lanes)[lane], s)
    own = [
        (weights.speed, _flattened(speed - wish, SPEED_SCALE)),
        (weights.excess, jnp.maximum(speed - wish, 0.0)),
        (weights.lateral, _flattened(aside, LATERAL_SCALE)),
        (weights.heading, heading),
        *((weights.edges, intrusion) for intrusion in _off_road(scene, s, d, heading, bend)),
    ]
    states = jnp.stack([s, d, heading, speed], axis=-1)
    near = [(weights.collision, _closeness), (weights.following, _crowding)]
    present = jnp.asarray(scene.present)[:, None]
    roots = [
        *(jnp.sqrt(weight) * root[None] for weight, root in own),
        *(jnp.sqrt(weight) * jnp.where(present, root(scene, states, others), 0.0) for weight, root in near),
        jnp.sqrt(weights.of_efforts)[:, None] * motion[4:],
    ]
    return jnp.sqrt(planning.time_step) * jnp.concatenate(roots)


def _flattened(deviation: Float[jax.Array, "steps"], scale: float) -> Float[jax.Array, "steps"]:
    """Return the root of a cost that is square up to a scale of deviations, and linear beyond (pseudo-Huber)."""
    return deviation * jnp.sqrt(2 / (1 + jnp.sqrt(1 + (deviation / scale) ** 2)))


def _wished_speed(planning: RoadPlanning, scene: RoadScene, s: Float[jax.Array, "steps"]) -> Float[jax.Array, "steps"]:
    """Return the desired speed, within the road's limit and what its curve allows."""
    curvature = jnp.abs(jnp.asarray(scene.route.curvature))
    in_curves = jnp.sqrt(CORNERING * planning.grip / jnp.maximum(curvature, 1e-4))
    fastest = jnp.minimum(jnp.minimum(in_curves, scene.speed_limit), planning.desired_speed)
    return interpolate(fastest, s)


def _off_road(
    scene: RoadScene,
    s: Float[jax.Array, "steps"],
    d: Float[jax.Array, "steps"],
    heading: Float[jax.Array, "steps"],
    bend: Float[jax.Array, "steps"],
) -> list[Float[jax.Array, "steps"]]:
    """Return the roots of what the corners' intrusions on the margins of the edges cost, in shares of the margin."""
    length, width = jnp.asarray(scene.size)
    left, right = jnp.asarray(scene.edges)
    roots = []
    for ahead in (0.0, length):  # of the rear axle
        middle = d + ahead * jnp.sin(heading) - bend * ahead**2 / 2
        half = width / 2 * jnp.cos(heading)
        for room in (middle - half - interpolate(left, s + ahead), interpolate(right, s + ahead) - middle - half):
            roots.append(_flattened(jnp.maximum(1 - room / EDGE_MARGIN, 0.0), 1.0))
    return roots


def _closeness(
    scene: RoadScene, states: Float[jax.Array, "steps 4"], others: Float[jax.Array, "traffic 4 steps"]
) -> Float[jax.Array, "traffic steps"]:
    """Return the depth in the surroundings of each other car, superellipses of degree 4 in its frame."""
    x, y, heading = bodies(scene, states)
    other_x, other_y, other_heading, other_speed = jnp.moveaxis(others, 1, 0)
    dx, dy, turned = x - other_x, y - other_y, heading - other_heading
    cosine, sine = jnp.cos(other_heading), jnp.sin(other_heading)
    own_length, own_width = jnp.asarray(scene.size)
    length, width = jnp.asarray(scene.sizes).T[..., None]
    aligned, across = (jnp.sqrt(f(turned) ** 2 + 1e-4) for f in (jnp.cos, jnp.sin))
    closing = jnp.sqrt((states[:, 3] * jnp.cos(turned) - other_speed) ** 2 + 1e-2)
    half_length = (aligned * own_length + across * own_width + length) / 2 + LENGTH_MARGIN + CLOSING_TIME * closing
    half_width = (across * own_length + aligned * own_width + width) / 2 + WIDTH_MARGIN
    ahead, aside = (dx * cosine + dy * sine) / half_length, (dy * cosine - dx * sine) / half_width
    distance = (ahead**4 + aside**4 + 1e-6) ** 0.25
    return jnp.maximum(INFLUENCE - distance, 0.0)


def _crowding(
    scene: RoadScene, states: Float[jax.Array, "steps 4"], others: Float[jax.Array, "traffic 4 steps"]
) -> Float[jax.Array, "traffic steps"]:
    """Return the lack of distance to cars ahead; the corridor bends as the road does where the robot is."""
    x, y, heading = bodies(scene, states)
    other_x, other_y, other_heading, other_speed = jnp.moveaxis(others, 1, 0)
    along = heading - states[:, 2]
    cosine, sine = jnp.cos(along), jnp.sin(along)
    dx, dy = other_x - x, other_y - y
    ahead, aside = dx * cosine + dy * sine, dy * cosine - dx * sine
    aside = aside - interpolate(scene.route.curvature, states[:, 0]) * ahead**2 / 2
    onward = jnp.maximum(jnp.cos(other_heading - heading), 0.0)
    inside = jnp.exp(-((aside / CORRIDOR) ** 2) / 4) * onward
    gap = ahead - (scene.size[0] + jnp.asarray(scene.sizes)[:, :1]) / 2
    closing = jnp.maximum(states[:, 3] - other_speed * onward, 0.0)
    wanted = STANDSTILL_GAP + TIME_GAP * states[:, 3] + closing**2 / (2 * BRAKING)
    lack = jnp.maximum(wanted - gap, 0.0) / SHORTFALL
    return jnp.where(ahead > 0, inside * lack, 0.0)
