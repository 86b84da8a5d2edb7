"""Find controllers by type and short name, and add rules of one's own."""

from collections.abc import Mapping
from functools import partial
from os import PathLike

from ms_highway.choice.budget import Budget
from ms_highway.choice.choosers import Nearest, Price, PriceTogether
from ms_highway.choice.learned_value import LearnedValue
from ms_highway.choice.quadratic import Quadratic
from ms_highway.choice.rule import (
    DERIVE,
    Chooser,
    Estimator,
    GameEvidence,
    Part,
    Priced,
)
from ms_highway.envs.agents import AGENTS, AddedAgent, Agent, agent_config, is_agent
from ms_highway.envs.configuration import Changes, Config, refuse_unknown
from ms_highway.envs.controllers import (
    COMMON_KEYS,
    PLACE,
    ControllerSettings,
    DrivenByAgent,
    DrivenByFunction,
    Fixed,
    Pair,
    RandomModels,
    Schedule,
    keys_of,
    schedule_of,
    shares_of,
)
from ms_highway.loop.controller import (
    HUMAN_DRIVERS,
    DriverFunction,
    RememberingDriver,
    check_driver,
    function_names,
)
from ms_highway.planning.human_models import PACKAGE_TYPES
from ms_highway.planning.ladders import human_model, is_model, model_names
from ms_highway.runtime.definitions import note_definition
from ms_highway.runtime.names import PACKAGE_NAMES, check_own_name, keep_apart

CONTROLLERS: dict[str, Pair] = {
    "switching": Pair(Price, Quadratic),
    "horizon": Pair(Price, partial(Quadratic, steps=None)),
    "learned": Pair(PriceTogether, LearnedValue),
    "budget": Pair(Budget, partial(LearnedValue, margin=0.0, nearest=None)),
    "nearest": Pair(Nearest),
    "driver": Pair(DrivenByFunction),
    "agent": Pair(DrivenByAgent),
    "fixed": Pair(Fixed),
    "schedule": Pair(Schedule),
    "random": Pair(RandomModels),
}
"""The controllers of the package and those that `add_rule` adds, by type."""

keep_apart("a rule", lambda: CONTROLLERS)


def add_rule(
    part: type[Part],
    estimator: type[Estimator[GameEvidence]] | None = None,
) -> None:
    """Add a decision rule of one's own by its name, for this process.

    Configurations and commands then know it. Its name is the ``tag`` of its class, as
    in ``class Near(ms_highway.Chooser, tag="near")``. The fields of the class are the
    keys of its configuration, see `ms_highway.choice.rule.Part`.

    * A class of a chooser chooses the models, and has the short name ``near:6`` with
      its first field, a number or a text, and ``near`` if all fields have defaults. It
      sees the gains of an estimator, if one is given. With two fields or more that have
      no default, it has no short name. If it derives from `ms_highway.Priced`, it
      chooses at a lambda.
    * A class of an estimator says what models gain, which are chosen at a lambda:
      ``mine:0.1``, see `ms_highway.choice.choosers.Price`.

    A rule replaces an added rule of the same name.

    Args:
        part: class of the chooser or the estimator.
        estimator: class of the estimator of a chooser that needs gains.

    Raises:
        ValueError: if the class is neither, for fields with the key of another one, or
            if the name is taken or not one word in lower case.
    """
    pair = _pair_of(part, estimator)
    name = part.tag
    check_own_name("a rule", name)
    CONTROLLERS[name] = pair
    note_definition(name, part)


def _pair_of(part: type[Part], estimator: type[Estimator[GameEvidence]] | None) -> Pair:
    """Return the pair of a user's chooser or estimator.

    Raises:
        ValueError: if the class is neither, or for fields with the key of another one.
    """
    if estimator is not None and not _estimates(estimator):
        raise ValueError(
            f"{_named(estimator)} is no estimator; derive it from ms_highway.Estimator"
        )
    if _estimates(part) and estimator is None:
        _check_fields(Price, part)
        return Pair(Price, part)
    if (
        isinstance(part, type)
        and issubclass(part, Chooser)
        and part.choose is not Chooser.choose
    ):
        _check_fields(part, estimator)
        return Pair(part, estimator)
    raise ValueError(f"{_named(part)} makes no rule; {DERIVE}")


