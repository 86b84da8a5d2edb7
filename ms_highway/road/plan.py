"""Plan on a road: propose, let others answer, check.

All proposals are judged with others who keep their speed or follow by the Intelligent Driver Model. If some plan for
their reward (theory of mind), they answer the best few of these proposals, and these are judged again. Answers make
plans better, not safe: reject a plan that collides if others merely follow, when a safe plan exists.
"""

from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.road.answers import UNIT, commuter_among
from ms_highway.road.arrays import EachStep
from ms_highway.road.constants import IDM, LANE, TOM, RoadPlanning, RoadWeights
from ms_highway.road.motion import centres
from ms_highway.road.proposals import (
    PROPOSALS,
    DrivenPlans,
    Manners,
    Profiles,
    nearest_lane,
    profiles,
    simulate_plans,
)
from ms_highway.road.scene import Flags, Places, RoadScene, Traffic
from ms_highway.road.scoring import UNSOUND, Scores, score
from ms_highway.road.traffic import Situation, accelerations_now, leads, situation_of
from ms_highway.runtime.arrays import Controls, Flag, Index, Numbers, Vector, for_each

ANSWERED = 4  # best proposals that others answer
HARD = 3.0  # m/s^2, of braking ahead, from which it is expected to go on
BESIDE = 1.5  # lanes aside, up to which that matters


class LastPlan(NamedTuple):
    """What a plan hands on to the next one.

    Attributes:
        controls: of the robot from now on.
        goal: x and y of where the robot is after the last plan, world coordinates; NaN without one.
        side: on which it goes round what cannot move, see `ms_highway.road.proposals.Profiles`.
    """

    controls: Controls
    goal: Vector
    side: Index

    def later(self) -> "LastPlan":
        """Return what is left of it a step later; its last control is held."""
        return self._replace(controls=np.concatenate([self.controls[1:], self.controls[-1:]]))


class Judged(NamedTuple):
    """Plans, how they turn out, and what they earn."""

    plans: Profiles
    driven: DrivenPlans
    scores: Scores


class RoadPlan(NamedTuple):
    """The plan that drives.

    Attributes:
        controls: of the robot: curvature and acceleration.
        path: x, y and heading of the robot's centre after each step [steps, 3].
        predictions: x and y of others [traffic, steps, 2].
        chosen: number of the proposal that drives.
        side: on which it goes round what cannot move, see `ms_highway.road.proposals.Profiles`.
        broken: whether it breaks a constraint.
    """

    controls: Controls
    path: Numbers
    predictions: Numbers
    chosen: Index
    side: Index
    broken: Flag

    def handed_on(self) -> LastPlan:
        """Return what the next plan has of it, a step later."""
        return LastPlan(self.controls, self.path[-1, :2], self.side).later()


class Proposed(NamedTuple):
    """The best proposals while nobody optimises.

    Attributes:
        now: the situation.
        few: the best of the proposals, `ANSWERED` of them.
        numbers: which ones these are.
        worth: what the best proposal would gain if each of the others, alone, made way: a bound on what its answer is
            worth.
        plan: the best one.
    """

    now: Situation
    few: Judged
    numbers: Places
    worth: Traffic
    plan: RoadPlan


def no_plan(planning: RoadPlanning) -> LastPlan:
    """Return what stands for the last plan before the first one: go on straight."""
    return LastPlan(np.zeros((planning.steps, 2), np.float32), np.full(2, np.nan, np.float32), np.int32(0))


def proposals(now: Situation, rungs: Places, last: LastPlan) -> tuple[Profiles, Manners]:
    """Return all proposals, and the manners of other cars: those below the model `IDM` keep their speed, others follow.

    Args:
        now: the situation.
        rungs: number of the model of each of the others, see `ms_highway.road.constants.IDM`.
        last: plan.
    """
    side = jnp.where(now.obstruction.exists, last.side, 0)  # also where the plan leads back already
    lane = jnp.where(side == 0, nearest_lane(now.scene, *last.goal), 1)
    return profiles(last.controls, lane, side), _following(now, rungs, PROPOSALS)


