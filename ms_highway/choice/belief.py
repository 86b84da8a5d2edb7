"""Infer from each human's controls which model predicts this human best: interacting multiple models.

A human follows one model at a time and may change it from step to step. As states are observed exactly, the filter of
Blom and Bar-Shalom (1988) is the forward pass of a hidden Markov model::

    p(m) <- sum over m' of P(m | m') p(m'),    p(m) <- p(m) N(u; u_m, diag(noise^2)) / sum

where u is the observed control, and u_m the control that model m predicts for this step, see
`next_controls`.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float

from ms_highway.game.dynamics import keep_velocity, recover_control
from ms_highway.game.game import Game, constant_velocity, each_human, pair, swap_players
from ms_highway.numerics.solvers import (
    Ascent,
    PlanningSettings,
    gradient_steps,
    longest_step,
)
from ms_highway.planning.human_models import following_control
from ms_highway.planning.joint import plan_against
from ms_highway.planning.ladders import PACKAGE_MODELS
from ms_highway.planning.plans import Plan
from ms_highway.runtime.arrays import (
    Array,
    Belief,
    Control,
    Controls,
    Index,
    SameArray,
    State,
)

LOOKAHEAD = 8  # steps of humans' plans at most; only the first one counts

STAY_PROBABILITY = 0.98
"""Probability that a human keeps its model for 0.1 s. On average, a human keeps it for
five seconds.
"""
CONTROL_NOISE = (0.005, 1.0)
"""Standard deviations of a human's controls from those of its model: curvature [1/m],
acceleration [m/s^2].
"""
MIN_PROBABILITY = 1e-3
"""Lower bound on the probability of each model. With it, the filter soon detects a
change of model.
"""
MIN_RESPONSE = (
    0.3  # least probability of `RESPONDING` at which plans count on a human's response
)
RESPONDING = [
    PACKAGE_MODELS.index(name) for name in ("turn", "tom")
]  # in both, the human plans for its reward


def next_controls(
    game: Game, state: State, robot: Controls
) -> Float[Any, "humans models 2"]:
    """Return the next control of every human under each model, unscaled.

    * naive keeps the velocity.
    * idm keeps the heading and follows the car ahead in its lane, such as the robot;
      its desired speed is the limit.
    * turn and tom plan for the human's reward, as the robot believes it. Under turn,
      the robot keeps its velocity, under tom, it follows its plan. All others keep
      their velocity. Humans plan by gradient steps over `LOOKAHEAD` steps at most: in
      Dense Merge this is closer to how they drive than shorter plans by Newton steps.

    Args:
        game: with the humans' rewards as the robot believes them.
        state: all cars.
        robot: scaled controls that the robot follows from this state on.
    """
    planner = game.planner
    shortened = planner.horizon > LOOKAHEAD
    if shortened or not isinstance(planner.solver, Ascent):
        steps = min(planner.horizon, LOOKAHEAD)
        iterations, usual = gradient_steps(PlanningSettings(steps))
        length = jnp.minimum(usual, longest_step(steps, game.dynamics.time_step))
        solver = Ascent(length, iterations, smooth=planner.solver.smooth)
        planner = replace(planner, horizon=steps, solver=solver)
    game = replace(game, planner=planner)

    def predict(human: Index) -> Float[Any, "models 2"]:
        own, seen = swap_players(game, state, human)
        start = (
            constant_velocity(own, seen[0])
            if shortened
            else jnp.zeros((planner.horizon, 2))
        )

        def answer(robot: Controls) -> Control:
            solution = plan_against(own, seen, robot[None], Plan(start, robot[None]))
            return solution.plan.robot[0] * planner.control_scale

        answers = [
            answer(each)
            for each in (constant_velocity(own, seen[1]), robot[: planner.horizon])
        ]
        following = following_control(*pair(game, state, human))
        return jnp.stack([keep_velocity(game.dynamics, seen[0]), following, *answers])

    return each_human(game, predict)


def updated_belief(
    belief: Float[SameArray, "*humans models"],
    predicted: Float[SameArray, "*humans models 2"],
    observed: Float[SameArray, "*humans 2"],
    time_step: float | Float[SameArray, ""],
) -> Float[SameArray, "*humans models"]:
    """Return the probabilities of the models after a step. A control that is not finite
    favours no model.

    Args:
        belief: probabilities before the step, with sum 1.
        predicted: control that each model predicts for the step, unscaled.
        observed: control of the human in the step, unscaled.
        time_step: duration of the step [s].
    """
    xp = belief.__array_namespace__()
    models = belief.shape[-1]
    keeps = STAY_PROBABILITY ** (time_step / 0.1)
    mixed = keeps * belief + (1 - keeps) / models
    off = (predicted - observed[..., None, :]) / xp.asarray(CONTROL_NOISE)
    log_likelihood = -xp.sum(off**2, axis=-1) / 2
    known = xp.all(xp.isfinite(log_likelihood), axis=-1, keepdims=True)
    log_likelihood = xp.where(known, log_likelihood, xp.zeros_like(log_likelihood))
    joint = mixed * xp.exp(
        log_likelihood - xp.max(log_likelihood, axis=-1, keepdims=True)
    )
    joint = xp.maximum(
        joint / xp.sum(joint, axis=-1, keepdims=True), xp.asarray(MIN_PROBABILITY)
    )
    return joint / xp.sum(joint, axis=-1, keepdims=True)


def first_belief(humans: int) -> Belief:
    """Return equal probabilities of all `PACKAGE_MODELS`, as nothing was observed yet."""
    return np.full((humans, len(PACKAGE_MODELS)), 1 / len(PACKAGE_MODELS), np.float32)


def infer(
    game: Game, belief: Belief, before: State, after: State, robot: Controls
) -> Belief:
    """Return the probabilities of the models after a step.

    Args:
        game: game with the rewards that the robot believes the humans to have.
        belief: probabilities before the step.
        before: all cars before the step.
        after: all cars after it.
        robot: scaled controls of the robot's plan for this step and the following ones.
    """
    last = 1 + game.number
    observed = recover_control(game.world, before[1:last], after[1:last])
    return updated_belief(
        belief,
        next_controls(game, before, robot),
        observed,
        jnp.asarray(game.world.time_step),
    )


def counted_on(belief: Float[SameArray, "humans models"]) -> Bool[Array, "humans"]:
    """Return which humans can be counted on to respond: those whose controls turn and
    tom explain.
    """
    return belief[:, RESPONDING].sum(axis=1) >= MIN_RESPONSE
