"""Define the settings of controllers, and those of orders, whose models are known when the episode starts.

`ms_highway.envs.registry` defines the controllers that choose online, and finds all by type and short name.
"""

import re
from math import nan
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from ms_highway.choice.learned_value import Values
from ms_highway.choice.rule import Order
from ms_highway.envs.agents import agent_file
from ms_highway.envs.configuration import Config, NotNegative
from ms_highway.game.game import Game
from ms_highway.game.scenario import Semantics
from ms_highway.loop.controller import HUMAN_DRIVERS, Controller, FunctionDriver, draw_key, function_names
from ms_highway.loop.driver import Driver, drivable
from ms_highway.planning.costs import Costs
from ms_highway.planning.human_models import HumanModel
from ms_highway.planning.ladders import human_model, is_model, model_names

KEYBOARD = "keyboard"  # name of the human driver that reads the keyboard
PLACE = "config['controller']"
ROUNDING = 1e-6  # how far a sum of shares may be from 1
REPEATED = re.compile("(.+)=([0-9]{1,5})")  # a model and its number of steps in a short name

Models = Annotated[tuple[str, ...], Meta(min_length=1, description="give a list of human models")]
Shares = Annotated[
    dict[str, NotNegative],
    Meta(min_length=1, description="give the share of each model, such as {'naive': 0.7, 'tom': 0.3}"),
]


class Start(NamedTuple):
    """What a rule is built from when an episode starts.

    Attributes:
        ladder: human models to choose from, cheapest first.
        costs: of plans with them, NaN where unknown.
        semantics: of the scenario.
        humans: number of humans.
        steps: number of steps of the episode.
        random: source of the draws.
    """

    ladder: tuple[HumanModel, ...]
    costs: Costs
    semantics: Semantics
    humans: int
    steps: int
    random: np.random.Generator


class ControllerSettings(Struct, frozen=True, kw_only=True, tag_field="type", omit_defaults=True):
    """Base of the settings of controllers, read from their configuration.

    Attributes:
        belief: whether the controller infers which model predicts each human, see `ms_highway.choice.belief`.
        chooses: whether a rule chooses from the ladder.
        predicts: whether the robot plans with predictions of human models.
        price: lambda, NaN where no rule chooses at one.
    """

    chooses: ClassVar[bool] = True
    predicts: ClassVar[bool] = True
    price = nan
    belief: bool = False

    @classmethod
    def parse(cls, text: str) -> Config:
        """Read the part of a short name behind its type: the first field, and the ``values`` after a colon."""
        first = [name for name in cls.__struct_encode_fields__ if name != "belief"][:1]
        given = dict(zip([*first, "values"], text.split(":", 1), strict=False))
        return {name: value for name, value in given.items() if value}

    @property
    def budget(self) -> float | None:
        """Time of a cycle [s], None without one."""
        return None

    def learned(self, start: Start) -> Values | None:
        """Return the learned values that choose from the ladder; None without any."""
        return None

    def files(self) -> tuple[str, ...]:
        """Return the paths of the files that the controller is read from, beside its settings."""
        return ()

    def names(self) -> tuple[str, ...]:
        """Return the names of the human models of an order."""
        return ()

    def rule(self, start: Start) -> Any:
        """Return the `ms_highway.choice.rule.Rule` of an episode."""
        raise NotImplementedError

    def check(self, start: Start) -> None:
        """Check that the controller can drive the robot.

        Raises:
            ValueError: for an agent, and for a rule that does not fit the ladder, the costs or a belief.
        """
        if self.predicts:
            drivable(self.rule(start), self.belief)

    def driver(self, game: Game, start: Start, way_out: bool, order: Order | None = None) -> Controller:
        """Return what drives the robot in an episode.

        Args:
            game: that the robot believes in.
            start: what the rule is built from.
            way_out: whether the robot keeps a way out, see `ms_highway.planning.way_out`.
            order: used instead of the rule where an agent chooses the models.
        """
        rule = self.rule(start) if order is None else order
        return Driver(game, rule, budget=self.budget, way_out=way_out, belief=self.belief)


class OrderSettings(ControllerSettings, frozen=True):
    """Base of the settings of orders, whose models are known when the episode starts."""

    chooses: ClassVar[bool] = False

    def __post_init__(self) -> None:
        for name in self.names():
            if not is_model(name):
                raise ValueError(f"{PLACE} names {name!r}; the human models are {model_names()}")

    def table(self, start: Start) -> np.ndarray:
        """Return the names of the humans' models in every step, [steps, humans] or, the same for all, [steps, 1]."""
        return np.array(self.names())[:, None]

    def rule(self, start: Start) -> Any:
        """See `ControllerSettings.rule`."""
        table = self.table(start)
        names = list(dict.fromkeys(table.ravel().tolist()))
        return Order(np.vectorize(names.index)(table), tuple(map(human_model, names)))


