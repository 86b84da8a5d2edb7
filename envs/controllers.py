"""The controllers of a robot: their configurations by type; for short names see `ms_highway.envs.short_names`."""

from collections.abc import Mapping
from dataclasses import replace
from math import nan
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from msgspec import Meta, Struct, field

from ms_highway.choice.budget import Budget, OneStepGains
from ms_highway.choice.nearest import Nearest
from ms_highway.choice.quadratic import RELEASED_TRUST_TOLERANCE, TRUST_TOLERANCE, Quadratic
from ms_highway.choice.rule import NEVER, Order
from ms_highway.choice.values import SHIPPED_VALUES, load_values
from ms_highway.envs.configuration import NotNegative, Positive, read
from ms_highway.game.scenario import Semantics
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import HumanModel, human_model, is_model, model_names
from ms_highway.runtime import retired

PLACE = "config['controller']"
ONE_STEP = "one_step"  # name of the gains of budgets that Algorithm 1 estimates
ROUNDING = 1e-6  # how far a sum of shares may be from 1

Models = Annotated[tuple[str, ...], Meta(min_length=1, description="give a list of human models")]
Shares = Annotated[
    dict[str, NotNegative],
    Meta(min_length=1, description="give the share of each model, such as {'naive': 0.7, 'tom': 0.3}"),
]
Cooldown = Annotated[int, Meta(ge=1, le=-NEVER, description=f"it must be a number of steps from 1 to {-NEVER}")]
File = Annotated[str | None, Meta(description="say 'shipped' or name a file of learned values")]


class Start(NamedTuple):
    """What a rule is built from when an episode starts.

    Attributes:
        ladder: human models to choose from, cheapest first.
        costs: of plans with them, NaN where no rule needs them.
        semantics: of the scenario.
        humans: their number.
        steps: of the episode.
        random: what is drawn from.
    """

    ladder: tuple[HumanModel, ...]
    costs: Costs
    semantics: Semantics
    humans: int
    steps: int
    random: np.random.Generator


class ControllerSettings(Struct, frozen=True, kw_only=True, tag_field="type"):
    """What a controller's configuration says.

    Attributes:
        belief: whether it infers which model predicts each human, see `ms_highway.choice.belief`.
        quantile: of planning times, by which costs are measured.
        chooses: whether a rule chooses from the ladder.
    """

    quantile: ClassVar[float] = 0.5
    chooses: ClassVar[bool] = True
    belief: bool = False

    @property
    def price(self) -> float:
        """Lambda, NaN where no rule chooses at one."""
        return nan

    @property
    def budget(self) -> float | None:
        """Time of a cycle [s], None without one."""
        return None

    def names(self) -> tuple[str, ...]:
        """The names of the human models that are known when the episode starts."""
        return ()

    def rule(self, start: Start) -> Any:
        """Return the `ms_highway.choice.rule.Rule` of an episode."""
        raise NotImplementedError


class OrderSettings(ControllerSettings, frozen=True):
    """Plans each step with models that are known when the episode starts."""

    chooses: ClassVar[bool] = False

    def __post_init__(self) -> None:
        for name in self.names():
            if not is_model(name):
                raise ValueError(f"{PLACE} names {name!r}; the human models are {model_names()}")

    def table(self, steps: int, humans: int, random: np.random.Generator) -> np.ndarray:
        """Return the names of the humans' models in every step, [steps, humans], or one for all humans, [steps, 1]."""
        return np.array(self.names())[:, None]

    def rule(self, start: Start) -> Any:
        """See `ControllerSettings.rule`."""
        table = self.table(start.steps, start.humans, start.random)
        names = list(dict.fromkeys(table.ravel().tolist()))
        return Order(np.vectorize(names.index)(table), tuple(map(human_model, names)))


class FixedSettings(OrderSettings, frozen=True, tag="fixed"):
    """Always the same model."""

    model: str

    def names(self) -> tuple[str, ...]:
        """See `ControllerSettings.names`."""
        return (self.model,)


