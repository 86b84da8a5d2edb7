"""Read controllers from their configuration.

Controllers are rules, orders of models, functions and agents. The configuration of a
rule is the rule: the fields of its chooser and its estimator are the keys of
``config["controller"]``, see `ms_highway.choice.rule.Part`. `ms_highway.envs.registry`
finds the controllers by type and short name.
"""

import re
from collections.abc import Callable
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass, replace
from functools import partial
from math import nan
from typing import Annotated, NamedTuple, NoReturn, Self, TypeAlias, get_type_hints

import numpy as np
from msgspec import Meta, convert, json

from ms_highway.choice.budget import Knapsack
from ms_highway.choice.learned_value import SHIPPED_VALUES, LearnedValue, Values
from ms_highway.choice.rule import (
    DERIVE,
    FROM_START,
    Chooser,
    Estimator,
    GameEvidence,
    Part,
    Priced,
    Rule,
    Start,
    in_order,
)
from ms_highway.envs.agents import agent_file
from ms_highway.envs.configuration import (
    Config,
    as_dictionary,
    as_json,
    check,
    refuse_unknown,
)
from ms_highway.game.game import Game
from ms_highway.loop.controller import (
    HUMAN_DRIVERS,
    Controller,
    FunctionDriver,
    draw_key,
    function_names,
)
from ms_highway.loop.driver import Driver, prepared_rule
from ms_highway.planning.ladders import human_model, is_model, model_names
from ms_highway.runtime.limits import NotNegative

PLACE = "config['controller']"
"""What errors name."""

COMMON_KEYS = ("type", "belief")
"""Keys of all controllers."""

Models = Annotated[
    tuple[str, ...], Meta(min_length=1, description="give a list of human models")
]
Shares = Annotated[
    dict[str, NotNegative],
    Meta(
        min_length=1,
        description="give the share of each model, such as {'naive': 0.7, 'tom': 0.3}",
    ),
]


# Orders, whose models are known when the episode starts


class ModelOrder(Part):
    """Base of orders that name the models of an episode; they are the rule's ladder."""

    def __post_init__(self) -> None:
        for name in self.names():
            if "/" in name:
                raise ValueError(
                    f"{PLACE} names {name!r}; models per human are gone since 3.0.0;"
                    " name one model for a step, or choose them by an agent's actions"
                )
            if not is_model(name):
                raise ValueError(
                    f"{PLACE} names {name!r}; the human models are {model_names()}"
                )

    def names(self) -> tuple[str, ...]:
        """Return the names of the human models."""
        raise NotImplementedError

    def table(self, start: Start) -> np.ndarray:
        """Return the names of the humans' models in every step.

        They are an array [steps, humans] or, the same for all, [steps, 1].
        """
        return np.array(self.names())[:, None]

    def rule(self, start: Start) -> Rule[GameEvidence]:
        """Return the rule of an episode, see `ms_highway.choice.rule.in_order`."""
        table = self.table(start)
        names = list(dict.fromkeys(table.ravel().tolist()))
        rungs = np.vectorize(names.index)(table)
        return in_order(rungs, tuple(map(human_model, names)))


@dataclass(frozen=True)
class Fixed(ModelOrder):
    """Always the same model."""

    model: str

    def names(self) -> tuple[str, ...]:
        """See `ModelOrder.names`."""
        return (self.model,)


@dataclass(frozen=True)
class Schedule(ModelOrder):
    """Take a given model in each step, and keep the last one."""

    models: Models

    def names(self) -> tuple[str, ...]:
        """See `ModelOrder.names`."""
        return self.models


@dataclass(frozen=True)
class RandomModels(ModelOrder):
    """A model for every human and step, drawn with given shares.

    They are drawn when the episode starts.
    """

    shares: Shares

    def __post_init__(self) -> None:
        super().__post_init__()
        total = sum(self.shares.values())
        rounding = 1e-6
        if abs(total - 1) > rounding:
            raise ValueError(
                f"{PLACE}['shares'] sum to {total:g}; change one, so that they sum to 1"
            )

    def names(self) -> tuple[str, ...]:
        """See `ModelOrder.names`."""
        return tuple(name for name, share in self.shares.items() if share > 0)

    def table(self, start: Start) -> np.ndarray:
        """See `ModelOrder.table`."""
        shares = np.array([self.shares[name] for name in self.names()])
        size = (start.steps, start.humans)
        return start.random.choice(self.names(), size=size, p=shares / shares.sum())


def schedule_of(text: str) -> Config:
    """Read the part of a short name behind ``schedule:``.

    ``tom=6,naive`` is tom for six steps and naive for one.
    """
    models: list[str] = []
    for part in text.split(","):
        repeated = re.fullmatch("(.+)=([0-9]{1,5})", part)
        if repeated:
            models += [repeated[1]] * int(repeated[2])
        else:
            models.append(part)
    return {"models": models}


