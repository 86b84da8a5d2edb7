"""Define the controllers that choose models online; find all by type and short name; add rules of one's own."""

from collections.abc import Mapping
from dataclasses import replace
from os import PathLike
from typing import Annotated, Any, ClassVar

from msgspec import Meta, field, json

from ms_highway.choice.budget import Budget, OneStepGains
from ms_highway.choice.learned_value import SHIPPED_VALUES, Values, load_values
from ms_highway.choice.quadratic import RELEASED_TRUST_TOLERANCE, TRUST_TOLERANCE, Quadratic
from ms_highway.choice.rule import NEVER, Nearest, shipped_kind
from ms_highway.envs.agents import AGENTS, AddedAgent, agent_config, is_agent
from ms_highway.envs.configuration import Config, NotNegative, Positive, read, refuse_unknown
from ms_highway.envs.controllers import (
    PLACE,
    AgentSettings,
    ControllerSettings,
    DriverSettings,
    FixedSettings,
    PeriodSettings,
    RandomSettings,
    ScheduleSettings,
    Start,
)
from ms_highway.loop.controller import HUMAN_DRIVERS, DriverFunction, RememberingDriver, check_driver, function_names
from ms_highway.planning.human_models import PACKAGE_TYPES
from ms_highway.planning.ladders import human_model, is_model, model_names
from ms_highway.runtime.definitions import note_definition
from ms_highway.runtime.names import PACKAGE_NAMES, check_own_name, keep_apart

BELIEF = "+belief"
EXAMPLES = "learned:0.1, budget:20, nearest:2, schedule:tom=6,naive, period:tom=1,naive=3, random:naive=0.7,tom=0.3"
ONE_STEP = "one_step"  # stands for gains that Algorithm 1 estimates

Cooldown = Annotated[int, Meta(ge=1, le=-NEVER, description=f"it must be a number of steps from 1 to {-NEVER}")]
File = Annotated[str | None, Meta(description="say 'shipped' or name a file of learned values")]


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
        values: ``"shipped"`` or a file of `ms_highway.choice.learned_value`; ``""`` and None mean ``"shipped"``.
    """

    price: NotNegative = field(name="lambda")
    values: File = None

    def __post_init__(self) -> None:
        load_values(self.values or SHIPPED_VALUES)

    def files(self) -> tuple[str, ...]:
        """See `ControllerSettings.files`."""
        return _files_of(self.values)

    def learned(self, start: Start) -> Values:
        """See `ControllerSettings.learned`."""
        return _learned(self.values, start)

    def rule(self, start: Start) -> Any:
        """See `ControllerSettings.rule`."""
        return self.learned(start).rule(start.ladder, start.costs, self.price)


def _files_of(values: str | None) -> tuple[str, ...]:
    """Return the file of learned values, if it is not one of the package's."""
    return (values,) if values and values not in (SHIPPED_VALUES, ONE_STEP) else ()


def _learned(values: str | None, start: Start) -> Values:
    """Return the values of a file, or the shipped values for a number of humans and semantics.

    Among several humans, those of physical semantics know fewer models; longer ladders take those of the paper's.
    """
    found = load_values(values or SHIPPED_VALUES, shipped_kind(start.semantics, start.humans))
    if not values and start.humans > 1 and not {model.name for model in start.ladder} <= {*found.ladder}:
        return load_values(SHIPPED_VALUES, "several")
    return found


class BudgetSettings(ControllerSettings, frozen=True, tag="budget"):
    """The models that together gain most within the time of a cycle.

    Attributes:
        milliseconds: time of a cycle, which is a decision and a plan.
        values: where the gains come from: ``"one_step"`` for Algorithm 1, or the same as in `LearnedSettings`.
    """

    milliseconds: Positive
    values: File = None

    def __post_init__(self) -> None:
        if self.values != ONE_STEP:
            load_values(self.values or SHIPPED_VALUES)

    @property
    def budget(self) -> float:
        """See `ControllerSettings`."""
        return self.milliseconds * 1e-3

    def files(self) -> tuple[str, ...]:
        """See `ControllerSettings.files`."""
        return _files_of(self.values)

    def learned(self, start: Start) -> Values | None:
        """See `ControllerSettings.learned`."""
        return None if self.values == ONE_STEP else _learned(self.values, start)

    def rule(self, start: Start) -> Any:
        """See `ControllerSettings.rule`."""
        learned = self.learned(start)
        if learned is None:
            gains: Any = OneStepGains(Quadratic(start.costs, 0.0, start.ladder))
        else:
            gains = replace(learned.rule(start.ladder, start.costs, 0.0), cautious=False)
        return Budget(gains, start.costs, self.budget)


