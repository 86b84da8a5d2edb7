"""Check the parts of a user's rules and their results.

Results of the package's own parts are not checked. Where JAX traces a decision, numbers
are not known yet: `refuse_rungs` checks them afterwards.
"""

import reprlib
from collections.abc import Iterable
from typing import NamedTuple, TypeAlias

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Int

from ms_highway.choice.records import NOT_ESTIMATED, Estimate
from ms_highway.planning.costs import Costs
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import Array, Gains, Rungs, Scalar

NO_GAINS = int(np.iinfo(np.int32).min)
"""Rung that stands for gains that are no numbers. JAX cannot raise an error where it
traces a decision, so that `refuse_rungs` raises it afterwards.
"""

Numbers: TypeAlias = jax.Array | np.ndarray


class RuleNames(NamedTuple):
    """Names of the parts of a rule, for messages.

    Attributes:
        chooser: of its class.
        estimator: of its class; empty without one.
        models: of the rungs, in order.
    """

    chooser: str
    estimator: str
    models: tuple[str, ...]


# Parts


def is_part_of_package(part: object) -> bool:
    """Return whether a part of a rule is the package's own."""
    return type(part).__module__.partition(".")[0] == __name__.partition(".")[0]


def check_fields(part: object) -> None:
    """Check that JAX knows the fields of a part.

    Raises:
        ValueError: if it does not know them.
    """
    if jax.tree_util.all_leaves([part]):
        remedy = (
            "write @jax.tree_util.register_dataclass above its @dataclass(frozen=True)"
        )
        raise ValueError(
            f"JAX cannot compile for the rule {type(part).__name__}, as it does not"
            f" know its fields; {remedy}"
        )


def check_ladder(ladder: Iterable[object]) -> None:
    """Check that all rungs are human models.

    Raises:
        ValueError: naming the first one that is none.
    """
    for model in ladder:
        if not isinstance(model, HumanModel):
            raise ValueError(
                f"the ladder has {model!r}, which is no human model; make one of names"
                " with `ladder`"
            )


def check_costs(costs: object, names: tuple[str, ...]) -> None:
    """Check that there is one cost for each rung, in the order of these names.

    Raises:
        ValueError: if there is not.
    """
    if not isinstance(costs, Costs):
        remedy = "make them of seconds by name with ms_highway.Costs.of"
        raise ValueError(f"the costs are {shown(costs)}; {remedy}")
    each = np.asarray(costs.each)
    if costs.names != names or each.shape != (len(names),):
        known = ", ".join(costs.names) or "no model"
        remedy = "in this order, as costs.select(names) does"
        raise ValueError(
            f"the costs are {each.tolist()} for {known}; give one for each of"
            f" {', '.join(names)}, {remedy}"
        )


def check_not_negative(price: Scalar, costs: Costs) -> None:
    """Check that neither a price, or several, nor the costs are negative.

    Raises:
        ValueError: if one is, or if a price is no number.
    """
    prices = np.asarray(price)
    each = np.asarray(costs.each)
    if not (prices >= 0).all() or (each < 0).any():
        raise ValueError(
            f"the price is {prices} and the costs are {each.tolist()}; neither may be"
            " negative"
        )


# Gains


def checked_estimate(
    names: RuleNames,
    estimate: object,
    shape: tuple[int, ...],
) -> Estimate:
    """Return the estimate of a user's estimator, with gains in single precision.

    Args:
        names: of the rule.
        estimate: what the estimator returned.
        shape: of gains, [humans, rungs].

    Raises:
        ValueError: if it is no estimate, if the gains are not one real number for each
            human and rung, or if ``failed`` is not one boolean.
    """
    name = names.estimator
    if not isinstance(estimate, Estimate):
        remedy = "return an Estimate(gains, failed)"
        raise ValueError(f"the estimator {name} returned {shown(estimate)}; {remedy}")

    # Gains: one real number for each human and rung.
    remedy = f"return one for each human and rung, an array {shape}"
    gains = _as_numbers(estimate.gains)
    real_types = ("bool", "integral", "real floating")
    if gains is None or not jnp.isdtype(gains.dtype, real_types):
        found = shown(estimate.gains)
        raise ValueError(f"the estimator {name} returned the gains {found}; {remedy}")
    if gains.shape != shape:
        message = f"the estimator {name} returned gains of shape {gains.shape}"
        raise ValueError(f"{message}; {remedy}")
    single = jnp.asarray(gains, jnp.float32)
    if not isinstance(single, jax.core.Tracer) and are_no_gains(single).any():
        raise ValueError(_gains_message(names))

    # Whether they failed: one flag.
    failed = _as_numbers(estimate.failed)
    if failed is None or failed.shape != () or failed.dtype != bool:
        found = shown(estimate.failed)
        remedy = "return one boolean for all humans, such as flags.any()"
        raise ValueError(f"the estimator {name} returned failed={found}; {remedy}")
    return Estimate(single, failed)


