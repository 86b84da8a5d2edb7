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
from jaxtyping import Bool, Float, Int

from ms_highway.game.road import RoadScene, interpolate, project
from ms_highway.planning.road.answers import answer, cruise
from ms_highway.planning.road.motion import bodies
from ms_highway.planning.road.proposals import (
    PROPOSALS,
    Manners,
    Profiles,
    Rollouts,
    as_given,
    profiles,
    simulate,
    speed_caps,
)
from ms_highway.planning.road.refinement import refine
from ms_highway.planning.road.scoring import RoadWeights, Scores, score
from ms_highway.planning.road.settings import RUNGS, RoadPlanning
from ms_highway.planning.road.traffic import Ways, positions, ways_of
from ms_highway.runtime.arrays import Array

__all__ = [
    "IDM",
    "LAST_PLAN",
    "NAIVE",
    "REFINED",
    "TOM",
    "TURN",
    "Memory",
    "Proposed",
    "RoadPlan",
    "first_memory",
    "highest_gains",
    "plan_road",
    "propose",
]

NAIVE, IDM, TURN, TOM = range(len(RUNGS))
LAST_PLAN, REFINED = PROPOSALS - 1, -1
"""Numbers of the proposal that is the rest of the last plan, and of a refined plan."""

ANSWERED = 6  # best proposals that others answer


class Memory(NamedTuple):
    """What a plan hands on to the next one.

    Attributes:
        controls: of the robot from now on.
        goal: x and y of where the robot is after the last plan, world coordinates; NaN without one.
    """

    controls: Float[Array, "steps 2"]
    goal: Float[Array, "2"]


class Proposed(NamedTuple):
    """All proposals, judged.

    Attributes:
        plans: what they do.
        rollouts: how they turn out.
        scores: what they earn.
    """

    plans: Profiles
    rollouts: Rollouts
    scores: Scores


class RoadPlan(NamedTuple):
    """The plan that drives.

    Attributes:
        controls: of the robot: curvature and acceleration.
        path: x, y and heading of the robot's centre after each step.
        predictions: x and y of others.
        chosen: number of the proposal that drives, `REFINED` if it is a refined one.
        broken: whether it breaks a constraint.
    """

    controls: Float[jax.Array, "steps 2"]
    path: Float[jax.Array, "steps 3"]
    predictions: Float[jax.Array, "traffic steps 2"]
    chosen: Int[jax.Array, ""]
    broken: Bool[jax.Array, ""]


def first_memory(planning: RoadPlanning) -> Memory:
    """Return the memory before the first plan: go on straight."""
    return Memory(np.zeros((planning.steps, 2), np.float32), np.full(2, np.nan, np.float32))


def last_lane(scene: RoadScene, memory: Memory) -> Int[jax.Array, ""]:
    """Return the lane that the last plan ends in, 0 to 2; the own one without a last plan."""
    s, d, _ = project(scene.route, memory.goal[0], memory.goal[1], jnp.zeros(()))
    lane = jnp.argmin(jnp.abs(jax.vmap(interpolate, in_axes=(0, None))(jnp.asarray(scene.lanes), s) - d))
    return jnp.where(jnp.isfinite(d), lane, 1)


def propose(
    scene: RoadScene, planning: RoadPlanning, weights: RoadWeights, rungs: Int[jax.Array, "traffic"], memory: Memory
) -> Proposed:
    """Simulate and judge all proposals while others keep their speed, or follow from the rung `IDM` on.

    Args:
        scene: the road.
        planning: limits and wishes.
        weights: what counts.
        rungs: of each of the others, numbers of `RUNGS`.
        memory: of the last plan.
    """
    return _propose(_judge(scene, planning, weights), rungs, memory)


def highest_gains(scores: Scores) -> Float[jax.Array, "traffic"]:
    """Return what the best plan would gain if each of the others made way: a bound on what its answer is worth."""
    total = scores.total
    return (total[:, None] + scores.answerable).max(axis=0) - total.max()