class NearestSettings(ControllerSettings, frozen=True, tag="nearest"):
    """The top rung for the nearest humans, and the first rung for all others."""

    count: Annotated[int, Meta(ge=0, description="it must be a number of humans, 0 or more")]

    def rule(self, start: Start) -> Any:
        """See `ControllerSettings.rule`."""
        return Nearest(self.count, start.ladder)


CONTROLLERS: dict[str, type[ControllerSettings]] = {
    str(kind.__struct_config__.tag): kind
    for kind in (
        SwitchingSettings,
        HorizonSettings,
        LearnedSettings,
        BudgetSettings,
        NearestSettings,
        DriverSettings,
        AgentSettings,
        FixedSettings,
        ScheduleSettings,
        PeriodSettings,
        RandomSettings,
    )
}
"""The controllers of the package and those that `add_rule` adds, by type."""

keep_apart("a rule", lambda: CONTROLLERS)


def add_rule(settings: type[ControllerSettings]) -> None:
    """Add a decision rule of one's own by its name, for configurations and commands of this process.

    The short name of a rule ``near`` is ``near:6`` with its first field, a number or a text, and ``near`` if all fields
    have defaults. A rule with two fields or more that have no default has no short name. A first field ``price`` that
    is named ``lambda`` makes it a rule that chooses at a lambda. A rule replaces an added rule of the same name.

    Args:
        settings: class of the rule's settings; its ``rule`` makes the rule, and its tag is the name.

    Raises:
        ValueError: if the class makes no rule, or the name is taken or not one word in lower case.
    """
    if (
        not (isinstance(settings, type) and issubclass(settings, ControllerSettings))
        or settings.rule is ControllerSettings.rule
    ):
        raise ValueError(f"{settings.__name__} makes no rule; give a ControllerSettings with a method `rule`")
    name = str(settings.__struct_config__.tag)
    check_own_name("a rule", name)
    CONTROLLERS[name] = settings
    note_definition(name, settings)


def add_agent(name: str, agent: Any, config: Mapping[str, Any] | None = None) -> None:
    """Add an agent or a planner by a name, for ``compare``, ``video`` and ``bench road`` of this process.

    A file that stable-baselines3 has saved need not be added: every command takes its path as a name.

    Args:
        name: one word in lower case.
        agent: a function from an observation to an action; an object with stable-baselines3's ``predict(observation,
            deterministic=True)``; or the path of a file that stable-baselines3 has saved.
        config: ``action`` and ``observation`` in the configuration of environments that it drives in. By default, the
            action suits the agent's action space, and the observation is the environment's default.

    Raises:
        ValueError: if the name is taken or not one word in lower case, or for another key of ``config``.
        TypeError: if it is no agent.
    """
    check_own_name("an agent", name)
    if not (callable(agent) or hasattr(agent, "predict") or isinstance(agent, (str, PathLike))):
        remedy = "give a function of the observation, an object with `predict`, or a file of stable-baselines3"
        raise TypeError(f"the agent {name!r} is {agent!r}; {remedy}")
    refuse_unknown(f"the configuration of the agent {name!r}", config or {}, ["action", "observation"])
    AGENTS[name] = AddedAgent(agent, dict(config or {}))
    note_definition(name, agent)


def add_driver(name: str, driver: DriverFunction | RememberingDriver | type) -> None:
    """Add a driver of the real humans by a name; `ms_highway.register` adds a model by which the robot predicts them.

    It drives every human of an environment with ``config={"human_driver": name}``, in commands with
    ``--set human_driver=NAME``. It replaces an added driver of the same name. A function also drives the robot, as the
    controller ``name``: it then takes the game of the robot, and a state in which the humans follow the robot. The same
    name lets it drive on roads of highway-env (`ms_highway.drive`, ``ms-highway bench road``), straightened as
    `ms_highway.road.added.AddedRoadDriver` says.

    Args:
        name: one word in lower case.
        driver: a function, a driver that remembers, or a class of highway-env vehicles, such as ``IDMVehicle``.

            A function takes the game of the human and the state of all cars, [cars, 4], x, y [m], heading [rad] and
            speed [m/s], itself first, then the robot; no array may be written. It returns its curvature omega [1/m] and
            its acceleration a before friction [m/s^2], under which the speed v changes by ``v' = a - friction v``;
            `ms_highway.game.dynamics.keep_velocity` of ``game.world`` makes up for friction. It must be pure: in the
            same state of the same game it has to return the same control, which is checked during every episode.
            Written with `jax.numpy`, it also drives in simulations of many episodes (``ms-highway sweep``); the other
            two kinds do not.

            A driver that remembers, or draws random numbers, is an object that is called like a function and has a
            method ``reset(key)``, or a class of such objects that is made without arguments. For every episode, every
            car gets a copy of the object as it was added, or a new object of the class. Its ``reset`` then takes a
            whole number, drawn from the environment's seed for this car and episode, as the seed of its random numbers.
            So the same seed is the same episode, whatever was driven before. A copy of an environment copies the
            memory.

    Raises:
        ValueError: if the name is taken or not one word in lower case, or if the driver is none of these.
    """
    check_own_name("a human driver", name)
    check_driver(name, driver)
    HUMAN_DRIVERS[name] = driver
    note_definition(name, driver)


