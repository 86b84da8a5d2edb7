"""Warn of learned values of computation that serve elsewhere than they were learned."""

from json import dumps as to_json
from shlex import quote
from warnings import warn

import numpy as np

from ms_highway.choice.rule import Start
from ms_highway.envs.settings import HUMAN_REWARDS, Settings
from ms_highway.game.scenario import Scenario


def warn_of_other_values(settings: Settings, scenario: Scenario, start: Start) -> None:
    """Warn of learned values that come from another scene or other humans.

    A scene is a scenario with its semantics, solver and horizon. Humans are others if
    they drive for another reward, or if ``human_driver`` drives them. How humans yield
    to the robot (``yielding``) is left out, as values are measured among humans who
    never do.

    Args:
        settings: of the environment, whose controller may have learned values.
        scenario: of the environment.
        start: what is known of an episode.
    """
    values = settings.controller.learned(start)
    if values is None:
        return

    # Compare the settings of learning with those of this environment.
    known = values.provenance
    scenarios = known.get("scenarios", [scenario.name])
    there = {name: known[name] for name in ("semantics", "solver") if name in known}
    there["horizon"] = known.get("planning_horizon", scenario.planning.horizon)
    other: dict[str, object] = {
        name: value
        for name, value in there.items()
        if getattr(settings, name) not in np.ravel(value)
    }
    here: dict[str, object] = {name: getattr(settings, name) for name in other}
    reward = known.get("human_reward")
    if not reward:
        reward = HUMAN_REWARDS[known.get("semantics", settings.semantics)]
    if reward != settings.reward:
        other["human_reward"] = reward
        here["human_reward"] = settings.reward

    driver = settings.human_driver
    if scenario.name in scenarios and not other and driver is None:
        return
    learned_in = _listed(scenarios, other)
    used_in = _listed([scenario.name], here)
    remedy = f"learn them with {_command(scenario, here)}, and say"
    remedy += " learned:LAMBDA:values.npz"
    if driver is not None:
        used_in += f", where {driver!r} drives the humans"
        remedy = (
            "choose another controller, such as tom or switching:0.1, as values are"
            " not learned among such humans"
        )
    warn(
        f"the values of computation were learned in {learned_in}, not in {used_in};"
        f" {remedy}",
        stacklevel=2,
    )


def _listed(scenarios: list[str], keys: dict[str, object]) -> str:
    """Return a list of scenarios and of values by key as a text."""
    return ", ".join([*scenarios, *(f"{name} {value}" for name, value in keys.items())])


def _command(scenario: Scenario, keys: dict[str, object]) -> str:
    """Return the command that learns values in a scenario with these keys."""
    changes = ""
    for name, value in keys.items():
        text = value if isinstance(value, str) else to_json(value)
        changes += f" --set {quote(f'{name}={text}')}"
    return f"`ms-highway values learn {scenario.name}{changes} --out values.npz`"
