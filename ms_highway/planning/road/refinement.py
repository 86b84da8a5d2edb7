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
from ms_highway.planning.road.answers import UNIT, Accelerations, World, driver_of, follow
from ms_highway.planning.road.motion import advance, bodies, drive
from ms_highway.planning.road.reward import RoadReward, efforts, reward_along
from ms_highway.planning.road.settings import RoadPlanning

__all__ = ["refine"]

STEPS = 3
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
    climb = _Climb(scene, planning, weights, lane, jnp.argsort(~tom, stable=True), jnp.sum(tom))
    first = _Plan(climb.within_limits(jnp.asarray(start)), jnp.asarray(accelerations), jnp.asarray(others))
    first = first._replace(others=climb.answered(first.others, first.accelerations))
    return jax.lax.fori_loop(0, STEPS, lambda _, plan: _improve(climb, plan), first).controls


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

    def within_limits(self, controls: Controls) -> Controls:
        return drive(self.scene, self.planning, controls)[1]

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

    def slope(
        self, i: Int[jax.Array, ""], others: Traffic, accelerations: Accelerations, robot: World
    ) -> Accelerations:
        """Return the derivative of car i's reward in its scaled accelerations."""
        return driver_of(self.scene, self.planning, i, robot, others).slope(accelerations / UNIT)


class _Answers(NamedTuple):
    """What the loop over the cars that answer collects."""

    slope: World  # of the robot's reward through them, in its trajectory
    factors: Float[jax.Array, "traffic n n"]  # of the damped Hessians
    accelerations: Float[jax.Array, "traffic steps"]  # improved


def _improve(climb: _Climb, plan: _Plan) -> _Plan:
    """Take the share of a Newton step that earns most once those who answer have answered it."""
    scale, steps = climb.scale, len(plan.controls)

    def path(scaled: Float[jax.Array, "n"]) -> Trajectory:
        return climb.motion(scaled.reshape(-1, 2) * scale)

    point = (plan.controls / scale).ravel()
    motion, along = path(point), jax.jacfwd(path)(point)
    by_motion, by_others = jax.grad(climb.earned, argnums=(0, 1))(motion, plan.others)
    gradient = jnp.tensordot(by_motion, along, 2)
    hessian = _curvature(climb, motion, plan.others, along)
    robot, pull = jax.vjp(climb.world, motion)

    def answer(place: Int[jax.Array, ""], answers: _Answers) -> _Answers:
        i = climb.ranks[place]
        accelerations = plan.accelerations[i]
        driver = driver_of(climb.scene, climb.planning, i, robot, plan.others)
        own = driver.expand(accelerations / UNIT)
        factor = damped_factor(own.hessian)
        _, by_accelerations = jax.vjp(partial(follow, climb.scene, climb.planning, i), accelerations)
        pushed = damped_solve(factor, UNIT * by_accelerations(by_others[i])[0])
        _, through = jax.vjp(partial(climb.slope, i, plan.others, accelerations), robot)
        improved = driver.toward(accelerations / UNIT, damped_solve(factor, own.gradient)) * UNIT
        return _Answers(
            answers.slope + through(pushed)[0],
            answers.factors.at[i].set(factor),
            answers.accelerations.at[i].set(improved),
        )

    none = _Answers(jnp.zeros_like(robot), jnp.zeros((len(plan.others), steps, steps)), plan.accelerations)
    answers = jax.lax.fori_loop(0, climb.responding, answer, none)
    gradient = gradient + jnp.tensordot(pull(answers.slope)[0], along, 2)
    step = damped_solve(damped_factor(hessian), gradient)
    moved = jax.jvp(climb.world, (motion,), (along @ step,))[1]

    def react(place: Int[jax.Array, ""], reactions: Float[jax.Array, "traffic steps"]) -> jax.Array:
        i = climb.ranks[place]
        slope = partial(climb.slope, i, plan.others, plan.accelerations[i])
        pushed = jax.jvp(slope, (robot,), (moved,))[1]
        return reactions.at[i].set(UNIT * damped_solve(answers.factors[i], pushed))

    reactions = jax.lax.fori_loop(0, climb.responding, react, jnp.zeros_like(plan.accelerations))

    def after(share: Float[jax.Array, ""]) -> tuple[_Plan, Float[jax.Array, ""]]:
        controls = climb.within_limits(plan.controls + share * step.reshape(-1, 2) * scale)
        accelerations = answers.accelerations + share * reactions
        others = climb.answered(plan.others, accelerations)
        return _Plan(controls, accelerations, others), climb.earned(climb.motion(controls), others)

    candidates, earned = jax.vmap(after)(jnp.asarray(SHARES))
    return jax.tree.map(lambda tried: best_of(tried, earned), candidates)


def _curvature(
    climb: _Climb, motion: Trajectory, others: Traffic, along: Float[jax.Array, "fields steps n"]
) -> Float[jax.Array, "n n"]:
    """Return the Hessian in the scaled controls, with the motion taken as linear in them (Gauss-Newton)."""
    fields = len(motion)
    directions = jnp.broadcast_to(jnp.eye(fields)[..., None], (fields, *motion.shape))
    slope = partial(jax.grad(climb.earned), others=others)
    blocks = jax.vmap(lambda direction: jax.jvp(slope, (motion,), (direction,))[1])(directions)
    bent = jnp.einsum("dfk,dkn->fkn", blocks, along)
    return along.reshape(-1, along.shape[-1]).T @ bent.reshape(-1, along.shape[-1])