def _check_fields(chooser: type[Part], estimator: type[Part] | None) -> None:
    """Refuse fields that would be read from the key of another one.

    Raises:
        ValueError: naming the class, the field and the remedy.
    """
    # A price is lambda, of choosers that derive from `Priced`.
    own = keys_of(chooser)
    if "lambda" in own and not issubclass(chooser, Priced):
        message = f"{chooser.__name__} has the field 'price', which is lambda"
        raise ValueError(
            f"{message}; derive it from ms_highway.Priced, or rename the field"
        )
    others = {} if estimator is None else keys_of(estimator)
    if estimator is not None and "lambda" in others:
        message = f"{estimator.__name__} has the field 'price', which is the chooser's"
        raise ValueError(f"{message} lambda; rename the field")

    # All other keys mean one thing.
    for part, keys in ((chooser, own), (estimator, others)):
        common = [key for key in COMMON_KEYS if key in keys]
        if part is not None and common:
            message = f"{part.__name__} has the field {common[0]!r}"
            raise ValueError(f"{message}, a key of all controllers; rename the field")
    shared = [key for key in own if key in others]
    if estimator is not None and shared:
        names = f"{chooser.__name__} and {estimator.__name__}"
        raise ValueError(f"{names} have a field {shared[0]!r} each; rename one of them")


def _estimates(part: object) -> bool:
    """Return whether something is the class of an estimator."""
    return (
        isinstance(part, type)
        and issubclass(part, Estimator)
        and part.estimate is not Estimator.estimate
    )


def _named(part: object) -> str:
    """Return the name of a class, and anything else as it is written."""
    return part.__name__ if isinstance(part, type) else repr(part)


def add_agent(
    name: str,
    agent: Agent | str | PathLike[str],
    config: Changes | None = None,
) -> None:
    """Add an agent or a planner by a name, for this process.

    ``compare``, ``video`` and ``bench road`` then know it. A file that
    stable-baselines3 has saved need not be added: every command takes its path as a
    name.

    Args:
        name: one word in lower case.
        agent: a function from an observation to an action; an object with
            stable-baselines3's ``predict(observation, deterministic=True)``; or the
            path of a file that stable-baselines3 has saved.
        config: ``action`` and ``observation`` in the configuration of environments that
            it drives in. By default, the action suits the agent's action space, and the
            observation is the environment's default.

    Raises:
        ValueError: if the name is taken or not one word in lower case, or for another
            key of ``config``.
        TypeError: if it is no agent.
    """
    check_own_name("an agent", name)
    is_file = isinstance(agent, (str, PathLike))
    if not (is_file or callable(agent) or hasattr(agent, "predict")):
        remedy = (
            "give a function of the observation, an object with `predict`, or a file of"
            " stable-baselines3"
        )
        raise TypeError(f"the agent {name!r} is {agent!r}; {remedy}")
    refuse_unknown(
        f"the configuration of the agent {name!r}",
        config or {},
        ["action", "observation"],
    )
    AGENTS[name] = AddedAgent(agent, dict(config or {}))
    note_definition(name, agent)


def add_driver(name: str, driver: DriverFunction | RememberingDriver | type) -> None:
    """Add a driver of the real humans by a name.

    `ms_highway.register` adds a model by which the robot predicts them.

    The driver drives every human of an environment with ``config={"human_driver":
    name}``, in commands with ``--set human_driver=NAME``. It replaces an added driver
    of the same name. A function also drives the robot, as the controller ``name``: it
    then takes the game of the robot, and a state in which the humans follow the robot.
    The same name lets it drive on roads of highway-env (`ms_highway.drive`,
    ``ms-highway bench road``), straightened as `ms_highway.road.added.AddedRoadDriver`
    says.

    Args:
        name: one word in lower case.
        driver: a function, a driver that remembers, or a class of highway-env vehicles,
            such as ``IDMVehicle``.

            A function takes the game of the human and the state of all cars, [cars, 4],
            x, y [m], heading [rad] and speed [m/s], itself first, then the robot; no
            array may be written. It returns its curvature omega [1/m] and its
            acceleration a before friction [m/s^2], under which the speed v changes by
            ``v' = a - friction v``; `ms_highway.game.dynamics.keep_velocity` of
            ``game.world`` makes up for friction. It must be pure: in the same state of
            the same game it has to return the same control, which is checked during
            every episode. Written with `jax.numpy`, it also drives in simulations of
            many episodes (``ms-highway sweep``); the other two kinds do not.

            A driver that remembers, or draws random numbers, is an object that is
            called like a function and has a method ``reset(key)``, or a class of such
            objects that is made without arguments. For every episode, every car gets a
            copy of the object as it was added, or a new object of the class. Its
            ``reset`` then takes a whole number, drawn from the environment's seed for
            this car and episode, as the seed of its random numbers. So the same seed is
            the same episode, whatever was driven before. A copy of an environment
            copies the memory.

    Raises:
        ValueError: if the name is taken or not one word in lower case, or if the driver
            is none of these.
    """
    check_own_name("a human driver", name)
    check_driver(name, driver)
    HUMAN_DRIVERS[name] = driver
    note_definition(name, driver)


