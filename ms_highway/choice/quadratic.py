"""Choose models by the paper's Algorithm 1, over one step or the whole horizon.

After a step, a quadratic expansion of the rewards of robot and human estimates the
robot's controls under another rung of the ladder, and what they would have earned. All
controls are scaled, see `ms_highway.game.game`, and ravelled to n = 2 steps numbers for
each player.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, ClassVar, NamedTuple, TypeAlias

import jax
from jax import numpy as jnp
from jaxtyping import Float
from msgspec import Meta

from ms_highway.choice.choosers import Price
from ms_highway.choice.records import NEVER
from ms_highway.choice.rule import (
    FROM_START,
    NOT_ESTIMATED,
    Estimate,
    Estimator,
    GameEvidence,
    Memory,
    Rule,
    Start,
)
from ms_highway.game.game import (
    Game,
    each_human,
    move,
    pair,
    step_rewards,
    swap_players,
    with_scripted,
)
from ms_highway.game.reward import Reward
from ms_highway.numerics.second_derivatives import minus_inverse_times
from ms_highway.planning.costs import Costs
from ms_highway.planning.human_models import HumanModel, scaled_prediction
from ms_highway.planning.plans import Plan
from ms_highway.runtime.arrays import (
    Controls,
    Flag,
    Index,
    Matrix,
    Scalar,
    State,
    Vector,
)
from ms_highway.runtime.limits import Positive

Bracket: TypeAlias = tuple[jax.Array, jax.Array, jax.Array]
"""Bounds of the shift, and the number of halvings."""


def trust_region_step(
    quadratic: Matrix,
    linear: Vector,
    radius: Scalar,
    tolerance: Scalar = 0.0,
) -> Vector:
    """Maximise ``x^T A x / 2 + b^T x`` over the ball ``|x| <= radius``.

    In A's eigenbasis, with eigenvalues l, the maximiser is ``x = b / (shift + max(l) -
    l)`` for the smallest ``shift >= max(0, -max(l))`` that keeps x in the ball (More
    and Sorensen 1983). The shift is at most ``|b| / radius`` and is bisected until
    ``|x|`` is within ``tolerance * radius`` of the radius. Where b has no part along
    the top eigenvector (the "hard case"), x is extended along it to the boundary.
    """
    most_halvings = 60  # of the shift's bracket, beyond what float32 resolves

    # A and b in A's eigenbasis, the largest eigenvalue last.
    eigenvalues, vectors = jnp.linalg.eigh(quadratic)
    largest = eigenvalues[-1]
    along = vectors.T @ linear
    gaps = largest - eigenvalues
    least_shift = jnp.maximum(0.0, -largest)

    def at(shift: jax.Array) -> jax.Array:
        """Return x = b / (shift + max(l) - l)."""
        return jnp.where(along == 0, 0.0, along / (shift + gaps))

    def excess(shift: jax.Array) -> jax.Array:
        """Return by how much x is longer than the radius."""
        return jnp.sqrt(jnp.sum(at(shift) ** 2)) - radius

    # Bisect the shift.
    def unfinished(bracket: Bracket) -> jax.Array:
        low, high, halvings = bracket
        may_go_on = halvings < most_halvings
        middle = (low + high) / 2
        is_inexact = jnp.abs(excess(middle)) > tolerance * radius
        return may_go_on & is_inexact

    def halve(bracket: Bracket) -> Bracket:
        low, high, halvings = bracket
        middle = (low + high) / 2
        is_outside = excess(middle) > 0
        new_low = jnp.where(is_outside, middle, low)
        new_high = jnp.where(is_outside, high, middle)
        return new_low, new_high, halvings + 1

    is_interior = (largest < 0) & (excess(least_shift) <= 0)
    most_shift = jnp.sqrt(jnp.sum(along**2)) / radius
    first = least_shift, most_shift, jnp.int32(0)
    low, high, halvings = jax.lax.while_loop(unfinished, halve, first)
    on_boundary = (low + high) / 2
    maximiser = at(jnp.where(is_interior, least_shift, on_boundary))

    # In the hard case, go on along the top eigenvector up to the boundary.
    is_hard = (largest > 0) & (halvings == most_halvings)
    left = radius**2 - jnp.sum(maximiser**2)
    is_short = left > 1e-5 * radius**2
    to_boundary = jnp.sqrt(jnp.maximum(left, 0.0))
    extension = jnp.where(is_hard & is_short, to_boundary, 0.0)
    signed = jnp.where(along[-1] < 0, -extension, extension)
    return vectors @ maximiser.at[-1].add(signed)


Cooldown = Annotated[
    int,
    Meta(
        ge=1,
        le=-NEVER,
        description=f"it must be a number of steps from 1 to {-NEVER}",
    ),
]


class RewardExpansion(NamedTuple):
    """Derivatives of the robot's reward, and the human's response.

    Attributes:
        gradient: gradient with respect to the controls of both, the robot's first.
        hessian: second derivatives with respect to the same.
        influence: J = d u_H / d u_R, how the human's controls respond to the robot's.
    """

    gradient: Float[jax.Array, "both"]
    hessian: Float[jax.Array, "both both"]
    influence: Matrix


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Quadratic(Estimator[GameEvidence]):
    """Estimate gains by Algorithm 1: expand the rewards of the last plan's steps.

    After a step below the top, the top rung is estimated, as if that had predicted the
    human control that was observed. If the last downward check from the rung in use was
    ``cooldown`` steps ago, the rung below is estimated, with the prediction of that
    rung and without influence. Gains are additive: the gain for one human does not
    depend on the rungs of the others.

    * The rewards R_R and R_H of the steps are expanded around the last plan, from the
      state in which it was made. The first control of the robot is the executed one,
      and the first of the human the observed one; the others are those of the plan.
      With one step, this is the estimate of Sec. III-D. With all K steps, it is that of
      Sec. III-C, with the plan's expectation of the human in place of later
      observations.
    * On the way up, the alternative expects the same human controls, and their response
      to the robot's controls, ``J = du_H / du_R = -(d2R_H / du_H2)^-1 d2R_H / du_H
      du_R``. On the way down, it expects the controls that the rung below predicts, and
      no response.
    * ``delta u`` maximises the expansion within the trust region, whose radius bounds
      all 2 steps numbers together.
    * The gain over the rung in use is R_R after this change and the human's response J
      to it, less what the last plan earns: its first reward as observed, the others as
      expected. It is divided by the number of steps, as the meta-MDP charges ``lambda
      T(M)`` for each.
    * Only the rung in use is compared with others. Its own gain over the first rung is
      the one that was estimated when it was chosen, see
      `ms_highway.choice.rule.Memory`, unless the first rung is the one below. A rung
      that was not compared has no estimate, not even the first.

    Attributes:
        cooldown: least number of steps between two downward checks from the same rung.
        trust_radius: longest change of the scaled controls for which the expansion is
            trusted.
        trust_tolerance: tolerance of the length of ``delta u``, as a share of the
            radius.
        released_tolerance: the same in the solver of the released code.
        steps: number of steps of the last plan that are expanded; None for the whole
            horizon (static).
    """

    cooldown: Cooldown = 3
    trust_radius: Positive = 1.5
    trust_tolerance: Scalar = field(default=1e-3, metadata=FROM_START)
    released_tolerance: ClassVar[float] = 0.05
    steps: int | None = field(default=1, metadata={"static": True} | FROM_START)

    def __post_init__(self) -> None:
        if self.steps is not None and self.steps < 1:
            raise ValueError(
                f"Quadratic.steps is {self.steps}; give at least 1, or None for all"
            )

    def at_start(self, start: Start) -> "Quadratic":
        """Return the estimator with the tolerance of the episode's semantics."""
        if start.semantics != "released":
            return self
        return replace(self, trust_tolerance=self.released_tolerance)

    def estimate(self, memory: Memory, evidence: GameEvidence) -> Estimate:
        """Compare the rung in use with the top rung, and with the rung below."""
        rungs = jnp.asarray(memory.rungs)
        top = len(evidence.ladder) - 1
        humans = jnp.arange(len(rungs))
        ladder = jnp.arange(top + 1)

        # Which comparisons are due: with the top, and with the rung below.
        last_check = jnp.asarray(memory.last_check)[humans, rungs]
        waited = memory.step + 1 - last_check
        climbs = (rungs < top) & (memory.step > 0)
        checks = (rungs > 0) & (memory.step > 0) & (waited >= self.cooldown)

        def compare(human: Index) -> tuple[Scalar, Scalar]:
            alone = with_human(evidence, human)
            return self._gains(alone, rungs[human], climbs[human], checks[human])

        up, down = each_human(evidence.game, compare)

        # Gain of the rung in use over the first one. If that is the one below, it was
        # just compared.
        own = jnp.where(rungs == 0, 0.0, jnp.asarray(memory.gain))
        own = jnp.where((rungs == 1) & jnp.isfinite(down), -down, own)

        # Gain over the first rung of the rung in use, where anything was compared with
        # it: [humans, rungs].
        in_use = ladder == rungs[:, None]
        compared = (climbs | checks)[:, None]
        gains = jnp.where(in_use & compared, own[:, None], NOT_ESTIMATED)

        # The same of the top, and of the rung below.
        is_top = climbs[:, None] & (ladder == top)
        gains = jnp.where(is_top, (own + up)[:, None], gains)
        is_below = checks[:, None] & (ladder == rungs[:, None] - 1)
        gains = jnp.where(is_below, (own + down)[:, None], gains)
        return Estimate(gains, jnp.bool(False))

    def _gains(
        self,
        evidence: GameEvidence,
        rung: Index,
        climbs: Flag,
        checks: Flag,
    ) -> tuple[Scalar, Scalar]:
        """Estimate what the top rung and the rung below gain over the rung in use.

        Args:
            evidence: evidence of the robot and one human.
            rung: rung in use for this human.
            climbs: whether the top rung is due.
            checks: whether the rung below is due.

        Returns:
            The gain of the top rung and of the rung below; `NOT_ESTIMATED` if not due.
        """
        none = jnp.float32(NOT_ESTIMATED)
        state = jnp.asarray(evidence.outcome.before)

        def estimate() -> tuple[Scalar, Scalar]:
            last = self._last_plan(evidence, state)
            gain = partial(self._gain, evidence.game, state, last)

            def gain_up() -> Scalar:
                return gain(last.human, evidence.ladder[-1].responds)

            def gain_down() -> Scalar:
                # All rungs but the top one may be below; a ladder of one rung is never
                # checked, but has to be traced.
                candidates = evidence.ladder[:-1] or evidence.ladder
                game = evidence.game
                predictions = []
                for model in candidates:
                    predictions.append(partial(scaled_prediction, model, game, state))

                below = jnp.maximum(rung - 1, 0)
                predicted = jax.lax.switch(below, predictions)
                steps = len(last.robot)
                return gain(predicted[:steps], False)

            up = jax.lax.cond(climbs, gain_up, lambda: none)
            down = jax.lax.cond(checks, gain_down, lambda: none)
            return up, down

        return jax.lax.cond(climbs | checks, estimate, lambda: (none, none))

    def _last_plan(self, evidence: GameEvidence, state: State) -> "ExpandedPlan":
        """Return the steps of the last plan, and the rewards around them.

        Args:
            evidence: evidence of the robot and one human.
            state: all cars before the last step.
        """
        game = evidence.game
        outcome = evidence.outcome
        plan = outcome.plan

        # The first controls as observed, the others as planned.
        planned_robot = jnp.asarray(plan.robot)[: self.steps]
        planned_human = jnp.asarray(plan.humans[0])[: self.steps]
        robot = planned_robot.at[0].set(outcome.robot)
        human = planned_human.at[0].set(outcome.humans[0])

        # The first reward as observed, the others as these controls earn them.
        if self.steps == 1:
            later = jnp.zeros(0)
        else:
            payoff = game.observed_payoff
            rewards = step_rewards(game, payoff, state, robot, human[None])
            later = rewards[1:]
        earned = outcome.reward + jnp.sum(later)

        expansion = expand(game, state, robot.ravel(), human.ravel())
        return ExpandedPlan(robot, human, earned, expansion)

    def _gain(
        self,
        game: Game,
        state: State,
        last: "ExpandedPlan",
        expected: Controls,
        responds: bool,
    ) -> Scalar:
        """Return what another model would have gained per step.

        Args:
            game: game of the robot and one human.
            state: all cars before the step.
            last: what happened under the rung in use.
            expected: controls of the human that the model predicts.
            responds: whether the human responds under the model.
        """
        # The best change of the robot's controls under the model.
        influence = last.expansion.influence
        if not responds:
            influence = jnp.zeros_like(influence)
        surprise = (expected - last.human).ravel()
        change = change_of_control(last.expansion, surprise, influence, self)

        # What it earns as the human really responds.
        response = (last.expansion.influence @ change).reshape(last.human.shape)
        robot = last.robot + change.reshape(last.robot.shape)
        human = last.human + response
        rewards = step_rewards(game, game.observed_payoff, state, robot, human[None])
        return (jnp.sum(rewards) - last.earned) / len(robot)


