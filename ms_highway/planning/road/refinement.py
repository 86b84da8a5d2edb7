"""Refine the robot's controls on a road by damped Newton steps, among cars that keep to predictions or answer.

Car i under theory of mind answers the robot's plan with accelerations u_i: ``J_i = -H_i^-1 d2R_i / du_i du_R``, and the
robot climbs along ``dR_R/du_R + sum_i J_i^T dR_R/du_i``, as in `ms_highway.planning.climb`. Its reward is smooth;
`ms_highway.planning.road.scoring` judges what comes of it.
"""

from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.game.road import Flags, Places, RoadScene, interpolate, rotated
from ms_highway.optimization.damped_newton import SHARES, damped_factor, damped_solve
from ms_highway.optimization.objective import best_of
from ms_highway.optimization.second_derivatives import by_fields
from ms_highway.planning.road.answers import UNIT, commuter_among, commuter_of
from ms_highway.planning.road.arrays import EachStep, Lane, Steps, World
from ms_highway.planning.road.motion import advance, bodies, centres, earlier, execute
from ms_highway.planning.road.settings import CORNERING, RoadPlanning, SmoothWeights
from ms_highway.runtime.arrays import Control, Controls, Matrix, Numbers, Scalar, Trajectory, Vector, for_each

STEPS = 4  # of Newton
SLOWEST = 5.0  # m/s, below which curvature is scaled as at this speed
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
        tom: which of the others answer the robot's plan.
        weights: of the costs.
    """

    scene: RoadScene
    planning: RoadPlanning
    lane: Lane
    tom: Flags
    weights: SmoothWeights = SmoothWeights()

    @property
    def effort_weights(self) -> Vector:
        """Weights of the squared efforts of a motion."""
        weights = self.weights
        return jnp.stack([jnp.float32(weight) for weight in (weights.acceleration, weights.jerk, weights.jerk)])


class Answered(NamedTuple):
    """The robot's controls, the scaled accelerations of those who answer, and the trajectories of all others."""

    controls: Controls
    accelerations: EachStep
    others: World


class Answers(NamedTuple):
    """What is known of those who answer.

    Attributes:
        slope: of the robot's reward through them, in its trajectory.
        factors: of their damped Hessians [traffic, steps, steps].
        influences: of the robot, see `ms_highway.planning.road.answers.Commuter.influence` [traffic, 4, 2, steps].
        accelerations: improved, scaled.
    """

    slope: World
    factors: Numbers
    influences: Numbers
    accelerations: EachStep


def refine(aim: Aim, start: Controls, others: World, accelerations: EachStep) -> Controls:
    """Improve the robot's controls by damped Newton steps on `earned`.

    The time is additive in the cars that answer; without them, no step earns less than the one before.

    Args:
        aim: of the plan.
        start: curvatures and accelerations to improve.
        others: predicted trajectories of all traffic, world coordinates.
        accelerations: with which those who answer do so at the start, scaled.
    """
    first = answered(aim, execute(aim.scene, aim.planning, start)[1], others, accelerations)
    return jax.lax.fori_loop(0, STEPS, lambda _, plan: _improved(aim, plan), first).controls


def answered(aim: Aim, controls: Controls, others: World, accelerations: EachStep) -> Answered:
    """Return a plan with the trajectories of those who answer in place of their predictions."""

    def put(i: Places, others: World) -> World:
        return others.at[i].set(commuter_of(aim.scene, aim.planning, i).drive(accelerations[i]))

    return Answered(controls, accelerations, for_each(aim.tom, put, others))


def scale_of(aim: Aim) -> Control:
    """Return the unit of the controls that are optimised: accelerations across and along of 5 m/s^2."""
    return jnp.stack([UNIT / jnp.maximum(aim.scene.robot[3], SLOWEST) ** 2, jnp.float32(UNIT)])


