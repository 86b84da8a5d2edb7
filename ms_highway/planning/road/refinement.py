"""Refine the robot's controls on a road by damped Newton steps, among cars that keep to predictions or answer.

Car i under theory of mind answers the robot's plan with accelerations u_i: ``J_i = -H_i^-1 d2R_i / du_i du_R``, and the
robot climbs along ``dR_R/du_R + sum_i J_i^T dR_R/du_i``, as in `ms_highway.planning.crowd`.
"""

from functools import partial
from typing import NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.game.road import RoadScene
from ms_highway.optimization.damped_newton import SHARES, best_of, damped_factor, damped_solve
from ms_highway.optimization.second_derivatives import Trajectory
from ms_highway.planning.road.answers import UNIT, World, along_path, driver_of, follow, onward, pull, push
from ms_highway.planning.road.motion import advance, bodies, drive
from ms_highway.planning.road.reward import RoadReward, efforts, residuals, reward_along
from ms_highway.planning.road.settings import RoadPlanning

__all__ = ["refine", "total_slope"]

STEPS = 4  # of Newton
SLOWEST = 5.0  # m/s, below which curvature is scaled as at this speed
REWARD = RoadReward()

Controls = Float[jax.Array, "steps 2"]
Traffic = Float[jax.Array, "traffic 4 steps"]


def refine(
    scene: RoadScene,
    planning: RoadPlanning,
    start: Controls,
    others: Traffic,
    tom: Bool[jax.Array, "traffic"],
    accelerations: Float[jax.Array, "traffic steps"],
    lane: int | Int[jax.Array, ""],
    weights: RoadReward = REWARD,
) -> Controls:
    """Improve the robot's controls by damped Newton steps on `ms_highway.planning.road.reward.stage_rewards`.

    The time is additive in the cars that answer; without them, no step earns less than the one before.

    Args:
        scene: the road.
        planning: limits, wishes, time step and number of steps.
        start: curvatures and accelerations to improve.
        others: predicted trajectories of all traffic, world coordinates.
        tom: which of them answer the robot's plan.
        accelerations: with which these answer the start [m/s^2].
        lane: number of the lane to drive on.
        weights: of the reward.
    """
    climb, first = _begin(scene, planning, start, others, tom, accelerations, lane, weights)
    first = first._replace(controls=drive(scene, planning, first.controls)[1])
    return jax.lax.fori_loop(0, STEPS, lambda _, plan: _improve(climb, plan), first).controls


def total_slope(
    scene: RoadScene,
    planning: RoadPlanning,
    controls: Controls,
    others: Traffic,
    tom: Bool[jax.Array, "traffic"],
    accelerations: Float[jax.Array, "traffic steps"],
    lane: int | Int[jax.Array, ""],
    weights: RoadReward = REWARD,
) -> Controls:
    """Return the derivative of the robot's reward in its controls, the answers of others included; see `refine`."""
    climb, plan = _begin(scene, planning, controls, others, tom, accelerations, lane, weights)
    return _local(climb, plan).gradient.reshape(-1, 2) / climb.scale


def _begin(
    scene: RoadScene,
    planning: RoadPlanning,
    controls: Controls,
    others: Traffic,
    tom: Bool[jax.Array, "traffic"],
    accelerations: Float[jax.Array, "traffic steps"],
    lane: int | Int[jax.Array, ""],
    weights: RoadReward,
) -> tuple["_Climb", "_Plan"]:
    """Return what all steps share, and the plan to improve."""
    climb = _Climb(scene, planning, weights, lane, jnp.argsort(~tom, stable=True), jnp.sum(tom))
    accelerations = jnp.asarray(accelerations)
    return climb, _Plan(jnp.asarray(controls), accelerations, climb.answered(jnp.asarray(others), accelerations))


class _Plan(NamedTuple):
    """The robot's controls, the accelerations of those who answer, and the trajectories of all others."""

    controls: Controls
    accelerations: Float[jax.Array, "traffic steps"]
    others: Traffic


class _Climb(NamedTuple):
    """What all steps share; the first ``responding`` of the ranked cars answer."""

    scene: RoadScene
    planning: RoadPlanning
    weights: RoadReward
    lane: int | Int[jax.Array, ""]
    ranks: Int[jax.Array, "traffic"]
    responding: Int[jax.Array, ""]

    @property
    def scale(self) -> Float[jax.Array, "2"]:
        """Unit of the controls that are optimised: accelerations across and along of 5 m/s^2."""
        return jnp.stack([UNIT / jnp.maximum(jnp.asarray(self.scene.robot)[3], SLOWEST) ** 2, jnp.float32(UNIT)])

    def motion(self, controls: Controls) -> Trajectory:
        """Return the robot's states and efforts [7, steps]; controls are taken as they are, so that none is flat."""

        def go(state: Float[jax.Array, "4"], control: Float[jax.Array, "2"]) -> tuple[jax.Array, jax.Array]:
            moved = advance(self.scene, self.planning, state, control)
            return moved, moved

        states = jax.lax.scan(go, jnp.asarray(self.scene.robot), controls)[1]
        return jnp.concatenate([states.T, efforts(self.scene, self.planning, states, controls)])

    def earned(self, motion: Trajectory, others: Traffic) -> Float[jax.Array, ""]:
        return jnp.sum(reward_along(self.scene, self.planning, self.weights, motion, others, self.lane))

    def world(self, motion: Trajectory) -> World:
        """Return the trajectory of the robot's centre."""
        return jnp.stack([*bodies(self.scene, motion[:4].T), motion[3]])

    def answered(self, others: Traffic, accelerations: Float[jax.Array, "traffic steps"]) -> Traffic:
        """Replace the trajectories of those who answer."""

        def put(place: Int[jax.Array, ""], others: Traffic) -> Traffic:
            i = self.ranks[place]
            return others.at[i].set(follow(self.scene, self.planning, i, accelerations[i]))

        return jax.lax.fori_loop(0, self.responding, put, others)


