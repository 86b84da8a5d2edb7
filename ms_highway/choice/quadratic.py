"""Choose models by the paper's Algorithm 1, with estimates over one step or over the whole horizon.

After a step, a quadratic expansion of the rewards of robot and human estimates the robot's controls under another rung
of the ladder, and what they would have earned. All controls are scaled, see `ms_highway.game.game`, and ravelled to
n = 2 steps numbers for each player.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple, TypeAlias

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.choice.rule import NOT_ESTIMATED, Decision, Memory, Outcome, Rule, with_human
from ms_highway.game.game import (
    Game,
    each_human,
    move,
    step_rewards,
    swap_players,
    with_scripted,
)
from ms_highway.game.reward import Reward
from ms_highway.numerics.second_derivatives import response
from ms_highway.planning.costs import Costs
from ms_highway.planning.human_models import HumanModel, scaled_prediction
from ms_highway.runtime.arrays import Controls, Flag, Index, Matrix, Scalar, State, Vector

HALVINGS = 60  # of the shift's bracket at most, beyond what float32 resolves

Bracket: TypeAlias = tuple[Scalar, Scalar, Index]
"""Bounds of the shift, and the number of halvings."""


def trust_region_step(
    quadratic: Matrix,
    linear: Vector,
    radius: Scalar,
    tolerance: Scalar = 0.0,
) -> Vector:
    """Maximise ``x^T A x / 2 + b^T x`` over the ball ``|x| <= radius``.

    In A's eigenbasis, with eigenvalues l, the maximiser is ``x = b / (shift + max(l) - l)`` for the smallest
    ``shift >= max(0, -max(l))`` that keeps x in the ball (More and Sorensen 1983). The shift is at most
    ``|b| / radius`` and is bisected until ``|x|`` is within ``tolerance * radius`` of the radius. Where b has no part
    along the top eigenvector (the "hard case"), x is extended along it to the boundary.
    """
    values, vectors = jnp.linalg.eigh(quadratic)
    along = vectors.T @ linear
    gaps = values[-1] - values
    least = jnp.maximum(0.0, -values[-1])

    def at(shift: Scalar) -> Vector:
        return jnp.where(along == 0, 0.0, along / (shift + gaps))

    def excess(shift: Scalar) -> Scalar:
        return jnp.sqrt(jnp.sum(at(shift) ** 2)) - radius

    def unfinished(bracket: Bracket) -> Flag:
        low, high, halvings = bracket
        return (halvings < HALVINGS) & (jnp.abs(excess((low + high) / 2)) > tolerance * radius)

    def halve(bracket: Bracket) -> Bracket:
        low, high, halvings = bracket
        middle = (low + high) / 2
        outside = excess(middle) > 0
        return jnp.where(outside, middle, low), jnp.where(outside, high, middle), halvings + 1

    interior = (values[-1] < 0) & (excess(least) <= 0)
    first = least, jnp.sqrt(jnp.sum(along**2)) / radius, jnp.int32(0)
    low, high, halvings = jax.lax.while_loop(unfinished, halve, first)
    inside = at(jnp.where(interior, least, (low + high) / 2))
    hard = (values[-1] > 0) & (halvings == HALVINGS)
    left = radius**2 - jnp.sum(inside**2)
    rest = jnp.where(hard & (left > 1e-5 * radius**2), jnp.sqrt(jnp.maximum(left, 0.0)), 0.0)
    return vectors @ inside.at[-1].add(jnp.where(along[-1] < 0, -rest, rest))


TRUST_TOLERANCE = 1e-3
"""Tolerance of the length of a trust-region step, as a share of the radius."""

RELEASED_TRUST_TOLERANCE = 0.05
"""The same tolerance in the solver of the released code."""


class RewardExpansion(NamedTuple):
    """Derivatives of the robot's reward in both players' controls, its own first, and the human's response."""

    gradient: Float[jax.Array, "both"]
    hessian: Float[jax.Array, "both both"]
    influence: Matrix  # J = d u_H / d u_R


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Quadratic(Rule):
    """Algorithm 1: switch to a rung with a positive gain, by a quadratic expansion over some steps of the last plan.

    The first step is planned with the first rung. After a step below the top, the rule checks the top rung, as if that
    had predicted the human control that was observed. If it does not switch up, and its last downward check from this
    rung was ``cooldown`` steps ago, it checks the rung below, with the prediction of that rung and without influence.
    Gains are additive: the gain for one human does not depend on the rungs of the others.

    * The rewards R_R and R_H of the steps are expanded around the last plan, from the state in which it was made. The
      first control of the robot is the executed one, and the first of the human the observed one; the others are those
      of the plan. With one step, this is the estimate of Sec. III-D. With all K steps, it is that of Sec. III-C, with
      the plan's expectation of the human in place of later observations.
    * On the way up, the alternative expects the same human controls, and their response to the robot's controls,
      ``J = du_H / du_R = -(d2R_H / du_H2)^-1 d2R_H / du_H du_R``. On the way down, it expects the controls that the
      rung below predicts, and no response.
    * ``delta u`` maximises the expansion within the trust region, whose radius bounds all 2 steps numbers together.
    * The gain is R_R after this change and the human's response J to it, less what the last plan earns: its first
      reward as observed, the others as expected.
    * The meta-MDP charges ``lambda T(M)`` for every step. Driving several steps takes as many plans, so
      ``steps lambda (T' - T)`` is subtracted from the gain.

    Attributes:
        costs: planning time of each rung [s]. If a time is NaN (unknown), no gain is estimated, and the rung stays.
        price: lambda, reward per second of planning.
        trust_radius: longest change of the scaled controls for which the expansion is trusted.
        trust_tolerance: tolerance of the length of ``delta u``, as a share of the radius; 0.05 in the released code.
        cooldown: least number of steps between two downward checks from the same rung.
        ladder: tuple of human models, cheapest first, see `ms_highway.planning.ladders.ladder` (static).
        steps: number of steps of the last plan that are expanded; None for the whole horizon (static).
    """

    costs: Costs
    price: Scalar
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})
    trust_radius: Scalar = 1.5
    trust_tolerance: Scalar = TRUST_TOLERANCE
    cooldown: Index = 3
    steps: int | None = field(default=1, metadata={"static": True})

    def decide(self, game: Game, memory: Memory, outcome: Outcome) -> Decision:
        """Switch to the top of the ladder, or one rung down, if that gains."""
        rungs, top = jnp.asarray(memory.rungs), len(self.ladder) - 1
        humans, places = jnp.arange(len(rungs)), jnp.arange(top + 1)
        waited = memory.step + 1 - jnp.asarray(memory.last_check)[humans, rungs]
        climbs = (rungs < top) & (memory.step > 0)
        checks = (rungs > 0) & (memory.step > 0) & (waited >= self.cooldown)

        def one(human: Index) -> tuple[Scalar, Scalar]:
            return self._gains(*with_human(game, outcome, human), rungs[human], climbs[human], checks[human])

        up, down = each_human(game, one)
        chosen = jnp.where(up > 0, top, jnp.where(down > 0, rungs - 1, rungs))
        checked = (checks & ~(up > 0))[:, None] & (places == rungs[:, None])
        last_check = jnp.where(checked, memory.step + 1, memory.last_check)
        ups = jnp.where(climbs[:, None] & (places == top), up[:, None], NOT_ESTIMATED)
        gains = jnp.where(places == rungs[:, None] - 1, down[:, None], ups)
        return Decision(memory._replace(rungs=chosen, last_check=last_check), gains, jnp.bool(False))

    def check(self) -> None:
        """See `ms_highway.choice.rule.Rule.check`; the number of steps must be positive."""
        super().check()
        if self.steps is not None and self.steps < 1:
            raise ValueError(f"Quadratic.steps is {self.steps}; give at least 1, or None for all")

    def _gains(self, game: Game, outcome: Outcome, rung: Index, climbs: Flag, checks: Flag) -> tuple[Scalar, Scalar]:
        """Estimate the gains of going up and down for one human; return `NOT_ESTIMATED` for unneeded ones."""
        ladder, costs, none = self.ladder, jnp.asarray(self.costs.each), jnp.float32(NOT_ESTIMATED)
        state = jnp.asarray(outcome.before)
        plan = outcome.plan
        observed = game.observed_payoff

        def estimate() -> tuple[Scalar, Scalar]:
            robot = jnp.asarray(plan.robot)[: self.steps].at[0].set(outcome.robot)
            human = jnp.asarray(plan.humans[0])[: self.steps].at[0].set(outcome.humans[0])
            later = step_rewards(game, observed, state, robot, human[None])[1:] if self.steps != 1 else jnp.zeros(0)
            earned = outcome.reward + jnp.sum(later)
            expansion = expand(game, state, robot.ravel(), human.ravel())

            def gain(expected: Controls, responds: bool, alternative: Index) -> Scalar:
                influence = expansion.influence if responds else jnp.zeros_like(expansion.influence)
                change = change_of_control(expansion, (expected - human).ravel(), influence, self)
                response = (expansion.influence @ change).reshape(human.shape)
                moved = robot + change.reshape(robot.shape)
                better = jnp.sum(step_rewards(game, observed, state, moved, (human + response)[None]))
                saved = costs[rung] - costs[alternative]
                return jnp.where(jnp.isnan(saved), none, better - earned + len(robot) * self.price * saved)

            def gain_down() -> Scalar:
                below = jnp.maximum(rung - 1, 0)
                models = [partial(scaled_prediction, model, game, state) for model in ladder[:-1] or ladder]
                return gain(jax.lax.switch(below, models)[: len(robot)], False, below)

            up = jax.lax.cond(climbs, lambda: gain(human, ladder[-1].responds, len(ladder) - 1), lambda: none)
            return up, jax.lax.cond(checks & ~(up > 0), gain_down, lambda: none)

        return jax.lax.cond(climbs | checks, estimate, lambda: (none, none))