class ExpandedPlan(NamedTuple):
    """Some steps of the last plan, and the rewards around them.

    Attributes:
        robot: scaled controls of the robot.
        human: scaled controls of the human.
        earned: rewards of the robot for these steps, added up.
        expansion: expansion of the rewards around these controls.
    """

    robot: Float[jax.Array, "steps 2"]
    human: Float[jax.Array, "steps 2"]
    earned: Scalar
    expansion: RewardExpansion


def with_human(evidence: GameEvidence, human: Index) -> GameEvidence:
    """Return the evidence in the game of the robot with one human.

    See `ms_highway.game.game.pair`.
    """
    game = evidence.game
    outcome = evidence.outcome
    alone, before = pair(game, outcome.before, human)
    _, after = pair(game, outcome.after, human)
    expected = jnp.asarray(outcome.plan.humans)[human][None]
    controls = jnp.asarray(outcome.humans)[human][None]
    plan = Plan(outcome.plan.robot, expected)
    seen = outcome._replace(before=before, after=after, humans=controls, plan=plan)
    return replace(evidence, game=alone, outcome=seen)


@jax.jit
def expand(game: Game, state: State, robot: Vector, human: Vector) -> RewardExpansion:
    """Expand the rewards of both players around the controls of both, in one batch.

    Each player is seen from its own car.
    """
    payoff = game.observed_payoff
    n = len(robot)

    def earned(
        controls: Float[jax.Array, "both"],
        player: Reward,
        state: State,
    ) -> Scalar:
        """Return what a player, car 0 of the state, earns by the controls of both."""
        own, partner = controls.reshape(2, -1, 2)
        partner_path = move(game, state[1], partner)
        others = with_scripted(game, state, partner_path[None])
        own_path = move(game, state[0], own)
        return replace(payoff, reward=player).total(own_path, others)

    # Controls and states as robot and human see them, the own ones first.
    robot_first = jnp.concatenate([robot, human])
    human_first = jnp.concatenate([human, robot])
    controls = jnp.stack([robot_first, human_first])  # [players, both]
    _, state_of_human = swap_players(game, state)
    states = jnp.stack([state, state_of_human])

    # Gradients and Hessians of both rewards, [players, both] and [players, both, both].
    players = game.players()
    gradients = jax.vmap(jax.grad(earned))(controls, players, states)
    hessian, mirrored = jax.vmap(jax.hessian(earned))(controls, players, states)

    # J = -(d2R_H / du_H2)^-1 d2R_H / du_H du_R, with the human's cost of controls.
    steps = n // 2
    comfort = jnp.tile(jnp.asarray(game.humans.comfort), steps)
    human_hessian = mirrored[:n, :n] - jnp.diag(comfort)
    mixed_hessian = mirrored[:n, n:]
    return RewardExpansion(
        gradient=gradients[0],
        hessian=hessian,
        influence=minus_inverse_times(game.influence, human_hessian, mixed_hessian),
    )