def plan_road(
    scene: RoadScene,
    planning: RoadPlanning,
    weights: RoadWeights,
    rungs: Int[jax.Array, "traffic"],
    memory: Memory,
    refines: bool = True,
) -> RoadPlan:
    """Plan with a model for each of the others; takes the arguments of `propose`, and whether plans are refined."""
    judge = _judge(scene, planning, weights)
    proposed = _propose(judge, rungs, memory)
    _, numbers = jax.lax.top_k(proposed.scores.preference, ANSWERED)
    few = jax.tree.map(lambda field: field[numbers], proposed)
    plans = few.plans
    rational = (rungs >= TURN) & jnp.asarray(scene.moving & scene.present)
    told = jnp.zeros((ANSWERED, len(rungs), planning.steps))

    def again() -> tuple[Proposed, Float[jax.Array, "few traffic steps"]]:
        answers = _answers(scene, planning, rungs, rational, few.rollouts)
        manners = Manners(_follows(scene, rungs), rational, answers)
        return judge.judged(plans, manners), answers

    collides = few.scores.collides  # if others only follow: nobody is counted on to make way
    few, told = jax.lax.cond(rational.any(), again, lambda: (few, told))
    best = jnp.argmax(few.scores.preference - jnp.where(collides & ~collides.all(), weights.collision, 0.0))
    chosen, drives = numbers[best], jax.tree.map(lambda field: field[best, None], few)
    if refines:
        controls = refine(
            scene,
            planning,
            drives.rollouts.controls[0],
            _worlds(scene, drives.rollouts)[0],
            rational & (rungs == TOM),
            told[best],
            plans.lane[best],
        )
        following = Manners(_follows(scene, rungs), jnp.zeros_like(rational), jnp.zeros_like(told[:1]))
        manners = Manners(_follows(scene, rungs), rational, told[best, None])
        given = as_given(controls[None], plans.lane[best, None])
        refined, unanswered = judge.judged(given, manners), judge.judged(given, following)
        broken = refined.scores.broken[0] | unanswered.scores.collides[0]
        better = ~broken & (refined.scores.total[0] >= drives.scores.total[0])
        chosen = jnp.where(better, REFINED, chosen)
        drives = jax.tree.map(lambda new, old: jnp.where(better, new, old), refined, drives)
    rollouts = jax.tree.map(lambda field: field[0], drives.rollouts)
    path = jnp.stack(bodies(scene, rollouts.states), axis=-1)
    x, y, _ = positions(scene, rollouts.along, rollouts.across)
    return RoadPlan(rollouts.controls, path, jnp.stack([x, y], axis=-1), chosen, drives.scores.broken[0])


def _follows(scene: RoadScene, rungs: Int[jax.Array, "traffic"]) -> Bool[jax.Array, "traffic"]:
    return (rungs >= IDM) & jnp.asarray(scene.moving)


class _Judge(NamedTuple):
    """What all plans of a step are simulated and judged with."""

    scene: RoadScene
    planning: RoadPlanning
    weights: RoadWeights
    ways: Ways
    caps: Float[jax.Array, "knots"]

    def judged(self, plans: Profiles, manners: Manners) -> Proposed:
        """Simulate plans and judge them."""
        scene, planning, weights, ways, caps = self
        rollouts = simulate(scene, planning, ways, caps, manners, plans)
        return Proposed(plans, rollouts, score(scene, planning, weights, ways, rollouts, plans.lane, caps))


def _judge(scene: RoadScene, planning: RoadPlanning, weights: RoadWeights) -> _Judge:
    return _Judge(scene, planning, weights, ways_of(scene), speed_caps(scene, planning))


def _propose(judge: _Judge, rungs: Int[jax.Array, "traffic"], memory: Memory) -> Proposed:
    """See `propose`."""
    plans = profiles(jnp.asarray(memory.controls), last_lane(judge.scene, memory))
    nothing = jnp.zeros((PROPOSALS, len(rungs), judge.planning.steps))
    return judge.judged(plans, Manners(_follows(judge.scene, rungs), jnp.zeros_like(rungs, bool), nothing))


def _worlds(scene: RoadScene, rollouts: Rollouts) -> Float[jax.Array, "plans traffic 4 steps"]:
    """Return the trajectories of others in world coordinates: x, y, heading and speed."""
    placed = jax.vmap(lambda along, across: jnp.stack(positions(scene, along, across)))
    return jnp.moveaxis(
        jnp.concatenate([placed(rollouts.along, rollouts.across), rollouts.speeds[:, None]], axis=1), 1, 2
    )


def _answers(
    scene: RoadScene,
    planning: RoadPlanning,
    rungs: Int[jax.Array, "traffic"],
    rational: Bool[jax.Array, "traffic"],
    rollouts: Rollouts,
) -> Float[jax.Array, "plans traffic steps"]:
    """Return the accelerations of those who plan for their reward, under each of some plans.

    The loop takes as many rounds as there are such cars, so that time is additive in them.
    """
    x, y, heading = bodies(scene, rollouts.states)
    robots = jnp.stack([x, y, heading, rollouts.states[..., 3]], axis=1)
    worlds, keeps = _worlds(scene, rollouts), jnp.broadcast_to(cruise(scene, planning), robots.shape)
    ranks = jnp.argsort(~rational, stable=True)
    start = jnp.zeros(planning.steps)

    def one(place: Int[jax.Array, ""], found: jax.Array) -> jax.Array:
        car = ranks[place]
        seen = jnp.where(rungs[car] == TOM, robots, keeps)
        given = jax.vmap(lambda robot, others: answer(scene, planning, car, robot, others, start))(seen, worlds)
        return found.at[:, car].set(given)

    nothing = jnp.zeros((len(robots), len(rungs), planning.steps))
    return jax.lax.fori_loop(0, rational.sum(), one, nothing)
