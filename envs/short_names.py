"""Parse the short names of controllers, such as ``learned:0.1`` or ``schedule:tom=6,naive``; add some of one's own."""

from contextlib import suppress
from typing import Annotated, Any, get_args, get_origin

from msgspec import ValidationError, convert
from msgspec.structs import FieldInfo, fields

from ms_highway.envs.configuration import Config
from ms_highway.envs.controllers import CHOOSING, CONTROLLERS, ControllerSettings, controller_settings
from ms_highway.planning.human_models import is_model, model_names
from ms_highway.runtime import retired

BELIEF = "+belief"
MOST_DIGITS = 5  # of a number of steps

SHORT_NAMES = {
    "switching": "switching:0.1",
    "horizon": "horizon:0.1",
    "learned": "learned:0.1",
    "budget": "budget:20",
    "nearest": "nearest:2",
    "schedule": "schedule:tom=6,naive",
    "period": "period:tom=1,naive=3",
    "random": "random:naive=0.7,tom=0.3",
}
"""An example of the short name of each type of controller; its second part, if any, fills the first key."""

PACKAGE_CONTROLLERS = tuple(CONTROLLERS)


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
    if name in PACKAGE_CONTROLLERS or is_model(name) or not (name.isidentifier() and name.islower()):
        remedy = f"choose a tag of one word in lower case other than {', '.join(PACKAGE_CONTROLLERS)} and human models"
        raise ValueError(f"a rule cannot be called {name!r}; {remedy}")
    CONTROLLERS[name] = settings
    SHORT_NAMES.pop(name, None)
    if name in CHOOSING:
        CHOOSING.remove(name)
    own = _own_fields(name)
    if not any(each.required for each in own):
        SHORT_NAMES[name] = name
    if own and not any(each.required for each in own[1:]):
        with suppress(ValidationError):
            _parsed("1", own[0])
            SHORT_NAMES[name] = f"{name}:1"
            if own[0].encode_name == "lambda":
                CHOOSING.append(name)


def named_controller(given: Any) -> Any:
    """Return the settings of a controller, of its short name, see `controller_config`, or of its configuration.

    Raises:
        ValueError: if it is none of a controller.
    """
    return controller_settings(controller_config(given) if isinstance(given, str) else given)


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
        if kind not in SHORT_NAMES:
            examples, gone = ", ".join(SHORT_NAMES.values()), retired.replacement(retired.CONTROLLERS, kind)
            raise ValueError(
                gone or f"unknown controller {text!r}; name a model ({model_names()}), or one like {examples}"
            )
        try:
            config = {"type": kind} | _parts(kind, rest)
        except ValueError:
            raise ValueError(f"controller {text!r} cannot be read; write it like {SHORT_NAMES[kind]}") from None
    if name != text:
        config["belief"] = True
    try:
        controller_settings(config)
    except ValueError as error:
        raise ValueError(f"controller {text!r}: {error}") from None
    return config


def _own_fields(kind: str) -> list[FieldInfo]:
    """Return the fields of a controller that not all of them have."""
    return [each for each in fields(CONTROLLERS[kind]) if each.name != "belief"]


def _parts(kind: str, rest: str) -> Config:
    """Return what the second part of a short name says of a controller."""
    own = _own_fields(kind)
    if not rest and not any(each.required for each in own):
        return {}
    if kind not in ("schedule", "period", "random"):
        value, _, values = rest.partition(":")
        if ":" not in SHORT_NAMES[kind] or not value or value != value.strip():
            raise ValueError  # the name would have spaces or line breaks, in files too
        return {own[0].encode_name: _parsed(value, own[0])} | ({"values": values} if values else {})
    pairs = [part.split("=") for part in rest.split(",")]
    if kind == "random":
        return {"shares": {name: float(share) for name, share in pairs}}
    if kind == "schedule":
        pairs[-1].append("1")  # the last model has no number of steps
    if any(len(steps) > MOST_DIGITS for _, steps in pairs):
        raise ValueError
    return {"models": [name for name, steps in pairs for _ in range(int(steps))]}


def _parsed(text: str, of: FieldInfo) -> Any:
    """Return a text as a field's type says, whatever its limits."""
    return convert(text, get_args(of.type)[0] if get_origin(of.type) is Annotated else of.type, strict=False)
