"""Define what the configuration of a controller says, and read that of orders, whose models are known beforehand.

`ms_highway.envs.rules` has the controllers that choose online, `ms_highway.envs.registry` all by type and short name.
"""

from contextlib import suppress
from math import nan
from typing import Annotated, Any, ClassVar, NamedTuple, get_args, get_origin

import numpy as np
from msgspec import Meta, Struct, ValidationError, convert
from msgspec.structs import FieldInfo, fields

from ms_highway.choice.rule import Order
from ms_highway.envs.configuration import Config, NotNegative
from ms_highway.game.scenario import Semantics
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import HumanModel, human_model, is_model, model_names

PLACE = "config['controller']"
ROUNDING = 1e-6  # how far a sum of shares may be from 1
MOST_DIGITS = 5  # of a number of steps in a short name

Models = Annotated[tuple[str, ...], Meta(min_length=1, description="give a list of human models")]
Shares = Annotated[
    dict[str, NotNegative],
    Meta(min_length=1, description="give the share of each model, such as {'naive': 0.7, 'tom': 0.3}"),
]


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
        example: of the second part of its short name, such as ``0.1``; empty where it follows from the fields, see
            `short_name`.
    """

    quantile: ClassVar[float] = 0.5
    chooses: ClassVar[bool] = True
    example: ClassVar[str] = ""
    belief: bool = False

    @classmethod
    def own_fields(cls) -> list[FieldInfo]:
        """Return the fields that not all controllers have."""
        return [each for each in fields(cls) if each.name != "belief"]

    @classmethod
    def short_name(cls) -> str:
        """Return an example of its short name, empty where it has none.

        It is ``near:6`` where the first field is a number or a text and no other one is required, and ``near`` where no
        field is.
        """
        tag, own = str(cls.__struct_config__.tag), cls.own_fields()
        example = vars(cls).get("example", "")  # not that of a base, which may lack fields
        if example:
            return f"{tag}:{example}"
        if own and not any(each.required for each in own[1:]):
            with suppress(ValidationError):
                _parsed("1", own[0])
                return f"{tag}:1"
        return "" if any(each.required for each in own) else tag

    @classmethod
    def has_price(cls) -> bool:
        """Return whether its short name ends in a lambda, at which its rule chooses."""
        return ":" in cls.short_name() and cls.own_fields()[0].encode_name == "lambda"

    @classmethod
    def parse(cls, text: str) -> Config:
        """Return the configuration that the second part of a short name says, such as ``0.1`` of ``learned:0.1``.

        Raises:
            ValueError: if it cannot be read.
        """
        own = cls.own_fields()
        if not text and not any(each.required for each in own):
            return {}
        value, _, values = text.partition(":")
        if ":" not in cls.short_name() or not value or value != value.strip():
            raise ValueError  # the name would have spaces or line breaks, in files too
        return {own[0].encode_name: _parsed(value, own[0])} | ({"values": values} if values else {})

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


def _parsed(text: str, of: FieldInfo) -> Any:
    """Return a text as a field's type says, whatever its limits."""
    return convert(text, get_args(of.type)[0] if get_origin(of.type) is Annotated else of.type, strict=False)


class OrderSettings(ControllerSettings, frozen=True):
    """Plans each step with models that are known when the episode starts.

    Attributes:
        fixed: whether they are the same in every episode, step by step.
    """

    chooses: ClassVar[bool] = False
    fixed: ClassVar[bool] = False

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

    fixed = True
    model: str

    @classmethod
    def short_name(cls) -> str:
        """Return none: its short names are those of the models."""
        return ""

    def names(self) -> tuple[str, ...]:
        """See `ControllerSettings.names`."""
        return (self.model,)


class ScheduleSettings(OrderSettings, frozen=True, tag="schedule"):
    """A model per step, the last one is kept; ``tom/naive`` stands for a model of each human."""

    example = "tom=6,naive"
    fixed = True
    models: Models

    @classmethod
    def parse(cls, text: str) -> Config:
        """See `ControllerSettings.parse`; the last model has no number of steps."""
        return {"models": _repeated(text + "=1")}

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


def _repeated(text: str) -> list[str]:
    """Return a model per step of a text such as ``tom=6,naive=1``.

    Raises:
        ValueError: if it is none.
    """
    pairs = [part.split("=") for part in text.split(",")]
    if any(len(steps) > MOST_DIGITS for _, steps in pairs):
        raise ValueError
    return [name for name, steps in pairs for _ in range(int(steps))]


class PeriodSettings(ScheduleSettings, frozen=True, tag="period"):
    """A model per step, repeated to the end of the episode."""

    example = "tom=1,naive=3"

    @classmethod
    def parse(cls, text: str) -> Config:
        """See `ControllerSettings.parse`."""
        return {"models": _repeated(text)}

    def table(self, steps: int, humans: int, random: np.random.Generator) -> np.ndarray:
        """See `OrderSettings.table`."""
        return np.resize(super().table(steps, humans, random), (steps, humans))


class RandomSettings(OrderSettings, frozen=True, tag="random"):
    """A model for every human and step, drawn when the episode starts."""

    example = "naive=0.7,tom=0.3"
    shares: Shares

    @classmethod
    def parse(cls, text: str) -> Config:
        """See `ControllerSettings.parse`."""
        pairs = [part.split("=") for part in text.split(",")]
        return {"shares": {name: float(share) for name, share in pairs}}

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