@jax.jit
def expand(game: Game, state: State, robot: Vector, human: Vector) -> RewardExpansion:
    """Expand the rewards of both players in the controls of both, in one batch; each is seen from its own car."""
    payoff = game.observed_payoff
    n = len(robot)

    def earned(controls: Float[jax.Array, "both"], driver: Reward, state: State) -> Scalar:
        own, partner = controls.reshape(2, -1, 2)
        others = with_scripted(game, state, move(game, state[1], partner)[None])
        return replace(payoff, reward=driver).total(move(game, state[0], own), others)

    controls = jnp.stack([jnp.concatenate([robot, human]), jnp.concatenate([human, robot])])
    players = controls, game.players(), jnp.stack([state, swap_players(game, state)[1]])
    gradients, (hessian, mirrored) = (jax.vmap(derive(earned))(*players) for derive in (jax.grad, jax.hessian))
    human_bend = mirrored[:n, :n] - jnp.diag(jnp.tile(jnp.asarray(game.humans.comfort), n // 2))
    return RewardExpansion(gradients[0], hessian, response(game.influence, human_bend, mirrored[:n, n:]))


def change_of_control(expansion: RewardExpansion, surprise: Vector, influence: Matrix, rule: Quadratic) -> Vector:
    """Return ``delta u``, which leads from the present controls to the best ones under another model.

    Let g and H be the gradient and the Hessian of r_R in both players' controls, and d the human controls that the
    model expects less u_H. With the model's influence J', a change du of the robot's controls changes those of both by
    ``P du``, where ``P = [I; J']``. The expansion is ``du^T P^T H P du / 2 + (g + H [0; d])^T P du``.
    """
    n = len(surprise)
    both = jnp.concatenate([jnp.eye(n), influence])
    slope = expansion.gradient + expansion.hessian[:, n:] @ surprise
    quadratic, linear = both.T @ expansion.hessian @ both, both.T @ slope
    return trust_region_step(quadratic, linear, rule.trust_radius, rule.trust_tolerance)


Switching = Quadratic
"""Algorithm 1 with the paper's one-step estimate."""

WholeHorizon = partial(Quadratic, steps=None)
"""Algorithm 1 with the estimate over the whole horizon."""
