"""Compute the smooth reward that plans are refined by; `ms_highway.planning.road.scoring` judges what comes of it."""

from typing import NamedTuple

from jax import numpy as jnp

from ms_highway.game.road import Number, RoadScene, interpolate, rotated
from ms_highway.planning.road.arrays import Controls, EachStep, Lane, Motion, Scalar, States, Steps, Trajectories
from ms_highway.planning.road.motion import bodies, earlier
from ms_highway.planning.road.settings import CORNERING, RoadPlanning, SmoothWeights

SPEED_SCALE, LATERAL_SCALE = 5.0, 1.0  # m/s and m, from which on the cost of a deviation grows linearly
EDGE_MARGIN = 0.3  # m, between corners and edges
LENGTH_MARGIN, CLOSING_TIME, WIDTH_MARGIN = 1.5, 0.2, 0.5  # m, s, m, by which bodies are enlarged
INFLUENCE = 1.5  # times the enlarged bodies: the distance from which on collisions cost nothing
TIME_GAP, STANDSTILL_GAP, BRAKING = 1.0, 2.0, 3.0  # s, m, m/s^2
CORRIDOR = 1.2  # m, standard deviation of the lateral distance of cars ahead
SHORTFALL = 10.0  # m


class Aim(NamedTuple):
    """What a plan is refined for.

    Attributes:
        scene: the road.
        planning: limits, wishes, time step and number of steps.
        lane: number of the lane to drive on.
        weights: of the costs.
    """

    scene: RoadScene
    planning: RoadPlanning
    lane: Lane
    weights: SmoothWeights = SmoothWeights()


def motion_of(aim: Aim, states: States, controls: Controls) -> Motion:
    """Return the robot's states after each control, and its acceleration [m/s^2] and jerks [m/s^3].

    The first jerk is against the applied control.
    """
    before = earlier(aim.scene.robot[3], states[:, 3])
    change = jnp.diff(controls, axis=0, prepend=jnp.asarray(aim.scene.applied)[None]) / aim.planning.time_step
    return jnp.concatenate([states.T, jnp.stack([controls[:, 1], change[:, 1], before**2 * change[:, 0]])])


def effort_weights(weights: SmoothWeights) -> Number:
    """Return the weights of the squared efforts of a motion."""
    return jnp.stack([jnp.float32(weight) for weight in (weights.acceleration, weights.jerk, weights.jerk)])


def earned(aim: Aim, motion: Motion, others: Trajectories) -> Scalar:
    """Return the reward of a motion among predicted trajectories of all traffic."""
    return jnp.sum(-jnp.sum(residuals(aim, motion, others) ** 2, axis=0))


def residuals(aim: Aim, motion: Motion, others: Trajectories) -> Steps:
    """Return the roots of all costs at each step, those of efforts last, for Gauss-Newton steps [costs, steps]."""
    scene, planning, weights = aim.scene, aim.planning, aim.weights
    s, d, heading, speed = motion[:4]
    curvature = jnp.abs(jnp.asarray(scene.route.curvature))
    in_curves = jnp.sqrt(CORNERING * planning.grip / jnp.maximum(curvature, 1e-4))
    fastest = jnp.minimum(jnp.minimum(in_curves, scene.speed_limit), planning.desired_speed)
    beyond = speed - interpolate(fastest, s)
    aside = d - interpolate(jnp.asarray(scene.lanes)[aim.lane], s)
    own = [
        (weights.speed, _flattened(beyond, SPEED_SCALE)),
        (weights.excess, jnp.maximum(beyond, 0.0)),
        (weights.lateral, _flattened(aside, LATERAL_SCALE)),
        (weights.heading, heading),
        *((weights.edges, intrusion) for intrusion in _off_road(scene, s, d, heading)),
    ]
    near = zip((weights.collision, weights.following), _nearness(scene, motion[:4].T, others), strict=True)
    present = jnp.asarray(scene.present)[:, None]
    roots = [
        *(jnp.sqrt(weight) * root[None] for weight, root in own),
        *(jnp.sqrt(weight) * jnp.where(present, root, 0.0) for weight, root in near),
        jnp.sqrt(effort_weights(weights))[:, None] * motion[4:],
    ]
    return jnp.sqrt(planning.time_step) * jnp.concatenate(roots)


def _flattened(deviation: Steps, scale: float) -> Steps:
    """Return the root of a cost that is square up to a scale of deviations, and linear beyond (pseudo-Huber)."""
    return deviation * jnp.sqrt(2 / (1 + jnp.sqrt(1 + (deviation / scale) ** 2)))


def _off_road(scene: RoadScene, s: Steps, d: Steps, heading: Steps) -> list[Steps]:
    """Return the roots of what the corners' intrusions on the margins of the edges cost, in shares of the margin."""
    length, width = scene.size
    bend, half, roots = interpolate(scene.route.curvature, s), width / 2 * jnp.cos(heading), []
    for ahead in (0.0, length):  # of the rear axle
        left, right = interpolate(scene.edges, s + ahead)
        middle = d + ahead * jnp.sin(heading) - bend * ahead**2 / 2
        for room in (middle - half - left, right - middle - half):
            roots.append(_flattened(jnp.maximum(1 - room / EDGE_MARGIN, 0.0), 1.0))
    return roots


def _nearness(scene: RoadScene, states: States, others: Trajectories) -> tuple[EachStep, EachStep]:
    """Return the depth in the surroundings of each other car, and the lack of distance to it if it is ahead.

    The surroundings are superellipses of degree 4 in the frame of the other car. The corridor ahead bends as the road
    does where the robot is.
    """
    x, y, heading = bodies(scene, states)
    other_x, other_y, other_heading, other_speed = jnp.moveaxis(others, 1, 0)
    speed, turned, sizes = states[:, 3], heading - other_heading, jnp.asarray(scene.sizes)[..., None]

    (length, width), (other_length, other_width) = scene.size, jnp.moveaxis(sizes, 1, 0)
    aligned, across = (jnp.sqrt(f(turned) ** 2 + 1e-4) for f in (jnp.cos, jnp.sin))
    closing = jnp.sqrt((speed * jnp.cos(turned) - other_speed) ** 2 + 1e-2)
    half_length = (aligned * length + across * width + other_length) / 2 + LENGTH_MARGIN + CLOSING_TIME * closing
    half_width = (across * length + aligned * width + other_width) / 2 + WIDTH_MARGIN
    ahead, aside = rotated(x - other_x, y - other_y, other_heading)
    distance = ((ahead / half_length) ** 4 + (aside / half_width) ** 4 + 1e-6) ** 0.25

    ahead, aside = rotated(other_x - x, other_y - y, heading - states[:, 2])
    aside = aside - interpolate(scene.route.curvature, states[:, 0]) * ahead**2 / 2
    onward = jnp.maximum(jnp.cos(other_heading - heading), 0.0)
    inside = jnp.exp(-((aside / CORRIDOR) ** 2) / 4) * onward
    gap = ahead - jnp.asarray(scene.reach)[:, :1]
    closing = jnp.maximum(speed - other_speed * onward, 0.0)
    wanted = STANDSTILL_GAP + TIME_GAP * speed + closing**2 / (2 * BRAKING)
    lack = jnp.maximum(wanted - gap, 0.0) / SHORTFALL
    return jnp.maximum(INFLUENCE - distance, 0.0), jnp.where(ahead > 0, inside * lack, 0.0)
