"""Refine the robot's controls on a road by damped Newton steps, among cars that keep to predictions or answer.

Car i under theory of mind answers the robot's plan with accelerations u_i: ``J_i = -H_i^-1 d2R_i / du_i du_R``, and the
robot climbs along ``dR_R/du_R + sum_i J_i^T dR_R/du_i``, as in `ms_highway.planning.climb`.
"""

from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.game.road import Flags, Number, Numbers
from ms_highway.optimization.damped_newton import SHARES, best_of, damped_factor, damped_solve
from ms_highway.planning.road.answers import UNIT, by_fields, driver_among, driver_of, for_each
from ms_highway.planning.road.arrays import Controls, EachStep, Matrix, Motion, Steps, Trajectories, Trajectory
from ms_highway.planning.road.motion import advance, centres, drive
from ms_highway.planning.road.reward import Aim, earned, effort_weights, motion_of, residuals

STEPS = 4  # of Newton
SLOWEST = 5.0  # m/s, below which curvature is scaled as at this speed


class Plan(NamedTuple):
    """The robot's controls, the accelerations of those who answer [m/s^2], and the trajectories of all others."""

    controls: Controls
    accelerations: EachStep
    others: Trajectories


class Expansion(NamedTuple):
    """The reward around a plan, in n scaled controls of the robot.

    Attributes:
        gradient: through those who answer, too.
        hessian: of the robot's own part.
        world: derivative of the trajectory of the robot's centre [4, steps, n].
        answers: of others.
    """

    gradient: Steps
    hessian: Matrix
    world: Number
    answers: "Answers"


class Answers(NamedTuple):
    """What is known of those who answer.

    Attributes:
        slope: of the robot's reward through them, in its trajectory.
        factors: of their damped Hessians [traffic, steps, steps].
        influences: of the robot, see `ms_highway.planning.road.answers.Driver.influence` [traffic, 4, 2, steps].
        accelerations: improved [m/s^2].
    """

    slope: Trajectory
    factors: Number
    influences: Number
    accelerations: EachStep