def of_package(name: str) -> bool:
    """Return whether a controller's short name stands for code of this package alone.

    Files of learned values hold numbers only. Agents, also those in files, and what
    users have added run other code.
    """
    config = controller_config(name)
    if config["type"] == "driver":
        return config["name"] in PACKAGE_NAMES["a human driver"]
    if config["type"] not in PACKAGE_NAMES["a rule"] or config["type"] == "agent":
        return False
    return all(
        type(human_model(model)) in PACKAGE_TYPES
        for model in controller_settings(config).names()
    )


def priced_types() -> list[str]:
    """Return the types of the controllers whose rule chooses at a lambda."""
    return [
        name
        for name, pair in CONTROLLERS.items()
        if issubclass(pair.chooser_class, Priced)
    ]


def fixed_order_types() -> list[str]:
    """Return the types of the controllers whose models are known beforehand.

    They are the same in every episode, step by step.
    """
    return [
        name
        for name, pair in CONTROLLERS.items()
        if issubclass(pair.chooser_class, (Fixed, Schedule))
    ]


def robot_config(name: str) -> Config:
    """Return the configuration of an environment that a controller drives.

    An agent drives, too; see `controller_config`.
    """
    config = controller_config(name)
    return agent_config(name) if config["type"] == "agent" else {"controller": config}


def controller_settings(config: object) -> ControllerSettings:
    """Return the `ControllerSettings` of a controller's configuration or short name.

    Raises:
        ValueError: for anything unknown or impossible.
    """
    if isinstance(config, str):
        config = controller_config(config)
    kind = config.get("type") if isinstance(config, Mapping) else None
    if not isinstance(config, Mapping) or kind not in list(CONTROLLERS):
        _refuse_retired(kind)
        types = ", ".join(CONTROLLERS)
        raise ValueError(f"{PLACE} is {config!r}; its 'type' must be one of {types}")
    return _read(kind, config)


def _read(kind: str, config: Changes, strict: bool = True) -> ControllerSettings:
    """Read the configuration of a controller of a known type, see `Pair.read`."""
    if kind == "budget" and config.get("values") == "one_step":
        raise ValueError(
            "one_step is gone since 3.0.0: leave it out, to have the gains of learned"
            " values"
        )
    return CONTROLLERS[kind].read(kind, config, strict)


def _refuse_retired(kind: object) -> None:
    """Say what to use instead of a type of controllers that is retired.

    Raises:
        ValueError: for such a type.
    """
    if kind == "period":
        raise ValueError(
            "period is gone since 3.0.0: write the steps as schedule:MODEL=STEPS,...,"
            " or draw them as random:MODEL=SHARE,..."
        )


def controller_config(text: str) -> Config:
    """Return the configuration that a controller's short name stands for.

    * ``tom``, ``tom@8+warm``: always this human model.
    * ``switching:0.1``, ``horizon:0.1``, ``learned:0.1``: choose at a lambda;
      ``learned:0.1:FILE``: by a file's values.
    * ``budget:20``, ``budget:20:FILE``: what gains most in so many milliseconds, by
      shipped or by a file's values.
    * ``nearest:2``: theory of mind about the two nearest humans.
    * ``schedule:tom=6,naive``: tom for six steps, then naive.
    * ``random:naive=0.7,tom=0.3``: a model drawn with these shares for every human and
      step.
    * The name of a function of `ms_highway.add_driver` or of an agent of `add_agent`,
      or a file of stable-baselines3.

    With ``+belief`` at the end, such as ``tom+belief``, any of them counts on no
    response that a human does not show.

    Raises:
        ValueError: if it stands for none.
    """
    name = text.removesuffix("+belief")
    kind, _, rest = name.partition(":")
    if is_model(name):
        kind = "fixed"
        rest = name
    elif name in function_names():
        kind = "driver"
        rest = name
    elif is_agent(name):
        kind = "agent"
        rest = name
    if kind not in CONTROLLERS:
        _refuse_retired(kind)
        raise ValueError(
            f"unknown controller {text!r}; name a model ({model_names()}), or one like"
            " learned:0.1, budget:20, nearest:2, schedule:tom=6,naive,"
            " random:naive=0.7,tom=0.3; the types are"
            f" {', '.join(CONTROLLERS)}; --import the module that adds your own"
        )
    config = _short_config(kind, rest)
    if name != text:
        config["belief"] = True
    try:
        return _read(kind, config, strict=False).config()
    except ValueError as error:
        raise ValueError(f"controller {text!r}: {error}") from None


def _short_config(kind: str, text: str) -> Config:
    """Return the configuration that the text behind a type stands for.

    It is the value of the first key, then of ``values``, if nothing else is said.
    """
    if kind == "agent":
        return {"name": text}  # the path of a file may have colons
    if kind == "schedule":
        return schedule_of(text)
    if kind == "random":
        return shares_of(text)
    first = list(CONTROLLERS[kind].keys())[:1]
    values = zip([*first, "values"], text.split(":", 1), strict=False)
    return {name: value for name, value in values if value}