def surroundings(aim: Aim, plan: Answered) -> tuple[Vector, Matrix, Numbers, Answers]:
    """Expand the reward around a plan, in n scaled controls of the robot.

    Returns:
        The gradient, through those who answer, too; the Hessian of the robot's own part; the derivative of the
        trajectory of the robot's centre [4, steps, n]; and the answers.
    """
    (controls, accelerations, others), scale = plan, scale_of(aim)

    def path(scaled: Vector) -> Trajectory:
        return motion_of(aim, scaled.reshape(-1, 2) * scale)

    point = (controls / scale).ravel()
    motion, along = path(point), jax.jacfwd(path)(point)
    by_motion, by_others = jax.grad(earned, argnums=(1, 2))(aim, motion, others)
    robot, onto_world = jax.linearize(lambda motion: centres(aim.scene, motion[:4].T), motion)
    world = jax.vmap(onto_world, -1, -1)(along)

    def answer(i: Places, answers: Answers) -> Answers:
        human, scaled = commuter_among(aim.scene, aim.planning, i, robot, others), accelerations[i]
        (gradient, hessian), influence = human.expand(scaled), human.influence(scaled, robot)
        factor = damped_factor(hessian)
        _, back = jax.vjp(human.place, human.move(scaled))
        pushed = damped_solve(factor, human.pull(back(by_others[i])[0]))
        return Answers(
            answers.slope + jnp.sum(influence * human.push(pushed), axis=1),
            answers.factors.at[i].set(factor),
            answers.influences.at[i].set(influence),
            answers.accelerations.at[i].set(human.toward(scaled, damped_solve(factor, gradient))),
        )

    cars, fields, steps = others.shape
    shapes = (fields, steps), (cars, steps, steps), (cars, fields, 2, steps)
    answers = for_each(aim.tom, answer, Answers(*(*map(jnp.zeros, shapes), accelerations)))
    gradient = jnp.tensordot(by_motion, along, 2) + jnp.tensordot(answers.slope, world, 2)
    return gradient, _hessian(aim, motion, others, along), world, answers


def _hessian(aim: Aim, motion: Trajectory, others: World, along: Numbers) -> Matrix:
    """Return the Hessian of Gauss-Newton: motion and `residuals` count as linear, so that no eigenvalue is positive."""

    def roots(states: Trajectory) -> Steps:
        return residuals(aim, jnp.concatenate([states, motion[4:]]), others)[:-3]

    slopes = by_fields(roots, motion[:4])
    bent = jnp.einsum("dck,eck,ekn->dkn", slopes, slopes, along[:4])
    weights = aim.planning.time_step * aim.effort_weights
    bent = jnp.concatenate([bent, weights[:, None, None] * along[4:]])
    return -2 * jnp.tensordot(along, bent, ((0, 1), (0, 1)))


def _improved(aim: Aim, plan: Answered) -> Answered:
    """Take the share of a Newton step that earns most once those who answer have answered it."""
    gradient, hessian, world, answers = surroundings(aim, plan)
    step = damped_solve(damped_factor(hessian), gradient)
    moved = world @ step

    def react(i: Places, reactions: EachStep) -> EachStep:
        slopes = jnp.sum(answers.influences[i] * moved[:, None], axis=0)
        pulled = commuter_of(aim.scene, aim.planning, i).pull(slopes)
        return reactions.at[i].set(damped_solve(answers.factors[i], pulled))

    reactions = for_each(aim.tom, react, jnp.zeros_like(plan.accelerations))

    def after(share: Scalar) -> tuple[Answered, Scalar]:
        controls = plan.controls + share * step.reshape(-1, 2) * scale_of(aim)
        _, controls = execute(aim.scene, aim.planning, controls)
        tried = answered(aim, controls, plan.others, answers.accelerations + share * reactions)
        return tried, earned(aim, motion_of(aim, controls), tried.others)

    candidates, rewards = jax.vmap(after)(jnp.asarray(SHARES))
    return jax.tree.map(lambda tried: best_of(tried, rewards), candidates)


def motion_of(aim: Aim, controls: Controls) -> Trajectory:
    """Return the robot's states and efforts [7, steps]; controls are taken as they are, so that none is flat.

    Efforts are acceleration [m/s^2], and jerk along and across [m/s^3], the first against the applied control.
    """
    scene, planning = aim.scene, aim.planning
    _, states = jax.lax.scan(lambda state, u: (advance(scene, planning, state, u),) * 2, scene.robot, controls)
    before = earlier(scene.robot[3], states[:, 3])
    change = jnp.diff(controls, axis=0, prepend=scene.applied[None]) / planning.time_step
    return jnp.stack([*states.T, controls[:, 1], change[:, 1], before**2 * change[:, 0]])


def earned(aim: Aim, motion: Trajectory, others: World) -> Scalar:
    """Return the reward of a motion among predicted trajectories of all traffic."""
    return jnp.sum(-jnp.sum(residuals(aim, motion, others) ** 2, axis=0))