def propose_road(
    scene: RoadScene, planning: RoadPlanning, weights: RoadWeights, rungs: Places, last: LastPlan
) -> Proposed:
    """Propose plans, and find the best of them while nobody optimises.

    Args:
        scene: the road.
        planning: limits and wishes.
        weights: what counts.
        rungs: see `proposals`.
        last: plan.
    """
    now = situation_of(scene, planning, weights)
    judged = _judged(now, *proposals(now, rungs, last))
    total = judged.scores.total
    worth = (total[:, None] + judged.scores.answerable).max(axis=0) - total.max()
    _, numbers = jax.lax.top_k(judged.scores.preference, ANSWERED)
    few = jax.tree.map(lambda field: field[numbers], judged)
    return Proposed(now, few, numbers, worth, _best(now, few, few, numbers))


def answer_road(proposed: Proposed, rungs: Places) -> RoadPlan:
    """Return the best of the proposals when those answer them who optimise their reward.

    Args:
        proposed: plans, while all others do what their models say up to `IDM`.
        rungs: number of the model of each of the others.
    """
    now, few = proposed.now, proposed.few
    optimises = (rungs == TOM) & now.scene.moving & now.scene.present
    manners = _following(now, rungs, ANSWERED)._replace(
        given=optimises, accelerations=_answers(now, optimises, few.driven)
    )
    return _best(now, few, _judged(now, few.plans, manners), proposed.numbers)


def _best(now: Situation, few: Judged, answered: Judged, numbers: Places) -> RoadPlan:
    """Return the best plan; one that collides if others merely follow ranks behind those that do not."""
    relies = few.scores.collides & ~answered.scores.broken
    best = jnp.argmax(answered.scores.preference - UNSOUND * relies)
    driven = answered.driven
    predictions = jnp.swapaxes(driven.world[best, :, :2], 1, 2)
    path = centres(now.scene, driven.states[best])[:3].T
    return RoadPlan(
        driven.controls[best], path, predictions, numbers[best], few.plans.side[best], answered.scores.broken[best]
    )


def _judged(now: Situation, plans: Profiles, manners: Manners) -> Judged:
    driven = simulate_plans(now, manners, plans)
    return Judged(plans, driven, score(now, driven, plans))


def _following(now: Situation, rungs: Places, plans: int) -> Manners:
    """Return the manners of others who keep their speed, or follow.

    Vehicles that may cross the robot's way keep their speed: there they stop and start for others than the car ahead.
    The part of an acceleration that the model does not explain fades; hard braking ahead of the robot goes on.
    """
    scene, planning = now.scene, now.planning
    follows = (rungs >= IDM) & scene.moving & ~now.crossings.exist
    expected = follows | ((rungs == TOM) & scene.moving)
    modelled = accelerations_now(scene, now.ways, planning.time_step)
    brakes = leads(scene, now.ways, BESIDE * LANE) & (scene.accelerations < -HARD)
    return Manners(
        follows,
        given=jnp.zeros_like(follows),
        accelerations=jnp.zeros((plans, len(rungs), planning.steps)),
        surprise=scene.accelerations - jnp.where(expected, modelled, 0.0),
        held=jnp.where(brakes, scene.accelerations, jnp.inf),
    )


def _answers(now: Situation, optimises: Flags, driven: DrivenPlans) -> EachStep:
    """Return the accelerations of those who optimise their reward, under each of some plans."""
    scene, planning = now.scene, now.planning
    robots, others = centres(scene, driven.states), driven.world

    def one(car: Places, found: EachStep) -> EachStep:
        answer = jax.vmap(lambda *all_others: commuter_among(scene, planning, car, *all_others).answer())
        return found.at[:, car].set(UNIT * answer(robots, others))

    return for_each(optimises, one, jnp.zeros((len(robots), len(optimises), planning.steps)))
