"""Infer which model predicts each human best, from its observed controls: interacting multiple models.

A human follows one of the models at a time and may change it from step to step; states are observed exactly, so that
the filter of Blom and Bar-Shalom (1988) is the forward pass of a hidden Markov model::

    p(m) <- sum over m' of P(m | m') p(m'),    p(m) <- p(m) N(u; u_m, diag(noise^2)) / sum

with the observed control u and the control u_m that model m predicted for this step.
"""

from jaxtyping import Float

from ms_highway.runtime.arrays import SameArray

__all__ = ["KEEPS", "LEAST", "NOISE", "updated_belief"]

KEEPS = 0.98
"""Probability that a human keeps to its model for 0.1 s, so for five seconds on average."""

NOISE = (0.005, 1.0)
"""Standard deviations of humans around the controls of their model: curvature [1/m], acceleration [m/s^2]."""

LEAST = 1e-3
"""Probability that no model falls below, so that a human who changes is noticed soon."""


def updated_belief(
    belief: Float[SameArray, "*humans models"],
    predicted: Float[SameArray, "*humans models 2"],
    observed: Float[SameArray, "*humans 2"],
    time_step: float | Float[SameArray, ""],
    noise: tuple[float, float] = NOISE,
) -> Float[SameArray, "*humans models"]:
    """Return the probabilities of the models after a step; where a control is not finite, only the mixing is done.

    Args:
        belief: probabilities before the step, sum 1.
        predicted: control of each model for the step, unscaled.
        observed: control in the step, unscaled.
        time_step: duration of the step [s].
        noise: see `NOISE`.
    """
    xp = belief.__array_namespace__()
    models = belief.shape[-1]
    keeps = KEEPS ** (time_step / 0.1)
    mixed = keeps * belief + (1 - keeps) / models
    off = (predicted - observed[..., None, :]) / xp.asarray(noise)
    log_likelihood = -xp.sum(off**2, axis=-1) / 2
    known = xp.all(xp.isfinite(log_likelihood), axis=-1, keepdims=True)
    log_likelihood = xp.where(known, log_likelihood, xp.zeros_like(log_likelihood))
    joint = mixed * xp.exp(log_likelihood - xp.max(log_likelihood, axis=-1, keepdims=True))
    joint = xp.maximum(joint / xp.sum(joint, axis=-1, keepdims=True), xp.asarray(LEAST))
    return joint / xp.sum(joint, axis=-1, keepdims=True)
