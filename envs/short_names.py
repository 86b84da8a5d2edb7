"""Parse the short names of controllers, such as ``learned:0.1`` or ``schedule:tom=6,naive``."""

from collections.abc import Sequence
from typing import Any

from ms_highway.envs.controllers import CHOOSING, ControllerSettings, controller_settings
from ms_highway.envs.crowd.controllers import CrowdControllerSettings, crowd_controller_config, crowd_settings
from ms_highway.planning.human_models import is_model, model_names

__all__ = ["controller_config", "named_controller"]

MOST_DIGITS = 5  # of a number of steps


def named_controller(text: str) -> ControllerSettings | CrowdControllerSettings:
    """Return the settings that a controller's short name stands for, with one human or else with several.

    See `controller_config` and `ms_highway.envs.crowd.controllers.crowd_controller_config`. A name that both know is of
    the same type, at the same lambda.

    Raises:
        ValueError: if it stands for none.
    """
    try:
        return controller_settings(controller_config(text))
    except ValueError as error:
        try:
            return crowd_settings(crowd_controller_config(text))
        except ValueError:
            raise error from None


def controller_config(text: str) -> dict[str, Any]:
    """Return the configuration that a controller's short name stands for.

    These are the human models, such as ``tom`` or ``tom@8+warm``; ``switching:0.1``, ``horizon:0.1`` and
    ``learned:0.1`` with a lambda, and ``learned:0.1:FILE`` with values of one's own; ``schedule:tom=6,naive``, tom for
    six steps and then naive; ``period:tom=1,naive=3``, tom in every fourth step and naive in between; and
    ``random:naive=0.7,tom=0.3``, for every step a model that is drawn with these shares.

    Raises:
        ValueError: if it stands for none.
    """
    name, _, rest = text.partition(":")
    config: dict[str, Any]
    if name in CHOOSING:
        price, _, values = rest.partition(":")
        try:
            if price != price.strip():
                raise ValueError  # the name would have spaces or line breaks, in files too
            config = {"type": name, "lambda": float(price)}
        except ValueError:
            raise ValueError(f"controller {text!r} needs its lambda as a number, such as {name}:0.1") from None
        if values:
            config["values"] = values
    elif name == "schedule":
        config = {"type": "schedule", "models": _schedule(text, rest)}
    elif name == "period":
        config = {"type": "period", "models": _stretches(text, rest.split(","), "period:tom=1,naive=3")}
    elif name == "random":
        config = {"type": "random", "shares": _shares(text, rest)}
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


def _shares(text: str, parts: str) -> dict[str, float]:
    """Return the share of each model in a random controller's short name."""
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