def residuals(aim: Aim, motion: Trajectory, others: World) -> Steps:
    """Return the roots of all costs at each step, those of efforts last, for Gauss-Newton steps [costs, steps]."""
    scene, planning, weights = aim.scene, aim.planning, aim.weights
    s, d, heading, speed = motion[:4]
    in_curves = jnp.sqrt(CORNERING * planning.grip / jnp.maximum(jnp.abs(scene.route.curvature), 1e-4))
    fastest = jnp.minimum(jnp.minimum(in_curves, scene.speed_limit), planning.desired_speed)
    beyond, aside = speed - interpolate(fastest, s), d - interpolate(scene.lanes[aim.lane], s)
    closeness, crowding = (jnp.where(scene.present[:, None], root, 0.0) for root in _nearness(aim, motion, others))
    costs = [
        (weights.speed, _flattened(beyond, SPEED_SCALE)[None]),
        (weights.excess, jnp.maximum(beyond, 0.0)[None]),
        (weights.lateral, _flattened(aside, LATERAL_SCALE)[None]),
        (weights.heading, heading[None]),
        (weights.edges, _off_road(scene, s, d, heading)),
        (weights.collision, closeness),
        (weights.following, crowding),
        (aim.effort_weights[:, None], motion[4:]),
    ]
    return jnp.sqrt(planning.time_step) * jnp.concatenate([jnp.sqrt(weight) * root for weight, root in costs])


def _flattened(deviation: Steps, scale: float) -> Steps:
    """Return the root of a cost that is square up to a scale of deviations, and linear beyond (pseudo-Huber)."""
    return deviation * jnp.sqrt(2 / (1 + jnp.sqrt(1 + (deviation / scale) ** 2)))


def _off_road(scene: RoadScene, s: Steps, d: Steps, heading: Steps) -> Steps:
    """Return the roots of what the corners' intrusions on the margins of the edges cost, in shares of the margin."""
    bend, half, rooms = interpolate(scene.route.curvature, s), scene.size[1] / 2 * jnp.cos(heading), []
    for ahead in (0.0, scene.size[0]):  # of the rear axle
        left, right = interpolate(scene.edges, s + ahead)
        middle = d + ahead * jnp.sin(heading) - bend * ahead**2 / 2
        rooms += [middle - half - left, right - middle - half]
    return _flattened(jnp.maximum(1 - jnp.stack(rooms) / EDGE_MARGIN, 0.0), 1.0)


def _nearness(aim: Aim, motion: Trajectory, others: World) -> tuple[EachStep, EachStep]:
    """Return the depth in the surroundings of each other car, and the lack of distance to it if it is ahead.

    The surroundings are superellipses of degree 4 in the frame of the other car. The corridor ahead bends as the road
    does where the robot is.
    """
    scene, speed = aim.scene, motion[3]
    x, y, heading = bodies(scene, motion[:4].T)
    other_x, other_y, other_heading, other_speed = jnp.moveaxis(others, 1, 0)
    turned, (length, width), (lengths, widths) = heading - other_heading, scene.size, scene.sizes.T[..., None]
    aligned, across = (jnp.sqrt(f(turned) ** 2 + 1e-4) for f in (jnp.cos, jnp.sin))
    closing = jnp.sqrt((speed * jnp.cos(turned) - other_speed) ** 2 + 1e-2)
    half_length = (aligned * length + across * width + lengths) / 2 + LENGTH_MARGIN + CLOSING_TIME * closing
    half_width = (across * length + aligned * width + widths) / 2 + WIDTH_MARGIN
    ahead, aside = rotated(x - other_x, y - other_y, other_heading)
    distance = ((ahead / half_length) ** 4 + (aside / half_width) ** 4 + 1e-6) ** 0.25

    ahead, aside = rotated(other_x - x, other_y - y, heading - motion[2])
    aside = aside - interpolate(scene.route.curvature, motion[0]) * ahead**2 / 2
    onward = jnp.maximum(jnp.cos(turned), 0.0)
    inside = jnp.exp(-((aside / CORRIDOR) ** 2) / 4) * onward
    closing = jnp.maximum(speed - other_speed * onward, 0.0)
    wanted = STANDSTILL_GAP + TIME_GAP * speed + closing**2 / (2 * BRAKING)
    lack = jnp.maximum(wanted - ahead + scene.reach[:, :1], 0.0) / SHORTFALL
    return jnp.maximum(INFLUENCE - distance, 0.0), jnp.where(ahead > 0, inside * lack, 0.0)
