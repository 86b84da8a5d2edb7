"""Infer from each human's controls which model predicts this human best.

A human follows one model at a time and may change it from step to step (interacting
multiple models). As states are observed exactly, the filter of Blom and Bar-Shalom
(1988) is the forward pass of a hidden Markov model::

    p(m) <- sum over m' of P(m | m') p(m')
    p(m) <- p(m) N(u; u_m, diag(noise^2)) / sum

where u is the observed control, and u_m the control that model m predicts for this
step, see `next_controls`.
"""

from dataclasses import dataclass, replace

import jax
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
    Control,
    Controls,
    Index,
    ModelIndex,
    ModelProbabilities,
    SameArray,
    State,
)

RESPONDING = [
    ModelIndex(PACKAGE_MODELS.index("turn")),
    ModelIndex(PACKAGE_MODELS.index("tom")),
]
"""Models in which the human plans for its reward."""


@dataclass(frozen=True)
class InferenceSettings:
    """Set how the models that humans follow are inferred."""

    lookahead: int = 8
    """Steps of humans' plans at most; only the first one counts."""

    stay_probability: float = 0.98
    """Probability that a human keeps its model for 0.1 s. On average, a human keeps it
    for five seconds."""

    control_noise: tuple[float, float] = (0.005, 1.0)
    """Standard deviations of a human's controls from those of its model: curvature
    [1/m], acceleration [m/s^2]."""

    min_probability: float = 1e-3
    """Lower bound on the probability of each model. With it, the filter soon detects a
    change of model."""

    min_response: float = 0.3
    """Least probability of `RESPONDING` at which plans count on a human's response."""


INFERENCE = InferenceSettings()


def next_controls(
    game: Game,
    state: State,
    robot: Controls,
) -> Float[jax.Array, "humans models 2"]:
    """Return the next control of every human under each model, unscaled.

    * naive keeps the velocity.
    * idm keeps the heading and follows the car ahead in its lane, such as the robot;
      its desired speed is the limit.
    * turn and tom plan for the human's reward, as the robot believes it. Under turn,
      the robot keeps its velocity, under tom, it follows its plan. All others keep
      their velocity. Humans plan by gradient steps over some steps at most, see
      `InferenceSettings`: in Dense Merge this is closer to how they drive than shorter
      plans by Newton steps.

    Args:
        game: with the humans' rewards as the robot believes them.
        state: all cars.
        robot: scaled controls that the robot follows from this state on.
    """
    is_shortened = game.planner.horizon > INFERENCE.lookahead
    game = _with_short_plans(game)
    planner = game.planner

    def predict(human: Index) -> Float[jax.Array, "models 2"]:
        human_game, seen = swap_players(game, state, human)
        if is_shortened:
            start = constant_velocity(human_game, seen[0])
        else:
            start = jnp.zeros((planner.horizon, 2))

        def plan_first(robot: Controls) -> Control:
            """Return the first control of the human's plan against these controls."""
            others = robot[None]  # to the human, the robot is the only partner
            first_plan = Plan(start, others)
            solution = plan_against(human_game, seen, others, first_plan)
            own_controls = solution.plan.robot
            return own_controls[0] * planner.control_scale

        # The human plans for its reward, and expects one of these of the robot.
        robot_keeps_velocity = constant_velocity(human_game, seen[1])
        robot_follows_plan = robot[: planner.horizon]
        turn = plan_first(robot_keeps_velocity)
        tom = plan_first(robot_follows_plan)

        # The human does not plan.
        idm_game, idm_state = pair(game, state, human)
        idm = following_control(idm_game, idm_state)
        naive = keep_velocity(game.dynamics, seen[0])
        return jnp.stack([naive, idm, turn, tom])

    return each_human(game, predict)


