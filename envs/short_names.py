"""Parse the short names of controllers, such as ``learned:0.1`` or ``schedule:tom=6,naive``."""

from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any

from ms_highway.envs.controllers import CHOOSING, ControllerSettings, controller_settings
from ms_highway.planning.human_models import is_model, model_names

__all__ = ["controller_config", "named_controller", "number_of", "shares_of", "with_belief"]

BELIEF = "+belief"
MOST_DIGITS = 5  # of a number of steps


def named_controller(text: str) -> ControllerSettings:
    """Return the settings that a controller's short name stands for, see `controller_config`.

    Raises:
        ValueError: if it stands for none.
    """
    return controller_settings(controller_config(text))


def with_belief(read: Callable[[str], dict[str, Any]]) -> Callable[[str], dict[str, Any]]:
    """Let short names end in ``+belief``, which sets ``belief``; the rest is read by a function of names without."""

    @wraps(read)
    def reading(text: str) -> dict[str, Any]:
        name = text.removesuffix(BELIEF)
        return read(name) | ({"belief": True} if name != text else {})

    return reading


@with_belief
def controller_config(text: str) -> dict[str, Any]:
    """Return the configuration that a controller's short name stands for.

    These are the human models, such as ``tom`` or ``tom@8+warm``; ``switching:0.1``, ``horizon:0.1`` and
    ``learned:0.1`` with a lambda, and ``learned:0.1:FILE`` with values of one's own; ``schedule:tom=6,naive``, tom for
    six steps and then naive; ``period:tom=1,naive=3``, tom in every fourth step and naive in between; and
    ``random:naive=0.7,tom=0.3``, for every step a model that is drawn with these shares. With ``+belief`` at the end,
    such as ``tom+belief``, any of them counts on no response that the human does not show.

    Raises:
        ValueError: if it stands for none.
    """
    name, _, rest = text.partition(":")
    config: dict[str, Any]
    if name in CHOOSING:
        price, _, values = rest.partition(":")
        config = {"type": name, "lambda": number_of(text, price, f"its lambda as a number, such as {name}:0.1")}
        if values:
            config["values"] = values
    elif name == "schedule":
        config = {"type": "schedule", "models": _schedule(text, rest)}
    elif name == "period":
        config = {"type": "period", "models": _stretches(text, rest.split(","), "period:tom=1,naive=3")}
    elif name == "random":
        config = {"type": "random", "shares": shares_of(text, rest)}
    elif is_model(name) and not rest:
        config = {"type": "fixed", "model": name}
    else:
        rules = ", ".join(f"{kind}:LAMBDA" + "[:FILE]" * (kind == "learned") for kind in CHOOSING)
        orders = "schedule:MODEL=STEPS,...,MODEL, period:MODEL=STEPS,... and random:MODEL=SHARE,..."
        known = f"{model_names()}, {rules}, {orders}"
        raise ValueError(f"unknown controller {text!r}; the controllers are {known}")
    try:
        controller_settings(config)
    except ValueError as error:
        raise ValueError(f"controller {text!r}: {error}") from None
    return config


def _schedule(text: str, parts: str) -> list[str]:
    """Return the models of a schedule's short name, one per step; the last one stands once and is kept."""
    *first, last = parts.split(",")
    if "=" in last:
        raise ValueError(f"controller {text!r}: the last model takes no number of steps; write schedule:tom=6,naive")
    return [*_stretches(text, first, "schedule:tom=6,naive"), last]


def _stretches(text: str, parts: Sequence[str], example: str) -> list[str]:
    """Return the models of the parts ``MODEL=STEPS`` of a controller's short name, one per step."""
    models: list[str] = []
    for part in parts:
        name, _, steps = part.partition("=")
        if not is_model(name):
            raise ValueError(f"controller {text!r}: unknown human model {name!r}; the models are {model_names()}")
        if not steps.isdecimal():
            raise ValueError(f"controller {text!r} does not say for how many steps; say it like {example}")
        if len(steps) > MOST_DIGITS:
            raise ValueError(f"controller {text!r}: no episode has {steps} steps; leave out what comes later")
        models += [name] * int(steps)
    return models


def number_of(text: str, part: str, wanted: str) -> float:
    """Return the number in a part of a controller's short name.

    Args:
        text: the name.
        part: of it.
        wanted: what the number is, and an example.

    Raises:
        ValueError: if it is none.
    """
    try:
        if part != part.strip():
            raise ValueError  # the name would have spaces or line breaks, in files too
        return float(part)
    except ValueError:
        raise ValueError(f"controller {text!r} needs {wanted}") from None


def shares_of(text: str, parts: str) -> dict[str, float]:
    """Return the share of each model in a random controller's short name.

    Args:
        text: the name.
        parts: what comes after ``random:``.

    Raises:
        ValueError: where a share is missing, or a model is named twice.
    """
    shares: dict[str, float] = {}
    for part in parts.split(","):
        name, _, share = part.partition("=")
        try:
            number = float(share)
        except ValueError:
            raise ValueError(
                f"controller {text!r} has {part!r} where a share belongs; say it like random:naive=0.7,tom=0.3"
            ) from None
        if name in shares:
            raise ValueError(f"controller {text!r} names {name!r} twice; give it one share")
        shares[name] = number
    return shares