def shares_of(text: str) -> Config:
    """Read the part of a short name behind its type, such as ``naive=0.7,tom=0.3``.

    Raises:
        ValueError: if it names a model twice.
    """
    parts = [part.partition("=") for part in text.split(",")]
    shares = {name: share for name, _, share in parts}
    if len(shares) < len(parts):
        raise ValueError(f"the shares {text!r} name a model twice; name each once")
    return {"shares": shares}


# Who drives without predictions


class Outside(Part):
    """Base of what stands for a user's drivers and agents, which are known by name:
    they choose no models.
    """

    name: str


@dataclass(frozen=True)
class DrivenByFunction(Outside):
    """A function of the state drives, see `ms_highway.add_driver`."""

    name: str

    def __post_init__(self) -> None:
        if self.name not in function_names():
            remedy = (
                "add it with ms_highway.add_driver: there are"
                f" {', '.join(function_names())}"
            )
            raise ValueError(f"{PLACE} names the driver {self.name!r}; {remedy}")


@dataclass(frozen=True)
class DrivenByAgent(Outside):
    """An agent acts from outside the environment, see `ms_highway.envs.agents`."""

    name: str


# Controllers


@dataclass(frozen=True)
class ControllerSettings:
    """What ``config["controller"]`` is read into.

    Attributes:
        type: of the controller.
        chooser: what chooses the models, names them, or drives without any.
        estimator: what estimates their gains; None if the chooser needs no gains.
        belief: whether the controller infers which model predicts each human, see
            `ms_highway.choice.belief`.
    """

    type: str
    chooser: Chooser[GameEvidence] | ModelOrder | Outside
    estimator: Estimator[GameEvidence] | None = None
    belief: bool = False

    def __init_subclass__(cls, **_: object) -> NoReturn:
        """Refuse settings of rules that are classes of their own, as before version 3.

        Raises:
            ValueError: always.
        """
        raise ValueError(
            f"the rule {cls.__name__} derives from ControllerSettings; {DERIVE}"
        )

    def __post_init__(self) -> None:
        if self.belief and isinstance(self.chooser, Outside):
            name = self.chooser.name
            raise ValueError(
                f"{PLACE}['belief'] is True, and {name!r} predicts no human; leave the"
                " belief out"
            )

    @property
    def chooses(self) -> bool:
        """Whether a rule chooses from the ladder."""
        return not isinstance(self.chooser, (ModelOrder, Outside))

    @property
    def predicts(self) -> bool:
        """Whether the robot plans with predictions of human models."""
        return not isinstance(self.chooser, Outside)

    @property
    def price(self) -> float:
        """Lambda, NaN where no rule chooses at one."""
        return self.chooser.price if isinstance(self.chooser, Priced) else nan

    @property
    def budget(self) -> float | None:
        """Time of a cycle [s], None without one."""
        if not isinstance(self.chooser, Knapsack):
            return None
        return float(self.chooser.seconds)

    def without_price(self) -> Self:
        """Return the settings at a lambda of 0.

        They are the same for controllers that differ only in lambda.
        """
        if not isinstance(self.chooser, Priced):
            return self
        return replace(self, chooser=replace(self.chooser, price=0.0))

    def learned(self, start: Start) -> Values | None:
        """Return the learned values that estimate gains; None without any."""
        if not isinstance(self.estimator, LearnedValue):
            return None
        return self.estimator.values_for(start)

    def files(self) -> tuple[str, ...]:
        """Return the paths of the files that the controller is read from."""
        file = None
        if isinstance(self.chooser, DrivenByAgent):
            file = agent_file(self.chooser.name)
        elif isinstance(self.estimator, LearnedValue):
            values = self.estimator.values
            file = None if values == SHIPPED_VALUES else values
        return (file,) if file else ()

    def names(self) -> tuple[str, ...]:
        """Return the names of the human models of an order."""
        return self.chooser.names() if isinstance(self.chooser, ModelOrder) else ()

    def rule(self, start: Start) -> Rule[GameEvidence]:
        """Return the rule of an episode.

        Raises:
            ValueError: for what drives without predictions.
        """
        if isinstance(self.chooser, ModelOrder):
            return self.chooser.rule(start)
        if isinstance(self.chooser, Outside):
            message = f"{PLACE} names {self.chooser.name!r}, which chooses no models"
            raise ValueError(
                f"{message}; name a controller that does, such as learned:0.1"
            )
        chooser = self.chooser.at_start(start)
        estimator = None if self.estimator is None else self.estimator.at_start(start)
        return Rule(start.ladder, start.costs, chooser, estimator)

    def check(self, start: Start) -> None:
        """Check that the controller can drive the robot.

        Raises:
            ValueError: for an agent, and for a rule that does not fit the ladder, the
                costs or a belief.
        """
        if isinstance(self.chooser, DrivenByAgent):
            remedy = (
                "call it yourself, or make the environment with"
                " ms_highway.experiments.runner.make_environment"
            )
            raise ValueError(f"an agent acts from outside; {remedy}")
        if self.predicts:
            prepared_rule(self.rule(start), self.belief)

    def driver(
        self,
        game: Game,
        start: Start,
        way_out: bool,
        order: Rule[GameEvidence] | None = None,
    ) -> Controller:
        """Return what drives the robot in an episode.

        Args:
            game: that the robot believes in.
            start: what is known of the episode.
            way_out: whether the robot keeps a way out, see
                `ms_highway.planning.way_out`.
            order: used instead of the rule where an agent chooses the models.
        """
        if isinstance(self.chooser, DrivenByFunction):
            name = self.chooser.name
            driver = HUMAN_DRIVERS[name]
            return FunctionDriver(game, name, driver, draw_key(driver, start.random))
        rule = self.rule(start) if order is None else order
        return Driver(
            game, rule, budget=self.budget, way_out=way_out, belief=self.belief
        )

    def config(self) -> Config:
        """Return the configuration that it was read from, as JSON has it.

        Defaults are left out.
        """
        given: Config = {"type": self.type}
        if self.belief:
            given["belief"] = True
        for part in (self.chooser, self.estimator):
            if part is None:
                continue
            for key, field in keys_of(type(part)).items():
                value = getattr(part, field.name)
                if value != field.default:
                    given[key] = value
        return json.decode(json.encode(as_json(given)))