def _with_short_plans(game: Game) -> Game:
    """Return the game with plans of gradient steps over a short horizon."""
    planner = game.planner
    steps = min(planner.horizon, INFERENCE.lookahead)
    if steps == planner.horizon and isinstance(planner.solver, Ascent):
        return game

    # Gradient steps that do not overshoot an optimum over this horizon.
    iterations, usual_size = gradient_steps(PlanningSettings(steps))
    largest_size = longest_step(steps, game.dynamics.time_step)
    step_size = jnp.minimum(usual_size, largest_size)
    solver = Ascent(step_size, iterations, smooth=planner.solver.smooth)

    short_planner = replace(planner, horizon=steps, solver=solver)
    return replace(game, planner=short_planner)


def updated_probabilities(
    probabilities: Float[SameArray, "*humans models"],
    predicted: Float[SameArray, "*humans models 2"],
    observed: Float[SameArray, "*humans 2"],
    time_step: float | Float[SameArray, ""],
) -> Float[SameArray, "*humans models"]:
    """Return the probabilities of the models after a step.

    A control that is not finite favours no model.

    Args:
        probabilities: before the step, with sum 1.
        predicted: control that each model predicts for the step, unscaled.
        observed: control of the human in the step, unscaled.
        time_step: duration of the step [s].
    """
    xp = probabilities.__array_namespace__()  # of NumPy or JAX

    # p(m) <- sum over m' of P(m | m') p(m'): a human may have changed its model.
    models = probabilities.shape[-1]
    keeps = INFERENCE.stay_probability ** (time_step / 0.1)
    mixed = keeps * probabilities + (1 - keeps) / models

    # log N(u; u_m, diag(noise^2)), without the terms that are the same for all models.
    noise = xp.asarray(INFERENCE.control_noise)
    error = (predicted - observed[..., None, :]) / noise
    log_likelihood = -xp.sum(error**2, axis=-1) / 2

    # A control that is not finite favours no model.
    is_finite = xp.isfinite(log_likelihood)
    known = xp.all(is_finite, axis=-1, keepdims=True)
    equal = xp.zeros_like(log_likelihood)
    log_likelihood = xp.where(known, log_likelihood, equal)

    # p(m) <- p(m) N(u; u_m, diag(noise^2)) / sum. Dividing all likelihoods by the
    # highest one rules out underflow.
    highest = xp.max(log_likelihood, axis=-1, keepdims=True)
    likelihood = xp.exp(log_likelihood - highest)
    joint = mixed * likelihood
    normalised = joint / xp.sum(joint, axis=-1, keepdims=True)

    # No model is excluded.
    lowest = xp.asarray(INFERENCE.min_probability)
    bounded = xp.maximum(normalised, lowest)
    return bounded / xp.sum(bounded, axis=-1, keepdims=True)


def equal_probabilities(humans: int) -> ModelProbabilities:
    """Return equal probabilities of all `PACKAGE_MODELS`: nothing was observed yet."""
    models = len(PACKAGE_MODELS)
    return np.full((humans, models), 1 / models, np.float32)


def infer_models(
    game: Game,
    probabilities: ModelProbabilities,
    before: State,
    after: State,
    robot: Controls,
) -> ModelProbabilities:
    """Return the probabilities of the models after a step.

    Args:
        game: game with the rewards that the robot believes the humans to have.
        probabilities: probabilities before the step.
        before: all cars before the step.
        after: all cars after it.
        robot: scaled controls of the robot's plan for this step and the following ones.
    """
    humans = slice(1, 1 + game.number)
    observed = recover_control(game.world, before[humans], after[humans])
    predicted = next_controls(game, before, robot)
    time_step = jnp.asarray(game.world.time_step)
    return updated_probabilities(probabilities, predicted, observed, time_step)


def likely_to_respond(
    probabilities: Float[SameArray, "humans models"],
) -> Bool[Array, "humans"]:
    """Return the humans on whose response plans may rely: turn or tom explains them."""
    responds = probabilities[:, RESPONDING].sum(axis=1)
    return responds >= INFERENCE.min_response
