"""Know all controllers by type and by short name, such as ``learned:0.1``; add rules of one's own."""

from collections.abc import Mapping
from typing import Any

from ms_highway.envs.configuration import Config, read
from ms_highway.envs.controllers import (
    PLACE,
    ControllerSettings,
    FixedSettings,
    OrderSettings,
    PeriodSettings,
    RandomSettings,
    ScheduleSettings,
)
from ms_highway.envs.rules import BudgetSettings, HorizonSettings, LearnedSettings, NearestSettings, SwitchingSettings
from ms_highway.planning.human_models import is_model, model_names
from ms_highway.runtime import retired

BELIEF = "+belief"

PACKAGE_CONTROLLERS = (
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
CONTROLLERS: dict[str, type[ControllerSettings]] = {
    str(kind.__struct_config__.tag): kind for kind in PACKAGE_CONTROLLERS
}
"""The controllers by type: those of the package, and those that `add_rule` adds."""


def add_rule(settings: type[ControllerSettings]) -> None:
    """Make a decision rule of one's own known by its name, to configurations and commands of this process.

    Its short name is ``near:6`` where the first field of the settings is a number or a text and all others have
    defaults, and ``near`` where all of them have; other rules have none. A first field ``price`` that is named
    ``lambda`` makes it a rule that chooses at a lambda. Added again, a rule takes the place of the one that had its
    name.

    Args:
        settings: class of the rule's settings, whose ``rule`` makes it, and whose tag is its name.

    Raises:
        ValueError: if the class is no such one, or the name is one of the package's, a human model's or no word.
    """
    if not issubclass(settings, ControllerSettings) or settings.rule is ControllerSettings.rule:
        raise ValueError(f"{settings.__name__} makes no rule; give a ControllerSettings with a method `rule`")
    name = str(settings.__struct_config__.tag)
    if CONTROLLERS.get(name) in PACKAGE_CONTROLLERS or is_model(name) or not (name.isidentifier() and name.islower()):
        ours = ", ".join(name for name, kind in CONTROLLERS.items() if kind in PACKAGE_CONTROLLERS)
        remedy = f"choose a tag of one word in lower case other than {ours} and human models"
        raise ValueError(f"a rule cannot be called {name!r}; {remedy}")
    CONTROLLERS[name] = settings


def priced_types() -> list[str]:
    """Return the types of the controllers that choose models online, by a rule at a lambda."""
    return [name for name, kind in CONTROLLERS.items() if kind.has_price()]


def fixed_order_types() -> list[str]:
    """Return the types of the controllers whose models are the same in every episode, step by step."""
    return [name for name, kind in CONTROLLERS.items() if issubclass(kind, OrderSettings) and kind.fixed]


def controller_settings(config: Any) -> Any:
    """Return the `ControllerSettings` of a controller's configuration, or of its short name.

    Raises:
        ValueError: naming the key, the value and the remedy, for anything unknown or impossible.
    """
    if isinstance(config, str):
        config = controller_config(config)
    kind = config.get("type") if isinstance(config, Mapping) else None
    if kind not in list(CONTROLLERS):
        gone = retired.replacement(retired.CONTROLLERS, str(kind))
        raise ValueError(gone or f"{PLACE} is {config!r}; its 'type' must be one of {', '.join(CONTROLLERS)}")
    return read(CONTROLLERS[kind], PLACE, config)


def controller_config(text: str) -> Config:
    """Return the configuration that a controller's short name stands for.

    These are the human models, such as ``tom`` or ``tom@8+warm``; ``switching:0.1``, ``horizon:0.1`` and
    ``learned:0.1`` with a lambda, and ``learned:0.1:FILE`` with values of one's own; ``budget:20`` with the
    milliseconds of a cycle and learned gains, ``budget:20:FILE`` with those of a file, and ``budget:20:one_step`` with
    those of Algorithm 1; ``nearest:2``, theory of mind about the two nearest humans; ``schedule:tom=6,naive``, tom for
    six steps and then naive; ``period:tom=1,naive=3``, tom in every fourth step and naive in between; and
    ``random:naive=0.7,tom=0.3``, for every human and step a model that is drawn with these shares. With ``+belief`` at
    the end, such as ``tom+belief``, any of them counts on no response that a human does not show.

    Raises:
        ValueError: if it stands for none.
    """
    name = text.removesuffix(BELIEF)
    kind, _, rest = name.partition(":")
    config: Config = {"type": "fixed", "model": name}
    if not is_model(name):
        examples = {each: settings.short_name() for each, settings in CONTROLLERS.items()}
        example = examples.get(kind)
        if not example:
            gone = retired.replacement(retired.CONTROLLERS, kind)
            known = f"name a model ({model_names()}), or one like {', '.join(filter(None, examples.values()))}"
            raise ValueError(gone or f"unknown controller {text!r}; {known}")
        try:
            config = {"type": kind} | CONTROLLERS[kind].parse(rest)
        except ValueError:
            raise ValueError(f"controller {text!r} cannot be read; write it like {example}") from None
    if name != text:
        config["belief"] = True
    try:
        controller_settings(config)
    except ValueError as error:
        raise ValueError(f"controller {text!r}: {error}") from None
    return config
