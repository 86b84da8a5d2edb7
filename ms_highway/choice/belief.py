"""Infer which model predicts each human best, from its observed controls: interacting multiple models.

A human follows one of the models at a time and may change it from step to step; states are observed exactly, so that
the filter of Blom and Bar-Shalom (1988) is the forward pass of a hidden Markov model::

    p(m) <- sum over m' of P(m | m') p(m'),    p(m) <- p(m) N(u; u_m, diag(noise^2)) / sum

with the observed control u and the control u_m that model m predicted for this step.
"""

import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float

from ms_highway.game.dynamics import recover_control
from ms_highway.game.game import Game
from ms_highway.planning.hypotheses import next_controls
from ms_highway.planning.ladders import PACKAGE_MODELS
from ms_highway.runtime.arrays import Array, Belief, Controls, SameArray, State

STAY_PROBABILITY = 0.98
"""Probability that a human keeps to its model for 0.1 s, so for five seconds on average."""

CONTROL_NOISE = (0.005, 1.0)
"""Standard deviations of humans around the controls of their model: curvature [1/m], acceleration [m/s^2]."""

MIN_PROBABILITY = 1e-3
"""Probability that no model falls below, so that a human who changes is noticed soon."""

MIN_RESPONSE = 0.3  # probability of the models below which nobody counts on a human
RESPONDING = [PACKAGE_MODELS.index(name) for name in ("turn", "tom")]  # that explain a human who minds its reward


def updated_belief(
    belief: Float[SameArray, "*humans models"],
    predicted: Float[SameArray, "*humans models 2"],
    observed: Float[SameArray, "*humans 2"],
    time_step: float | Float[SameArray, ""],
) -> Float[SameArray, "*humans models"]:
    """Return the probabilities of the models after a step; where a control is not finite, only the mixing is done.

    Args:
        belief: probabilities before the step, sum 1.
        predicted: control of each model for the step, unscaled.
        observed: control in the step, unscaled.
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
    joint = mixed * xp.exp(log_likelihood - xp.max(log_likelihood, axis=-1, keepdims=True))
    joint = xp.maximum(joint / xp.sum(joint, axis=-1, keepdims=True), xp.asarray(MIN_PROBABILITY))
    return joint / xp.sum(joint, axis=-1, keepdims=True)


def first_belief(humans: int) -> Belief:
    """Return the probabilities before anything was seen, the same for all of `PACKAGE_MODELS`."""
    return np.full((humans, len(PACKAGE_MODELS)), 1 / len(PACKAGE_MODELS), np.float32)


def infer(game: Game, belief: Belief, before: State, after: State, robot: Controls) -> Belief:
    """Return the probabilities of the models after a step.

    Args:
        game: with the humans' rewards as the robot believes them.
        belief: probabilities before the step.
        before: all cars before the step.
        after: all cars after it.
        robot: scaled controls that the robot followed from there on.
    """
    last = 1 + game.number
    observed = recover_control(game.world, before[1:last], after[1:last])
    return updated_belief(belief, next_controls(game, before, robot), observed, jnp.asarray(game.world.time_step))


def counted_on(belief: Float[SameArray, "humans models"]) -> Bool[Array, "humans"]:
    """Return which humans can be counted on to respond: all but those whose actions turn and tom do not explain."""
    return belief[:, RESPONDING].sum(axis=1) >= MIN_RESPONSE
