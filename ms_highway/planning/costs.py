"""Say what planning time costs: T(M) of every model, and of plans by them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import jax
import numpy as np
from jaxtyping import Float, Int

from ms_highway.game.game import Game
from ms_highway.geometry.curve import namespace
from ms_highway.planning.compiled_plans import CompiledPlans, checked_state
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import Array, Scalar, State
from ms_highway.runtime.process import refuse_after_fork


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Costs:
    """Planning time, additive in the humans: ``T = base + sum_i each[rung_i]`` [s].

    It is a pytree: JAX does not compile again if only the numbers change.

    Attributes:
        base: of a plan in which the first rung predicts every human; 0 with one human.
        each: time that a human adds under each rung, NaN where it is unknown; with one
            human, T(M) of the whole plan.
        names: of the models of the rungs (static).
    """

    base: Scalar
    each: Float[Array, "rungs"]
    names: tuple[str, ...] = field(metadata={"static": True})

    @classmethod
    def of(cls, seconds: Mapping[str, float], humans: int) -> "Costs":
        """Return the costs of models by name; the first one is the first rung.

        Args:
            seconds: T(M) by name, of plans with one human predicted by the model, and
                all others by the first rung.
            humans: number of humans.

        Raises:
            ValueError: if the seconds are not given by name.
        """
        if not isinstance(seconds, Mapping):
            remedy = "give seconds by name, such as {'naive': 0.09, 'tom': 0.37}"
            raise ValueError(f"Costs.of is given {seconds!r}; {remedy}")
        names = tuple(seconds)
        whole = np.array([seconds[name] for name in names], dtype=float)

        # With one human, T(M) is of the whole plan.
        base = 0.0
        if humans > 1 and names:
            base = float(whole[0])
        each = whole - base
        return cls(base, each, names)

    @property
    def seconds(self) -> dict[str, float]:
        """Known values of T(M) by name [s], in the form that `of` takes."""
        whole = self.base + np.asarray(self.each)
        known = ~np.isnan(whole)
        by_rung = zip(self.names, whole.tolist(), known, strict=True)
        return {name: seconds for name, seconds, is_known in by_rung if is_known}

    def select(self, names: Iterable[str]) -> "Costs":
        """Return the costs of these models in this order, NaN where unknown."""
        wanted = tuple(names)
        known = self._each_by_name()
        each = np.array([known.get(name, np.nan) for name in wanted])
        return Costs(self.base, each, wanted)

    def of_models(self, names: Sequence[str]) -> float | None:
        """Return T of a plan that predicts the humans by these models.

        It is None if T is unknown.
        """
        each = self._each_by_name()
        are_known = each.keys() >= {*names}
        if not are_known:
            return None
        added = sum(each[name] for name in names)
        total = float(self.base + added)
        if np.isnan(total):
            return None
        return total

    def total(self, rungs: Int[Array, "*plans humans"]) -> Float[Array, "*plans"]:
        """Return T of plans that predict humans by these rungs.

        The result is an array of NumPy or JAX, like the rungs; NaN where T is unknown.
        """
        xp = namespace(rungs)
        by_rung = xp.asarray(self.each)
        by_human = by_rung[rungs]  # [*plans, humans]
        return self.base + xp.sum(by_human, axis=-1)

    def _each_by_name(self) -> dict[str, float]:
        """Return the time that a human adds under each model."""
        each = np.asarray(self.each).tolist()
        return dict(zip(self.names, each, strict=True))


UNKNOWN = Costs(0.0, np.zeros(0), ())
"""Costs before anything is measured."""


def measure_costs(
    game: Game,
    ladder: Sequence[HumanModel],
    state: State,
    quantile: float,
    way_out: bool,
) -> Costs:
    """Measure T on this machine, by warm plans with all humans on the same rung.

    Args:
        game: that is played.
        ladder: human models.
        state: all cars.
        quantile: of the seconds of `CompiledPlans.repeats` plans on each rung, close to
            1 for budgets.
        way_out: whether the time includes the check of the way out.

    Raises:
        ValueError: if the state is not a finite array [cars, 4] of two cars or more.
    """
    refuse_after_fork()
    plans = CompiledPlans(game, ladder)
    now = checked_state(state)
    plans.warm_up(now, way_out)

    def once(rung: int) -> float:
        rungs = [rung] * game.number
        solution, planning = plans.plan(now, rungs)
        if not way_out:
            return planning
        control = solution.plan.robot[0]
        _, checking = plans.keep_way_out(now, control)
        return planning + checking

    # Seconds of whole plans, with all humans on each rung.
    times = []  # [rungs, repeats]
    for rung in range(len(ladder)):
        repeated = [once(rung) for _ in range(plans.repeats)]
        times.append(repeated)
    whole = np.quantile(times, quantile, axis=1)

    # Seconds if only one human is on the rung; no rung takes less than the first one.
    first = whole[0]
    added = np.maximum(whole - first, 0.0) / game.number
    names = [model.name for model in ladder]
    seconds = dict(zip(names, first + added, strict=True))
    return Costs.of(seconds, game.number)
