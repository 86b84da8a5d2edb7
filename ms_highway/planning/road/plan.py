"""Plan on a road: propose, refine, check."""

from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.road import RoadScene, interpolate, project
from ms_highway.planning.road.motion import bodies
from ms_highway.planning.road.proposals import PROPOSALS, Manners, Rollouts, profiles, simulate, speed_caps
from ms_highway.planning.road.scoring import RoadWeights, Scores, score
from ms_highway.planning.road.settings import RUNGS, RoadPlanning
from ms_highway.planning.road.traffic import positions, ways_of

__all__ = [
    "IDM",
    "LAST_PLAN",
    "NAIVE",
    "TOM",
    "TURN",
    "Memory",
    "Proposed",
    "RoadPlan",
    "first_memory",
    "plan_road",
    "propose",
]

NAIVE, IDM, TURN, TOM = range(len(RUNGS))
LAST_PLAN = PROPOSALS - 1
"""Number of the proposal that is the rest of the last plan."""


class Memory(NamedTuple):
    """What a plan hands on to the next one.

    Attributes:
        controls: of the robot from now on.
        goal: x and y of where the robot is after the last plan, world coordinates; NaN without one.
    """

    controls: Float[jax.Array, "steps 2"]
    goal: Float[jax.Array, "2"]


class Proposed(NamedTuple):
    """All proposals, judged.

    Attributes:
        rollouts: how they turn out.
        scores: what they earn.
    """

    rollouts: Rollouts
    scores: Scores


class RoadPlan(NamedTuple):
    """A plan that drives.

    Attributes:
        controls: of the robot: curvature and acceleration.
        path: x, y and heading of the robot's centre after each step.
        predictions: x and y of others.
        chosen: number of the proposal that drives, -1 if it is a refined one.
        broken: whether it breaks a constraint.
        gains: what each of the others costs the robot at most, see `ms_highway.metareasoning.road`.
    """

    controls: Float[jax.Array, "steps 2"]
    path: Float[jax.Array, "steps 3"]
    predictions: Float[jax.Array, "traffic steps 2"]
    chosen: Int[jax.Array, ""]
    broken: jax.Array
    gains: Float[jax.Array, "traffic"]


def first_memory(planning: RoadPlanning) -> Memory:
    """Return the memory before the first plan: go on straight."""
    return Memory(np.zeros((planning.steps, 2), np.float32), np.full(2, np.nan, np.float32))


def last_lane(scene: RoadScene, memory: Memory) -> Int[jax.Array, ""]:
    """Return the lane that the last plan ends in, 0 to 2; the own one without a last plan."""
    s, d, _ = project(scene.route, *memory.goal, 0.0)
    lane = jnp.argmin(jnp.abs(jax.vmap(interpolate, in_axes=(0, None))(jnp.asarray(scene.lanes), s) - d))
    return jnp.where(jnp.isfinite(d), lane, 1)


def propose(
    scene: RoadScene, planning: RoadPlanning, weights: RoadWeights, rungs: Int[jax.Array, "traffic"], memory: Memory
) -> Proposed:
    """Simulate and judge all proposals while others are predicted by these rungs.

    Args:
        scene: the road.
        planning: limits and wishes.
        weights: what counts.
        rungs: of each of the others, numbers of `RUNGS`.
        memory: of the last plan.
    """
    plans = profiles(memory.controls, last_lane(scene, memory))
    nothing = jnp.zeros((PROPOSALS, len(rungs), planning.steps))
    manners = Manners((rungs >= IDM) & jnp.asarray(scene.moving), jnp.zeros_like(rungs, bool), nothing)
    ways = ways_of(scene)
    rollouts = simulate(scene, planning, ways, manners, plans)
    return Proposed(rollouts, score(scene, planning, weights, ways, rollouts, plans.lane, speed_caps(scene, planning)))


def highest_gains(scores: Scores) -> Float[jax.Array, "traffic"]:
    """Return what the best plan would gain without each of the others: a bound on what its answer is worth."""
    total = scores.total
    return (total[:, None] + scores.others).max(axis=0) - total.max()


def plan_road(
    scene: RoadScene, planning: RoadPlanning, weights: RoadWeights, rungs: Int[jax.Array, "traffic"], memory: Memory
) -> RoadPlan:
    """Plan with a model for each of the others; takes the arguments of `propose`."""
    rollouts, scores = propose(scene, planning, weights, rungs, memory)
    best = jnp.argmax(scores.total)
    path = jnp.stack(bodies(scene, rollouts.states[best]), axis=-1)
    x, y, _ = positions(scene, rollouts.along[best], rollouts.across[best])
    return RoadPlan(
        rollouts.controls[best],
        path,
        jnp.stack([x, y], axis=-1),
        best,
        scores.broken[best],
        highest_gains(scores),
    )
