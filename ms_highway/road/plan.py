"""Plan on a road: propose, let others answer, check.

All proposals are judged with others who keep their speed or follow by the Intelligent Driver Model. If some plan for
their reward (theory of mind), they answer the best few of these proposals, and these are judged again. Answers make
plans better, not safe: reject a plan that collides if others merely follow, when a safe plan exists.
"""

from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.perception.scene import EachStep, Flags, Places, RoadScene, Traffic
from ms_highway.road.best_responses import ACCELERATION_UNIT, commuter_among
from ms_highway.road.constants import TOM, RoadPlanning, RoadWeights
from ms_highway.road.following import manners_of
from ms_highway.road.proposals import PROPOSALS, LastPlan, Profiles, proposals
from ms_highway.road.score import Scores, score
from ms_highway.road.simulation import DrivenPlans, simulate
from ms_highway.road.traffic import Situation, situation_of
from ms_highway.runtime.arrays import Controls, Flag, Index, Numbers, for_each

WITH_RESPONSES = 4  # best proposals that others answer


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
        few: the best of the proposals, `WITH_RESPONSES` of them.
        numbers: which ones these are.
        worth: upper bound on the gain from predicting each car better: what the best plan would earn more if that car
            cost nothing.
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


def propose_road(
    scene: RoadScene, planning: RoadPlanning, weights: RoadWeights, models: Places, last: LastPlan
) -> Proposed:
    """Propose plans, and find the best of them while nobody optimises.

    Args:
        scene: the road.
        planning: limits and wishes.
        weights: what counts.
        models: number of the model of each of the others: under naive they keep their speed, else they follow.
        last: plan.
    """
    now = situation_of(scene, planning, weights)
    plans = proposals(now, last)
    driven = simulate(now, manners_of(now, models, PROPOSALS), plans)
    judged = Judged(plans, driven, score(now, driven, plans))
    total = judged.scores.total
    worth = (total[:, None] + judged.scores.answerable).max(axis=0) - total.max()
    _, numbers = jax.lax.top_k(judged.scores.preference, WITH_RESPONSES)
    few = jax.tree.map(lambda field: field[numbers], judged)
    return Proposed(now, few, numbers, worth, _best(now, few, few, numbers))


def answer_road(proposed: Proposed, models: Places) -> RoadPlan:
    """Return the best of the proposals when those answer them who optimise their reward.

    Args:
        proposed: plans, while all others keep their speed or follow, as their models say.
        models: number of the model of each of the others.
    """
    now, few = proposed.now, proposed.few
    optimises = (models == TOM) & now.scene.moving
    responses = _best_responses(now, optimises, few.driven)
    answering = manners_of(now, models, WITH_RESPONSES)._replace(given=optimises, accelerations=responses)
    driven = simulate(now, answering, few.plans)
    return _best(now, few, Judged(few.plans, driven, score(now, driven, few.plans)), proposed.numbers)


def _best(now: Situation, few: Judged, answered: Judged, numbers: Places) -> RoadPlan:
    """Return the best plan; one that collides if others merely follow ranks behind those that do not."""
    relies = few.scores.collides & ~answered.scores.broken
    best = jnp.argmax(answered.scores.preference - now.weights.unsound * relies)
    plans, driven, scores = jax.tree.map(lambda field: field[best], answered)
    predictions = jnp.swapaxes(driven.world[:, :2], 1, 2)
    return RoadPlan(driven.controls, driven.path[:3].T, predictions, numbers[best], plans.side, scores.broken)


def _best_responses(now: Situation, optimises: Flags, driven: DrivenPlans) -> EachStep:
    """Return the accelerations of those who optimise their reward, under each of some plans."""
    scene, planning = now.scene, now.planning

    def one(car: Places, found: EachStep) -> EachStep:
        response = jax.vmap(lambda *all_others: commuter_among(scene, planning, car, *all_others).best_response())
        return found.at[:, car].set(ACCELERATION_UNIT * response(driven.path, driven.world))

    return for_each(optimises, one, jnp.zeros((WITH_RESPONSES, len(optimises), planning.steps)))