class _Answers(NamedTuple):
    """What the loop over the cars that answer collects."""

    slope: World  # of the robot's reward through them, in its trajectory
    factors: Float[jax.Array, "traffic n n"]  # of the damped Hessians
    influences: Float[jax.Array, "traffic 4 2 steps"]  # of the robot, see `Driver.influence`
    accelerations: Float[jax.Array, "traffic steps"]  # improved


class _Local(NamedTuple):
    """The reward around a plan, in n scaled controls of the robot."""

    gradient: Float[jax.Array, "n"]
    hessian: Float[jax.Array, "n n"]
    world: Float[jax.Array, "4 steps n"]  # derivative of the trajectory of the robot's centre
    answers: _Answers


def _local(climb: _Climb, plan: _Plan) -> _Local:
    """Expand the reward around a plan: the gradient through those who answer, the Hessian of the robot's own part."""
    scale, (cars, _, steps) = climb.scale, plan.others.shape

    def path(scaled: Float[jax.Array, "n"]) -> Trajectory:
        return climb.motion(scaled.reshape(-1, 2) * scale)

    point = (plan.controls / scale).ravel()
    motion, along = path(point), jax.jacfwd(path)(point)
    by_motion, by_others, hessian = _expansion(climb, motion, plan.others, along)
    gradient = jnp.tensordot(by_motion, along, 2)
    robot, onto_world = jax.linearize(climb.world, motion)
    world = jax.vmap(onto_world, -1, -1)(along)

    def answer(place: Int[jax.Array, ""], answers: _Answers) -> _Answers:
        i = climb.ranks[place]
        driver, scaled = driver_of(climb.scene, climb.planning, i, robot, plan.others), plan.accelerations[i] / UNIT
        own = driver.expand(scaled)
        factor = damped_factor(own.hessian)
        influence = driver.influence(scaled, partial(along_path, climb.scene, i), robot)
        _, back = jax.vjp(partial(onward, climb.scene, climb.planning, i), driver.move(scaled))
        pushed = damped_solve(factor, pull(climb.planning, back(by_others[i])[0]))
        improved = driver.toward(scaled, damped_solve(factor, own.gradient)) * UNIT
        return _Answers(
            answers.slope + jnp.sum(influence * push(climb.planning, pushed), axis=1),
            answers.factors.at[i].set(factor),
            answers.influences.at[i].set(influence),
            answers.accelerations.at[i].set(improved),
        )

    none = _Answers(
        jnp.zeros_like(robot),
        jnp.zeros((cars, steps, steps)),
        jnp.zeros((cars, 4, 2, steps)),
        plan.accelerations,
    )
    answers = jax.lax.fori_loop(0, climb.responding, answer, none)
    return _Local(gradient + jnp.tensordot(answers.slope, world, 2), hessian, world, answers)


def _improve(climb: _Climb, plan: _Plan) -> _Plan:
    """Take the share of a Newton step that earns most once those who answer have answered it."""
    local = _local(climb, plan)
    answers, step = local.answers, damped_solve(damped_factor(local.hessian), local.gradient)
    moved = local.world @ step

    def react(place: Int[jax.Array, ""], reactions: Float[jax.Array, "traffic steps"]) -> jax.Array:
        i = climb.ranks[place]
        slopes = jnp.sum(answers.influences[i] * moved[:, None], axis=0)
        return reactions.at[i].set(UNIT * damped_solve(answers.factors[i], pull(climb.planning, slopes)))

    reactions = jax.lax.fori_loop(0, climb.responding, react, jnp.zeros_like(plan.accelerations))

    def after(share: Float[jax.Array, ""]) -> tuple[_Plan, Float[jax.Array, ""]]:
        _, controls = drive(climb.scene, climb.planning, plan.controls + share * step.reshape(-1, 2) * climb.scale)
        accelerations = answers.accelerations + share * reactions
        others = climb.answered(plan.others, accelerations)
        return _Plan(controls, accelerations, others), climb.earned(climb.motion(controls), others)

    candidates, earned = jax.vmap(after)(jnp.asarray(SHARES))
    return jax.tree.map(lambda tried: best_of(tried, earned), candidates)


def _expansion(
    climb: _Climb, motion: Trajectory, others: Traffic, along: Float[jax.Array, "fields steps n"]
) -> tuple[Trajectory, Traffic, Float[jax.Array, "n n"]]:
    """Return the reward's derivatives in the robot's motion and in those of others, and its Hessian in n controls.

    The Hessian is that of Gauss-Newton: motion and `residuals` count as linear, so that it has no positive eigenvalue.
    """
    by_motion, by_others = jax.grad(climb.earned, argnums=(0, 1))(motion, others)
    states, spent = motion[:4], motion[4:]
    directions = jnp.broadcast_to(jnp.eye(4)[..., None], (4, *states.shape))

    def roots(states: Float[jax.Array, "4 steps"]) -> Float[jax.Array, "costs steps"]:
        moved = jnp.concatenate([states, spent])
        return residuals(climb.scene, climb.planning, climb.weights, moved, others, climb.lane)[:-3]

    slopes = jax.vmap(lambda direction: jax.jvp(roots, (states,), (direction,))[1])(directions)
    bent = jnp.einsum("dck,eck,ekn->dkn", slopes, slopes, along[:4])
    weights = climb.planning.time_step * climb.weights.of_efforts
    bent = jnp.concatenate([bent, weights[:, None, None] * along[4:]])
    size = along.shape[-1]
    return by_motion, by_others, -2 * along.reshape(-1, size).T @ bent.reshape(-1, size)