class ScheduleSettings(OrderSettings, frozen=True, tag="schedule"):
    """A model per step, the last one is kept; ``tom/naive`` stands for a model of each human."""

    models: Models

    def names(self) -> tuple[str, ...]:
        """See `ControllerSettings.names`."""
        return tuple(name for step in self.models for name in step.split("/"))

    def table(self, steps: int, humans: int, random: np.random.Generator) -> np.ndarray:
        """See `OrderSettings.table`.

        Raises:
            ValueError: where a step names several models, but not as many as there are humans.
        """
        rows = [step.split("/") for step in self.models]
        if wrong := {len(row) for row in rows} - {1, humans}:
            remedy = "name one for all of them in a step, or one for each"
            raise ValueError(f"{PLACE}['models'] has {min(wrong)} models for {humans} humans; {remedy}")
        return np.array([row * (humans // len(row)) for row in rows])


class PeriodSettings(ScheduleSettings, frozen=True, tag="period"):
    """A model per step, repeated to the end of the episode."""

    def table(self, steps: int, humans: int, random: np.random.Generator) -> np.ndarray:
        """See `OrderSettings.table`."""
        return np.resize(super().table(steps, humans, random), (steps, humans))


class RandomSettings(OrderSettings, frozen=True, tag="random"):
    """A model for every human and step, drawn when the episode starts."""

    shares: Shares

    def __post_init__(self) -> None:
        super().__post_init__()
        total = sum(self.shares.values())
        if abs(total - 1) > ROUNDING:
            raise ValueError(f"{PLACE}['shares'] sum to {total:g}; change one, so that they sum to 1")

    def names(self) -> tuple[str, ...]:
        """See `ControllerSettings.names`."""
        return tuple(name for name, share in self.shares.items() if share > 0)

    def table(self, steps: int, humans: int, random: np.random.Generator) -> np.ndarray:
        """See `OrderSettings.table`."""
        shares = np.array([self.shares[name] for name in self.names()])
        return random.choice(self.names(), size=(steps, humans), p=shares / shares.sum())


class SwitchingSettings(ControllerSettings, frozen=True, tag="switching"):
    """Algorithm 1 chooses from the ladder, at a price per second of planning; see `Quadratic` for its numbers."""

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

    horizon_steps = None


class LearnedSettings(ControllerSettings, frozen=True, tag="learned"):
    """A learned value of computation chooses, at a price per second of planning.

    Attributes:
        values: ``"shipped"`` or a file of `ms_highway.choice.values`; ``""`` and None mean shipped.
    """

    price: NotNegative = field(name="lambda")
    values: File = None

    def __post_init__(self) -> None:
        load_values(self.values or SHIPPED_VALUES)

    def rule(self, start: Start) -> Any:
        """See `ControllerSettings.rule`."""
        return _learned(self.values, start, self.price)


def _learned(values: str | None, start: Start, price: float) -> Any:
    return load_values(values or SHIPPED_VALUES, start.humans).rule(start.ladder, start.costs, price)


class BudgetSettings(ControllerSettings, frozen=True, tag="budget"):
    """What gains most within the time of a cycle.

    Attributes:
        milliseconds: of a cycle, decision and plan.
        values: that tell the gains: ``"one_step"`` for those of Algorithm 1, or what `LearnedSettings` takes.
    """

    quantile: ClassVar[float] = 0.99
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

    count: Annotated[int, Meta(ge=0, description="it must be a number of humans, 0 or more")]

    def rule(self, start: Start) -> Any:
        """See `ControllerSettings.rule`."""
        return Nearest(self.count, start.ladder)


CONTROLLERS: dict[Any, type[ControllerSettings]] = {
    kind.__struct_config__.tag: kind
    for kind in (
        SwitchingSettings,
        HorizonSettings,
        LearnedSettings,
        BudgetSettings,
        NearestSettings,
        FixedSettings,
        ScheduleSettings,
        PeriodSettings,
        RandomSettings,
    )
}
"""The controllers by type."""

CHOOSING = ["switching", "horizon", "learned"]
"""Types of the controllers that choose models online, by a rule at a lambda."""

FIXED_ORDERS = ("fixed", "schedule", "period")
"""Types of the controllers whose models are the same in every episode, step by step."""


def controller_settings(config: Any) -> Any:
    """Return the `ControllerSettings` of a controller's configuration.

    Raises:
        ValueError: naming the key, the value and the remedy, for anything unknown or impossible.
    """
    kind = config.get("type") if isinstance(config, Mapping) else None
    if kind not in list(CONTROLLERS):
        gone = retired.replacement(retired.CONTROLLERS, str(kind))
        raise ValueError(gone or f"{PLACE} is {config!r}; its 'type' must be one of {', '.join(CONTROLLERS)}")
    return read(CONTROLLERS[kind], PLACE, config)