def of_package(name: str) -> bool:
    """Return whether a controller's short name stands for code of this package alone.

    Files of learned values hold numbers only. Agents, also those in files, and what users have added run other code.
    """
    config = controller_config(name)
    if config["type"] == "driver":
        return config["name"] in PACKAGE_NAMES["a human driver"]
    if config["type"] not in PACKAGE_NAMES["a rule"] or config["type"] == "agent":
        return False
    return all(type(human_model(model)) in PACKAGE_TYPES for model in controller_settings(config).names())


def priced_types() -> list[str]:
    """Return the types of the controllers whose rule chooses at a lambda."""
    return [name for name, kind in CONTROLLERS.items() if "lambda" in kind.__struct_encode_fields__]


def fixed_order_types() -> list[str]:
    """Return the types of the controllers whose models are the same in every episode, step by step."""
    return [name for name, kind in CONTROLLERS.items() if issubclass(kind, (FixedSettings, ScheduleSettings))]


def robot_config(name: str) -> Config:
    """Return the configuration of an environment that a controller or an agent drives; see `controller_config`."""
    config = controller_config(name)
    return agent_config(name) if config["type"] == "agent" else {"controller": config}


def controller_settings(config: Any) -> Any:
    """Return the `ControllerSettings` of a controller's configuration or short name.

    Raises:
        ValueError: for anything unknown or impossible.
    """
    if isinstance(config, str):
        config = controller_config(config)
    kind = config.get("type") if isinstance(config, Mapping) else None
    if kind not in list(CONTROLLERS):
        raise ValueError(f"{PLACE} is {config!r}; its 'type' must be one of {', '.join(CONTROLLERS)}")
    return read(CONTROLLERS[kind], PLACE, config)


def controller_config(text: str) -> Config:
    """Return the configuration that a controller's short name stands for.

    * ``tom``, ``tom@8+warm``: always this human model.
    * ``switching:0.1``, ``horizon:0.1``, ``learned:0.1``: choose at a lambda; ``learned:0.1:FILE``: by a file's values.
    * ``budget:20``, ``budget:20:FILE``, ``budget:20:one_step``: what gains most in so many milliseconds, by shipped
      values, a file's values or Algorithm 1.
    * ``nearest:2``: theory of mind about the two nearest humans.
    * ``schedule:tom=6,naive``: tom for six steps, then naive; ``period:tom=1,naive=3``: tom in every fourth step.
    * ``random:naive=0.7,tom=0.3``: a model drawn with these shares for every human and step.
    * The name of a function of `ms_highway.add_driver` or of an agent of `add_agent`, or a file of stable-baselines3.

    With ``+belief`` at the end, such as ``tom+belief``, any of them counts on no response that a human does not show.

    Raises:
        ValueError: if it stands for none.
    """
    name = text.removesuffix(BELIEF)
    kind, _, rest = name.partition(":")
    if is_model(name):
        kind, rest = "fixed", name
    elif name in function_names():
        kind, rest = "driver", name
    elif is_agent(name):
        kind, rest = "agent", name
    if kind not in CONTROLLERS:
        known = f"name a model ({model_names()}), or one like {EXAMPLES}; the types are {', '.join(CONTROLLERS)}"
        raise ValueError(f"unknown controller {text!r}; {known}; --import the module that adds your own")
    config = CONTROLLERS[kind].parse(rest) | ({"belief": True} if name != text else {})
    try:
        return json.decode(json.encode(read(CONTROLLERS[kind], PLACE, config, strict=False)))
    except ValueError as error:
        raise ValueError(f"controller {text!r}: {error}") from None