class NamedSettings(ControllerSettings, frozen=True):
    """Base of the settings of a user's drivers and agents, which are known by name and predict no human."""

    chooses: ClassVar[bool] = False
    predicts: ClassVar[bool] = False
    name: str

    def __post_init__(self) -> None:
        if self.belief:
            raise ValueError(f"{PLACE}['belief'] is True, and {self.name!r} predicts no human; leave the belief out")


class DriverSettings(NamedSettings, frozen=True, tag="driver"):
    """A function of the state drives, see `ms_highway.add_driver`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.name not in function_names():
            remedy = f"add it with ms_highway.add_driver: there are {', '.join(function_names())}"
            raise ValueError(f"{PLACE} names the driver {self.name!r}; {remedy}")

    def driver(self, game: Game, start: Start, way_out: bool, order: Order | None = None) -> Controller:
        """See `ControllerSettings.driver`."""
        driver = HUMAN_DRIVERS[self.name]
        return FunctionDriver(game, self.name, driver, draw_key(driver, start.random))


class AgentSettings(NamedSettings, frozen=True, tag="agent"):
    """An agent acts from outside the environment, see `ms_highway.envs.agents`."""

    @classmethod
    def parse(cls, text: str) -> Config:
        """See `ControllerSettings.parse`."""
        return {"name": text}

    def files(self) -> tuple[str, ...]:
        """See `ControllerSettings.files`."""
        file = agent_file(self.name)
        return () if file is None else (file,)

    def check(self, start: Start) -> None:
        """See `ControllerSettings.check`."""
        remedy = "call it yourself, or make the environment with ms_highway.experiments.runner.make_environment"
        raise ValueError(f"an agent acts from outside; {remedy}")


class FixedSettings(OrderSettings, frozen=True, tag="fixed"):
    """Always the same model."""

    model: str

    def names(self) -> tuple[str, ...]:
        """See `ControllerSettings.names`."""
        return (self.model,)


class ScheduleSettings(OrderSettings, frozen=True, tag="schedule"):
    """Take a given model in each step, and keep the last one; ``tom/naive`` gives each human its own model."""

    models: Models

    @classmethod
    def parse(cls, text: str) -> Config:
        """See `ControllerSettings.parse`; ``tom=6,naive`` is tom for six steps and naive for one."""
        models: list[str] = []
        for part in text.split(","):
            repeated = REPEATED.fullmatch(part)
            models += [repeated[1]] * int(repeated[2]) if repeated else [part]
        return {"models": models}

    def names(self) -> tuple[str, ...]:
        """See `ControllerSettings.names`."""
        return tuple(name for step in self.models for name in step.split("/"))

    def table(self, start: Start) -> np.ndarray:
        """See `OrderSettings.table`.

        Raises:
            ValueError: if a step names several models, but not one for each human.
        """
        rows = [step.split("/") for step in self.models]
        if wrong := {len(row) for row in rows} - {1, start.humans}:
            remedy = "name one for all of them in a step, or one for each"
            raise ValueError(f"{PLACE}['models'] has {min(wrong)} models for {start.humans} humans; {remedy}")
        return np.array([row * (start.humans // len(row)) for row in rows])


class PeriodSettings(ScheduleSettings, frozen=True, tag="period"):
    """A model per step, repeated to the end of the episode."""

    def table(self, start: Start) -> np.ndarray:
        """See `OrderSettings.table`."""
        return np.resize(super().table(start), (start.steps, start.humans))


class RandomSettings(OrderSettings, frozen=True, tag="random"):
    """A model for every human and step, drawn when the episode starts with given shares."""

    shares: Shares

    @classmethod
    def parse(cls, text: str) -> Config:
        """See `ControllerSettings.parse`; the text is like ``naive=0.7,tom=0.3``."""
        shares = {name: share for name, _, share in (part.partition("=") for part in text.split(","))}
        if len(shares) <= text.count(","):
            raise ValueError(f"the shares {text!r} name a model twice; name each once")
        return {"shares": shares}

    def __post_init__(self) -> None:
        super().__post_init__()
        total = sum(self.shares.values())
        if abs(total - 1) > ROUNDING:
            raise ValueError(f"{PLACE}['shares'] sum to {total:g}; change one, so that they sum to 1")

    def names(self) -> tuple[str, ...]:
        """See `ControllerSettings.names`."""
        return tuple(name for name, share in self.shares.items() if share > 0)

    def table(self, start: Start) -> np.ndarray:
        """See `OrderSettings.table`."""
        shares = np.array([self.shares[name] for name in self.names()])
        return start.random.choice(self.names(), size=(start.steps, start.humans), p=shares / shares.sum())