def are_no_gains(gains: Gains) -> Bool[Array, "humans rungs"]:
    """Return where gains are neither numbers nor `NOT_ESTIMATED`."""
    return ~jnp.isfinite(gains) & (gains != NOT_ESTIMATED)


def _gains_message(names: RuleNames) -> str:
    remedy = "return -inf (NOT_ESTIMATED) where no gain is known"
    return (
        f"the estimator {names.estimator} returned gains that are NaN or infinite;"
        f" {remedy}"
    )


# Rungs


def checked_rungs(names: RuleNames, returned: object, humans: int) -> Rungs:
    """Return what a user's chooser returned as rungs.

    Args:
        names: of the rule.
        returned: what the chooser returned.
        humans: number of humans.

    Raises:
        ValueError: if it is not one whole number for each human, or if these are known
            now and are no rungs.
    """
    remedy = _rungs_remedy(names, humans)
    rungs = _as_numbers(returned)
    if rungs is None:
        raise ValueError(
            f"the rule {names.chooser} returned {shown(returned)}; {remedy}"
        )

    # One whole number for each human.
    traced = isinstance(rungs, jax.core.Tracer)
    whole = jnp.isdtype(rungs.dtype, ("bool", "integral"))
    if rungs.shape != (humans,) or not whole:
        found = shown(rungs) if traced else f"the rungs {rungs.tolist()}"
        raise ValueError(f"the rule {names.chooser} returned {found}; {remedy}")

    # Of the ladder.
    if not traced:
        refuse_rungs(names, rungs)
    return rungs.__array_namespace__().asarray(rungs, dtype=np.int32)


def in_ladder(models: int, rungs: Int[Array, "*shape"]) -> Bool[Array, "*shape"]:
    """Return where numbers are rungs of a ladder of some models."""
    return (rungs >= 0) & (rungs < models)


def refuse_rungs(names: RuleNames, rungs: Int[Array, "*steps humans"]) -> None:
    """Refuse numbers that a rule chose and that are no rungs of its ladder.

    Raises:
        ValueError: naming the rule and the first such numbers, or the estimator whose
            gains were no numbers.
    """
    rungs = np.asarray(rungs)
    if (rungs == NO_GAINS).any():
        raise ValueError(_gains_message(names))
    wrong = ~in_ladder(len(names.models), rungs).all(axis=-1)
    if wrong.any():
        first = rungs[wrong][0] if rungs.ndim > 1 else rungs
        remedy = _rungs_remedy(names, rungs.shape[-1])
        raise ValueError(
            f"the rule {names.chooser} returned the rungs {first.tolist()}; {remedy}"
        )


def _rungs_remedy(names: RuleNames, humans: int) -> str:
    rungs = ", ".join(f"{rung} for {model}" for rung, model in enumerate(names.models))
    return f"return one whole number for each human, {humans} in all: {rungs}"


# What anybody may return


def shown(returned: object) -> str:
    """Return what a part returned, in short and on one line, for messages."""
    if isinstance(returned, jax.core.Tracer):
        return f"{returned.dtype} numbers of shape {returned.shape}"
    return " ".join(reprlib.repr(returned).split())


def _as_numbers(returned: object) -> Numbers | None:
    """Return what a part returned as an array; None if it holds no numbers."""
    if isinstance(returned, np.ndarray):
        return returned if returned.dtype.kind in "biufc" else None
    try:
        return jnp.asarray(returned)
    except (TypeError, ValueError, OverflowError):
        return None
