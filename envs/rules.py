"""Read the configurations of the controllers that choose models online."""

from dataclasses import replace
from typing import Annotated, Any, ClassVar

from msgspec import Meta, field

from ms_highway.choice.budget import Budget, OneStepGains
from ms_highway.choice.nearest import Nearest
from ms_highway.choice.quadratic import RELEASED_TRUST_TOLERANCE, TRUST_TOLERANCE, Quadratic
from ms_highway.choice.rule import NEVER
from ms_highway.choice.values import SHIPPED_VALUES, load_values
from ms_highway.envs.configuration import NotNegative, Positive
from ms_highway.envs.controllers import ControllerSettings, Start

ONE_STEP = "one_step"  # name of the gains of budgets that Algorithm 1 estimates

Cooldown = Annotated[int, Meta(ge=1, le=-NEVER, description=f"it must be a number of steps from 1 to {-NEVER}")]
File = Annotated[str | None, Meta(description="say 'shipped' or name a file of learned values")]


class SwitchingSettings(ControllerSettings, frozen=True, tag="switching"):
    """Algorithm 1 chooses from the ladder, at a price per second of planning; see `Quadratic` for its numbers."""

    example = "0.1"
    price: NotNegative = field(name="lambda")
    cooldown: Cooldown = Quadratic.cooldown
    trust_radius: Positive = Quadratic.trust_radius
    horizon_steps: ClassVar[int | None] = 1

    def rule(self, start: Start) -> Any:
        """See `ControllerSettings.rule`."""
        tolerance = RELEASED_TRUST_TOLERANCE if start.semantics == "released" else TRUST_TOLERANCE
        numbers = self.trust_radius, tolerance, self.cooldown, self.horizon_steps
        return Quadratic(start.costs, self.price, start.ladder, *numbers)


class HorizonSettings(SwitchingSettings, frozen=True, tag="horizon"):
    """Algorithm 1 chooses with gains that are estimated over the whole horizon."""

    example = "0.1"
    horizon_steps = None


class LearnedSettings(ControllerSettings, frozen=True, tag="learned"):
    """A learned value of computation chooses, at a price per second of planning.

    Attributes:
        values: ``"shipped"`` or a file of `ms_highway.choice.values`; ``""`` and None mean shipped.
    """

    example = "0.1"
    price: NotNegative = field(name="lambda")
    values: File = None

    def __post_init__(self) -> None:
        load_values(self.values or SHIPPED_VALUES)

    def rule(self, start: Start) -> Any:
        """See `ControllerSettings.rule`."""
        return _learned(self.values, start, self.price)


def _learned(values: str | None, start: Start, price: float) -> Any:
    one = "physical" if start.semantics == "physical" else "pair"
    learned = load_values(values or SHIPPED_VALUES, "several" if start.humans > 1 else one)
    return learned.rule(start.ladder, start.costs, price)


class BudgetSettings(ControllerSettings, frozen=True, tag="budget"):
    """What gains most within the time of a cycle.

    Attributes:
        milliseconds: of a cycle, decision and plan.
        values: that tell the gains: ``"one_step"`` for those of Algorithm 1, or what `LearnedSettings` takes.
    """

    quantile = 0.99
    example = "20"
    milliseconds: Positive
    values: File = None

    def __post_init__(self) -> None:
        if self.values != ONE_STEP:
            load_values(self.values or SHIPPED_VALUES)

    @property
    def budget(self) -> float:
        """See `ControllerSettings`."""
        return self.milliseconds * 1e-3

    def rule(self, start: Start) -> Any:
        """See `ControllerSettings.rule`."""
        if self.values == ONE_STEP:
            gains: Any = OneStepGains(Quadratic(start.costs, 0.0, start.ladder))
        else:
            gains = replace(_learned(self.values, start, 0.0), cautious=False)
        return Budget(gains, start.costs, self.budget)


class NearestSettings(ControllerSettings, frozen=True, tag="nearest"):
    """The top rung for the nearest humans, and the first for all others."""

    example = "2"
    count: Annotated[int, Meta(ge=0, description="it must be a number of humans, 0 or more")]

    def rule(self, start: Start) -> Any:
        """See `ControllerSettings.rule`."""
        return Nearest(self.count, start.ladder)
