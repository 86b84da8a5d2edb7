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

from ms_highway.perception.scene import (
    Flags,
    PerPathAndStep,
    Places,
    RoadScene,
    Traffic,
)
from ms_highway.road.best_responses import RESPONSES, commuter_among
from ms_highway.road.following import Behaviour, behaviour_of
from ms_highway.road.proposals import PROFILES, LastPlan, Profiles, proposals
from ms_highway.road.road_planning import RoadPlanning
from ms_highway.road.road_weights import RoadWeights
from ms_highway.road.score import CONSTRAINTS, Scores, score
from ms_highway.road.simulation import SimulatedPlans, simulate
from ms_highway.road.traffic import Situation, situation_of
from ms_highway.road.traffic_models import ModelNumber
from ms_highway.runtime.arrays import Controls, Flag, Index, Numbers, for_each

ANSWERED = 4
"""Number of the best proposals, to which others respond; each costs computation."""


class ScoredPlans(NamedTuple):
    """Plans with their simulation and their scores.

    Attributes:
        numbers: of the proposals.
        plans: the proposals.
        simulated: how they turn out.
        scores: what they earn.
    """

    numbers: Places
    plans: Profiles
    simulated: SimulatedPlans
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
        situation: what all plans share.
        best_few: the `ANSWERED` best proposals.
        worth: upper bound on the gain from a better prediction of each car: how much
            more the best plan would earn if that car cost nothing.
        plan: the best of all proposals.
    """

    situation: Situation
    best_few: ScoredPlans
    worth: Traffic
    plan: RoadPlan


def no_plan(planning: RoadPlanning) -> LastPlan:
    """Return what replaces the last plan before the first step.

    It goes straight on.
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
        planning: limits, and the desired speed.
        weights: of the score.
        models: number of the model of each of the others: under naive they keep their
            speed, otherwise they follow.
        last: the rest of the last plan.
    """
    situation = situation_of(scene, planning, weights)
    count = len(PROFILES)
    scored = _scored(
        situation,
        behaviour_of(situation, models, count),
        jnp.arange(count),
        proposals(situation, last),
    )

    # What the best plan would earn more if each car cost nothing.
    total = scored.scores.total
    without_car = total[:, None] + scored.scores.responsive
    worth = without_car.max(axis=0) - total.max()

    _, best = jax.lax.top_k(scored.scores.preference, ANSWERED)
    best_few = jax.tree.map(lambda field: field[best], scored)
    return Proposed(situation, best_few, worth, _best(best_few, best_few))


def respond_road(proposed: Proposed, models: Places) -> RoadPlan:
    """Return the best of the proposals once others have responded to them.

    Those respond that optimise their reward.

    Args:
        proposed: the proposals, scored with others that keep their speed or follow.
        models: number of the model of each of the others.
    """
    situation = proposed.situation
    best_few = proposed.best_few
    optimises = (models == ModelNumber.tom) & situation.scene.moving
    behaviour = behaviour_of(situation, models, ANSWERED)
    behaviour = behaviour._replace(
        follows=behaviour.follows & ~optimises,
        accelerations=_best_responses(situation, optimises, best_few.simulated),
    )
    responded = _scored(situation, behaviour, best_few.numbers, best_few.plans)
    return _best(best_few, responded)


def _scored(
    situation: Situation,
    behaviour: Behaviour,
    numbers: Places,
    plans: Profiles,
) -> ScoredPlans:
    """Simulate plans among others that behave in a given way, and score them."""
    simulated = simulate(situation, behaviour, plans)
    return ScoredPlans(numbers, plans, simulated, score(situation, simulated, plans))


def _best(followed: ScoredPlans, responded: ScoredPlans) -> RoadPlan:
    """Return the best plan.

    Plans that collide if others merely follow rank behind those that do not.

    Args:
        followed: the plans among others that merely follow.
        responded: the same plans among others that respond.
    """
    relies_on_response = followed.scores.collides & ~responded.scores.broken
    cost_of_relying = CONSTRAINTS.infeasible * relies_on_response
    preference = responded.scores.preference - cost_of_relying
    best = jnp.argmax(preference)
    number, plan, simulated, scores = jax.tree.map(lambda field: field[best], responded)
    return RoadPlan(
        simulated.controls,
        path=simulated.centre[:3].T,
        predictions=jnp.swapaxes(simulated.world[:, :2], 1, 2),
        chosen=number,
        side=plan.side,
        broken=scores.broken,
    )


def _best_responses(
    situation: Situation,
    optimises: Flags,
    simulated: SimulatedPlans,
) -> PerPathAndStep:
    """Return the accelerations of others that optimise their reward.

    There is one response to each plan; the accelerations of the rest are 0.
    """
    scene = situation.scene
    planning = situation.planning

    def add_response(car: Index, found: jax.Array) -> jax.Array:
        """Add the response of a car to each plan."""

        def respond(robot: Numbers, others: Numbers) -> Numbers:
            return commuter_among(scene, planning, car, robot, others).best_response()

        scaled = jax.vmap(respond)(simulated.centre, simulated.world)
        return found.at[:, car].set(RESPONSES.acceleration_unit * scaled)

    none = jnp.zeros((ANSWERED, len(optimises), planning.steps))
    return for_each(optimises, add_response, none)
