"""Plan on a road: propose, let others answer, refine, check.

All proposals are judged with others who keep their speed or follow by the Intelligent Driver Model. If some plan for
their reward, they answer the best few of these proposals (theory of mind) or a robot that keeps its velocity (turn),
and these proposals are judged again. The best one is refined; the refined plan drives if it breaks no constraint and
earns as much by the same scores. Answers make plans better, not safe: what hits somebody who only follows does not
drive where anything else holds.
"""

from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.road import Flags, Number, Numbers, RoadScene, Traffic, interpolate, project
from ms_highway.planning.road.answers import driver_among, for_each
from ms_highway.planning.road.arrays import Controls, EachStep, Lane, Steps, Trajectories, Trajectory
from ms_highway.planning.road.motion import centres, cruise
from ms_highway.planning.road.proposals import (
    PROPOSALS,
    Manners,
    Profiles,
    Rollouts,
    as_given,
    profiles,
    simulate,
    trajectories,
)
from ms_highway.planning.road.refinement import refine
from ms_highway.planning.road.reward import Aim
from ms_highway.planning.road.scoring import Scores, score
from ms_highway.planning.road.settings import IDM, TOM, TURN, RoadPlanning, RoadWeights
from ms_highway.planning.road.traffic import Situation, situation_of

REFINED = -1
"""Number of a refined plan, in place of that of a proposal."""

ANSWERED = 6  # best proposals that others answer


class Memory(NamedTuple):
    """What a plan hands on to the next one.

    Attributes:
        controls: of the robot from now on.
        goal: x and y of where the robot is after the last plan, world coordinates; NaN without one.
    """

    controls: Controls
    goal: Number


class Judged(NamedTuple):
    """Plans, how they turn out, and what they earn."""

    plans: Profiles
    rollouts: Rollouts
    scores: Scores


class RoadPlan(NamedTuple):
    """The plan that drives.

    Attributes:
        controls: of the robot: curvature and acceleration.
        path: x, y and heading of the robot's centre after each step [steps, 3].
        predictions: x and y of others [traffic, steps, 2].
        chosen: number of the proposal that drives, `REFINED` if it is a refined one.
        broken: whether it breaks a constraint.
    """

    controls: Controls
    path: Number
    predictions: Number
    chosen: Lane
    broken: Flags


def first_memory(planning: RoadPlanning) -> Memory:
    """Return the memory before the first plan: go on straight."""
    return Memory(np.zeros((planning.steps, 2), np.float32), np.full(2, np.nan, np.float32))


def propose(now: Situation, rungs: Numbers, memory: Memory) -> Judged:
    """Simulate and judge all proposals while others keep their speed, or follow from the model `IDM` on.

    Args:
        now: the situation.
        rungs: of each of the others, numbers of `ms_highway.planning.road.settings.ROAD_MODELS`.
        memory: of the last plan.
    """
    s, d, _ = project(now.scene.route, memory.goal[0], memory.goal[1], jnp.zeros(()))
    lane = jnp.argmin(jnp.abs(interpolate(now.scene.lanes, s) - d))
    plans = profiles(jnp.asarray(memory.controls), jnp.where(jnp.isfinite(d), lane, 1))
    return _judged(now, plans, _following(now, rungs, PROPOSALS))


def highest_gains(scores: Scores) -> Traffic:
    """Return what the best plan would gain if each of the others made way: a bound on what its answer is worth."""
    total = scores.total
    return (total[:, None] + scores.answerable).max(axis=0) - total.max()


def plan_road(
    scene: RoadScene,
    planning: RoadPlanning,
    weights: RoadWeights,
    rungs: Numbers,
    memory: Memory,
    refines: bool = True,
) -> RoadPlan:
    """Plan with a model for each of the others.

    Args:
        scene: the road.
        planning: limits and wishes.
        weights: what counts.
        rungs: see `propose`.
        memory: of the last plan.
        refines: whether the best proposal is refined (static).
    """
    now = situation_of(scene, planning, weights)
    proposed = propose(now, rungs, memory)
    _, numbers = jax.lax.top_k(proposed.scores.preference, ANSWERED)
    few = jax.tree.map(lambda field: field[numbers], proposed)
    following, optimises = _following(now, rungs, ANSWERED), (rungs >= TURN) & scene.moving & scene.present

    def again() -> tuple[Judged, Manners]:
        manners = following._replace(given=optimises, accelerations=_answers(now, rungs, optimises, few.rollouts))
        return _judged(now, few.plans, manners), manners

    collides = few.scores.collides  # if others only follow: nobody is counted on to make way
    few, manners = jax.lax.cond(optimises.any(), again, lambda: (few, following))
    best = jnp.argmax(few.scores.preference - jnp.where(collides & ~collides.all(), weights.collision, 0.0))
    chosen, drives = numbers[best], jax.tree.map(lambda field: field[best, None], few)
    if refines:
        aim, accelerations = Aim(scene, planning, few.plans.lane[best]), manners.accelerations[best]
        others, start = trajectories(scene, drives.rollouts)[0], drives.rollouts.controls[0]
        controls = refine(aim, start, others, optimises & (rungs == TOM), accelerations)
        given = as_given(controls[None], few.plans.lane[best, None])
        refined = _judged(now, given, manners._replace(accelerations=accelerations[None]))
        unanswered = _judged(now, given, _following(now, rungs, 1))
        broken = refined.scores.broken[0] | unanswered.scores.collides[0]
        better = ~broken & (refined.scores.total[0] >= drives.scores.total[0])
        chosen = jnp.where(better, REFINED, chosen)
        drives = jax.tree.map(lambda new, old: jnp.where(better, new, old), refined, drives)
    rollouts = drives.rollouts
    predictions = jnp.swapaxes(trajectories(scene, rollouts)[0, :, :2], 1, 2)
    path = centres(scene, rollouts.states)[0, :3].T
    return RoadPlan(rollouts.controls[0], path, predictions, chosen, drives.scores.broken[0])


def _judged(now: Situation, plans: Profiles, manners: Manners) -> Judged:
    rollouts = simulate(now, manners, plans)
    return Judged(plans, rollouts, score(now, rollouts, plans.lane))


def _following(now: Situation, rungs: Numbers, plans: int) -> Manners:
    """Return the manners of others who keep their speed, or follow."""
    follows = (rungs >= IDM) & now.scene.moving
    return Manners(follows, jnp.zeros_like(follows), jnp.zeros((plans, len(rungs), now.planning.steps)))


def _answers(now: Situation, rungs: Numbers, optimises: Flags, rollouts: Rollouts) -> EachStep:
    """Return the accelerations of those who optimise their reward, under each of some plans."""
    scene, planning, start = now.scene, now.planning, jnp.zeros(now.planning.steps)
    robots, others = centres(scene, rollouts.states), trajectories(scene, rollouts)
    kept = jnp.broadcast_to(cruise(scene, planning), robots.shape)

    def one(car: Numbers, found: EachStep) -> EachStep:
        def answer(robot: Trajectory, others: Trajectories) -> Steps:
            return driver_among(scene, planning, car, robot, others).answer(start)

        seen = jnp.where(rungs[car] == TOM, robots, kept)
        return found.at[:, car].set(jax.vmap(answer)(seen, others))

    return for_each(optimises, one, jnp.zeros((len(robots), len(rungs), planning.steps)))