# Reading them

PartMaker: TypeAlias = Callable[..., Part]
"""Class of a part, or a partial with numbers that are no keys."""


class Pair(NamedTuple):
    """What a type of controllers consists of.

    Attributes:
        chooser: class of the chooser.
        estimator: class of the estimator; None if the chooser needs no gains.
    """

    chooser: PartMaker
    estimator: PartMaker | None = None

    @property
    def chooser_class(self) -> type[Part]:
        """The class of the chooser, without its numbers."""
        return class_of(self.chooser)

    def keys(self) -> dict[str, Field]:
        """Return the keys of both parts, the chooser's first.

        They are the fields that the configuration sets, see `keys_of`.
        """
        keys = keys_of(self.chooser_class)
        if self.estimator is None:
            return keys
        return keys | keys_of(class_of(self.estimator))

    def read(
        self,
        kind: str,
        config: object,
        strict: bool = True,
    ) -> ControllerSettings:
        """Read the configuration of a controller of this type.

        Args:
            kind: the type.
            config: values by key; NumPy's numbers and arrays count as Python's.
            strict: whether a number must not be given as a text.

        Raises:
            ValueError: for anything unknown, missing or impossible.
        """
        values = as_dictionary(PLACE, config)
        keys = self.keys()
        refuse_unknown(PLACE, values, [*keys, *COMMON_KEYS])
        check(f"{PLACE}['belief']", values.get("belief", False), bool, strict)
        belief = convert(values.get("belief", False), bool, strict=strict)
        chooser = made(self.chooser, values, strict)
        estimator = None
        if self.estimator is not None:
            estimator = made(self.estimator, values, strict)
        return ControllerSettings(kind, chooser, estimator, belief)  # type: ignore[arg-type]


def class_of(part: PartMaker) -> type[Part]:
    """Return the class of a part."""
    return part.func if isinstance(part, partial) else part  # type: ignore[return-value]


def keys_of(part: type[Part]) -> dict[str, Field]:
    """Return the fields of a part that are keys of the configuration.

    A field ``price`` is the key ``lambda``.
    """
    own: tuple[Field, ...] = fields(part) if is_dataclass(part) else ()
    keys: dict[str, Field] = {}
    for field in own:
        if FROM_START.items().isdisjoint(field.metadata.items()):
            # No field can have the name lambda.
            keys["lambda" if field.name == "price" else field.name] = field
    return keys


def made(part: PartMaker, values: Config, strict: bool) -> Part:
    """Make a part from the values of a configuration.

    Raises:
        ValueError: for a missing or an impossible value.
    """
    kind = class_of(part)
    annotations = get_type_hints(kind, include_extras=True)
    given: Config = {}
    for key, field in keys_of(kind).items():
        required = field.default is MISSING and field.default_factory is MISSING
        if required or key in values:
            annotation = annotations[field.name]
            check(f"{PLACE}[{key!r}]", values.get(key), annotation, strict)
            given[field.name] = convert(values.get(key), annotation, strict=strict)
    return part(**given)