def change_of_control(
    expansion: RewardExpansion,
    surprise: Vector,
    influence: Matrix,
    settings: Quadratic,
) -> Vector:
    """Return ``delta u``, which leads to the best controls under another model.

    Let g and H be the gradient and the Hessian of r_R in both players' controls, and d
    the human controls that the model expects less u_H. With the model's influence J', a
    change du of the robot's controls changes those of both by ``P du``, where ``P = [I;
    J']``. The expansion is ``du^T P^T H P du / 2 + (g + H [0; d])^T P du``.
    """
    n = len(surprise)
    both = jnp.concatenate([jnp.eye(n), influence])  # P
    slope = expansion.gradient + expansion.hessian[:, n:] @ surprise
    quadratic = both.T @ expansion.hessian @ both
    linear = both.T @ slope
    return trust_region_step(
        quadratic, linear, settings.trust_radius, settings.trust_tolerance
    )


def Switching(  # noqa: N802 (its name since version 1, when it was a class)
    costs: Costs,
    price: float,
    ladder: tuple[HumanModel, ...],
    trust_radius: float = Quadratic.trust_radius,
    trust_tolerance: Scalar = Quadratic.trust_tolerance,
    cooldown: int = Quadratic.cooldown,
    steps: int | None = 1,
) -> Rule[GameEvidence]:
    """Return the rule of Algorithm 1, by default with the paper's one-step estimate.

    Args:
        costs: planning time of each rung [s].
        price: lambda, reward per second of planning.
        ladder: human models, cheapest first, see `ms_highway.planning.ladders.ladder`.
        trust_radius: see `Quadratic`, as the others.
        trust_tolerance: as a share of the radius.
        cooldown: in steps.
        steps: that are expanded.
    """
    estimator = Quadratic(
        cooldown=cooldown,
        trust_radius=trust_radius,
        trust_tolerance=trust_tolerance,
        steps=steps,
    )
    return Rule(ladder, costs, Price(price), estimator)


WholeHorizon = partial(Switching, steps=None)
"""Algorithm 1 with the estimate over the whole horizon."""