class Climb(NamedTuple):
    """Improve plans step by step.

    Attributes:
        aim: of the plans.
        tom: who answers.
    """

    aim: Aim
    tom: Flags

    @property
    def scale(self) -> Number:
        """Unit of the controls that are optimised: accelerations across and along of 5 m/s^2."""
        return jnp.stack([UNIT / jnp.maximum(self.aim.scene.robot[3], SLOWEST) ** 2, jnp.float32(UNIT)])

    def plan(self, controls: Controls, others: Trajectories, accelerations: EachStep) -> Plan:
        """Return a plan with the trajectories of those who answer in place of their predictions."""

        def put(i: Numbers, others: Trajectories) -> Trajectories:
            driver = driver_of(self.aim.scene, self.aim.planning, i)
            return others.at[i].set(driver.drive(accelerations[i]))

        return Plan(controls, accelerations, for_each(self.tom, put, others))

    def motion(self, controls: Controls) -> Motion:
        """Return the robot's motion; controls are taken as they are, so that none is flat."""
        scene, planning = self.aim.scene, self.aim.planning
        _, states = jax.lax.scan(lambda state, u: (advance(scene, planning, state, u),) * 2, scene.robot, controls)
        return motion_of(self.aim, states, controls)

    def expand(self, plan: Plan) -> Expansion:
        """Expand the reward around a plan."""
        scene, planning = self.aim.scene, self.aim.planning

        def path(scaled: Steps) -> Motion:
            return self.motion(scaled.reshape(-1, 2) * self.scale)

        point = (plan.controls / self.scale).ravel()
        motion, along = path(point), jax.jacfwd(path)(point)
        by_motion, by_others = jax.grad(earned, argnums=(1, 2))(self.aim, motion, plan.others)
        robot, onto_world = jax.linearize(lambda motion: centres(scene, motion[:4].T), motion)
        world = jax.vmap(onto_world, -1, -1)(along)

        def answer(i: Numbers, answers: Answers) -> Answers:
            driver, scaled = driver_among(scene, planning, i, robot, plan.others), plan.accelerations[i] / UNIT
            own, influence = driver.expand(scaled), driver.influence(scaled, robot)
            factor = damped_factor(own.hessian)
            _, back = jax.vjp(driver.place, driver.move(scaled))
            pushed = damped_solve(factor, driver.pull(back(by_others[i])[0]))
            improved = driver.toward(scaled, damped_solve(factor, own.gradient)) * UNIT
            return Answers(
                answers.slope + jnp.sum(influence * driver.push(pushed), axis=1),
                answers.factors.at[i].set(factor),
                answers.influences.at[i].set(influence),
                answers.accelerations.at[i].set(improved),
            )

        cars, fields, steps = plan.others.shape
        shapes = (fields, steps), (cars, steps, steps), (cars, fields, 2, steps)
        answers = for_each(self.tom, answer, Answers(*(*map(jnp.zeros, shapes), plan.accelerations)))
        gradient = jnp.tensordot(by_motion, along, 2) + jnp.tensordot(answers.slope, world, 2)
        return Expansion(gradient, self._hessian(motion, plan.others, along), world, answers)

    def _hessian(self, motion: Motion, others: Trajectories, along: Number) -> Matrix:
        """Return the Hessian of Gauss-Newton: motion and `residuals` count as linear: no eigenvalue is positive."""

        def roots(states: Trajectory) -> Steps:
            return residuals(self.aim, jnp.concatenate([states, motion[4:]]), others)[:-3]

        slopes = by_fields(roots, motion[:4])
        bent = jnp.einsum("dck,eck,ekn->dkn", slopes, slopes, along[:4])
        weights = self.aim.planning.time_step * effort_weights(self.aim.weights)
        bent = jnp.concatenate([bent, weights[:, None, None] * along[4:]])
        size = along.shape[-1]
        return -2 * along.reshape(-1, size).T @ bent.reshape(-1, size)

    def improve(self, plan: Plan) -> Plan:
        """Take the share of a Newton step that earns most once those who answer have answered it."""
        scene, planning = self.aim.scene, self.aim.planning
        gradient, hessian, world, answers = self.expand(plan)
        step = damped_solve(damped_factor(hessian), gradient)
        moved = world @ step

        def react(i: Numbers, reactions: EachStep) -> EachStep:
            slopes = jnp.sum(answers.influences[i] * moved[:, None], axis=0)
            reaction = damped_solve(answers.factors[i], driver_of(scene, planning, i).pull(slopes))
            return reactions.at[i].set(UNIT * reaction)

        reactions = for_each(self.tom, react, jnp.zeros_like(plan.accelerations))

        def after(share: Number) -> tuple[Plan, Number]:
            _, controls = drive(scene, planning, plan.controls + share * step.reshape(-1, 2) * self.scale)
            tried = self.plan(controls, plan.others, answers.accelerations + share * reactions)
            return tried, earned(self.aim, self.motion(controls), tried.others)

        candidates, rewards = jax.vmap(after)(jnp.asarray(SHARES))
        return jax.tree.map(lambda tried: best_of(tried, rewards), candidates)


def refine(aim: Aim, start: Controls, others: Trajectories, tom: Flags, accelerations: EachStep) -> Controls:
    """Improve the robot's controls by damped Newton steps on `ms_highway.planning.road.reward.earned`.

    The time is additive in the cars that answer; without them, no step earns less than the one before.

    Args:
        aim: of the plan.
        start: curvatures and accelerations to improve.
        others: predicted trajectories of all traffic, world coordinates.
        tom: which of them answer the robot's plan.
        accelerations: with which these answer the start [m/s^2].
    """
    climb = Climb(aim, tom)
    first = climb.plan(drive(aim.scene, aim.planning, start)[1], others, accelerations)
    return jax.lax.fori_loop(0, STEPS, lambda _, plan: climb.improve(plan), first).controls
