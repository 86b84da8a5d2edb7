"""Plan on a road: propose plans, let others respond, and choose the best plan.

All proposals are first scored with others that keep their speed or follow by the
Intelligent Driver Model. If some of the others optimise their reward (theory of mind),
they respond to the best few proposals, which are scored again. A response may make a
plan better, but not safe: a plan that collides if others merely follow is rejected when
a safe plan exists.
"""

from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.perception.scene import EachStep, Flags, Places, RoadScene, Traffic
from ms_highway.road.best_responses import ACCELERATION_UNIT, commuter_among
from ms_highway.road.constants import TOM, RoadPlanning, RoadWeights
from ms_highway.road.following import Behaviour, behaviour_of
from ms_highway.road.proposals import PROPOSALS, LastPlan, Profiles, proposals
from ms_highway.road.score import Scores, score
from ms_highway.road.simulation import DrivenPlans, simulate
from ms_highway.road.traffic import Situation, situation_of
from ms_highway.runtime.arrays import Controls, Flag, Index, Numbers, for_each

WITH_RESPONSES = 4  # best proposals, to which others respond


class ScoredPlans(NamedTuple):
    """Plans with their simulation and their scores.

    Attributes:
        numbers: of the proposals.
        plans: the proposals.
        driven: how they turn out.
        scores: what they earn.
    """

    numbers: Places
    plans: Profiles
    driven: DrivenPlans
    scores: Scores


class RoadPlan(NamedTuple):
    """The best plan.

    Attributes:
        controls: of the robot: curvature and acceleration.
        path: x, y and heading of the robot's centre after each step [steps, 3].
        predictions: x and y of others [traffic, steps, 2].
        chosen: number of the proposal.
        side: on which the plan passes an obstacle, see
            `ms_highway.road.proposals.Profiles`.
        broken: whether the plan breaks a constraint.
    """

    controls: Controls
    path: Numbers
    predictions: Numbers
    chosen: Index
    side: Index
    broken: Flag

    def last(self) -> LastPlan:
        """Return what the next plan may start from, a step later."""
        return LastPlan(self.controls, self.path[-1, :2], self.side)


class Proposed(NamedTuple):
    """The best proposals if nobody optimises.

    Attributes:
        now: the situation.
        few: the `WITH_RESPONSES` best proposals.
        worth: upper bound on the gain from a better prediction of each car: how much
            more the best plan would earn if that car cost nothing.
        plan: the best of all proposals.
    """

    now: Situation
    few: ScoredPlans
    worth: Traffic
    plan: RoadPlan


def no_plan(planning: RoadPlanning) -> LastPlan:
    """Return the plan that replaces the last plan before the first step: it goes
    straight on.
    """
    return LastPlan(
        np.zeros((planning.steps, 2), np.float32),
        np.full(2, np.nan, np.float32),
        np.int32(0),
    )


def propose_road(
    scene: RoadScene,
    planning: RoadPlanning,
    weights: RoadWeights,
    models: Places,
    last: LastPlan,
) -> Proposed:
    """Propose plans, and find the best of them if nobody optimises.

    Args:
        scene: the road.
        planning: limits and wishes.
        weights: of the score.
        models: number of the model of each of the others: under naive they keep their
            speed, otherwise they follow.
        last: the rest of the last plan.
    """
    now = situation_of(scene, planning, weights)
    scored = _scored(
        now,
        behaviour_of(now, models, PROPOSALS),
        jnp.arange(PROPOSALS),
        proposals(now, last),
    )
    total = scored.scores.total
    worth = (total[:, None] + scored.scores.responsive).max(axis=0) - total.max()
    _, best = jax.lax.top_k(scored.scores.preference, WITH_RESPONSES)
    few = jax.tree.map(lambda field: field[best], scored)
    return Proposed(now, few, worth, _best(now, few, few))


def respond_road(proposed: Proposed, models: Places) -> RoadPlan:
    """Return the best of the proposals once the others that optimise their reward have
    responded to them.

    Args:
        proposed: the proposals, scored with others that keep their speed or follow.
        models: number of the model of each of the others.
    """
    now = proposed.now
    few = proposed.few
    optimises = (models == TOM) & now.scene.moving
    behaviour = behaviour_of(now, models, WITH_RESPONSES)
    behaviour = behaviour._replace(
        follows=behaviour.follows & ~optimises,
        accelerations=_best_responses(now, optimises, few.driven),
    )
    return _best(now, few, _scored(now, behaviour, few.numbers, few.plans))


def _scored(
    now: Situation, behaviour: Behaviour, numbers: Places, plans: Profiles
) -> ScoredPlans:
    """Simulate plans among others that behave in a given way, and score them."""
    driven = simulate(now, behaviour, plans)
    return ScoredPlans(numbers, plans, driven, score(now, driven, plans))


def _best(now: Situation, few: ScoredPlans, responded: ScoredPlans) -> RoadPlan:
    """Return the best plan; plans that collide if others merely follow rank behind
    those that do not.
    """
    relies = few.scores.collides & ~responded.scores.broken
    best = jnp.argmax(responded.scores.preference - now.weights.unsound * relies)
    number, plan, driven, scores = jax.tree.map(lambda field: field[best], responded)
    predictions = jnp.swapaxes(driven.world[:, :2], 1, 2)
    return RoadPlan(
        driven.controls,
        driven.path[:3].T,
        predictions,
        number,
        plan.side,
        scores.broken,
    )


def _best_responses(now: Situation, optimises: Flags, driven: DrivenPlans) -> EachStep:
    """Return the accelerations of the others that optimise their reward under each
    plan; 0 for the rest.
    """
    scene = now.scene
    planning = now.planning

    def one(car: Places, found: EachStep) -> EachStep:
        response = jax.vmap(
            lambda *all_others: commuter_among(
                scene, planning, car, *all_others
            ).best_response()
        )
        return found.at[:, car].set(
            ACCELERATION_UNIT * response(driven.path, driven.world)
        )

    return for_each(
        optimises, one, jnp.zeros((WITH_RESPONSES, len(optimises), planning.steps))
    )
