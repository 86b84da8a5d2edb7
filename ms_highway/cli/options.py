"""Options that several commands have in common, and what they stand for."""

import argparse
import sys
from pathlib import Path
from typing import Any

from ms_highway.envs.settings import HUMAN_REWARDS, PLANNING
from ms_highway.experiments.provenance import add_run, differing_versions, this_run
from ms_highway.game.learned_reward import load

__all__ = [
    "CONTROLLERS",
    "MOST",
    "add_costs",
    "add_devices",
    "add_planning",
    "add_semantics",
    "check_least",
    "check_most",
    "control_limit",
    "costs",
    "human_reward",
    "note_run",
    "planning",
]

MOST = 1_000_000
"""Of episodes per controller, of parts of a sweep, and of what else is counted: more takes years, or all memory."""

CONTROLLERS = "naive, turn, tom, switching:LAMBDA, schedule:MODEL=STEPS,...,MODEL, random:MODEL=SHARE,..."
"""What controllers are called on the command line, for help texts."""


def add_semantics(parser: argparse.ArgumentParser) -> None:
    """Add ``--semantics`` and ``--human-reward``, which say what drives and how it moves, to a command."""
    parser.add_argument(
        "--semantics",
        choices=list(HUMAN_REWARDS),
        default="paper",
        help="paper: the paper's dynamics, damped theory of mind (default); released: exactly its released code",
    )
    parser.add_argument(
        "--human-reward",
        metavar="REWARD",
        help="what humans drive for: learned (from demonstrations; default in paper semantics), published (default in "
        "released semantics), or a file that `ms-highway irl fit` wrote",
    )


def human_reward(text: str | None) -> str | dict[str, float] | None:
    """The human's reward that ``--human-reward`` asks for: a name, the weights of a file, or None where not given.

    Raises:
        ValueError: if the text is neither a known name nor a file of a learned reward.
    """
    if text is None or text in HUMAN_REWARDS.values():
        return text
    try:
        return load(Path(text)).weights
    except ValueError as error:
        raise ValueError(f"--human-reward is neither {' nor '.join(HUMAN_REWARDS.values())}: {error}") from error


def add_planning(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how robot and human plan, see `planning`, to a command."""
    group = parser.add_argument_group(
        "plans of robot and human", "see ms_highway.optimization.gradient_steps.PlanningSettings"
    )
    group.add_argument("--horizon", type=int, metavar="K", help="controls that are planned (default: 5)")
    group.add_argument("--time-step", type=float, metavar="SECONDS", help="of plans and world (default: 0.1)")
    group.add_argument("--iterations", type=int, help="gradient steps (default: as suits the horizon; paper: 20)")
    group.add_argument("--step-size", type=float, help="length of one (default: as suits the horizon; paper: 0.03)")
    group.add_argument(
        "--control-limit",
        metavar="OMEGA,ACCELERATION",
        help="bounds on the controls, or unlimited (default: 0.2,50 in paper semantics, 1/m and m/s^2; unlimited in "
        "released semantics)",
    )
    group.add_argument(
        "--grip",
        type=float,
        metavar="ACCELERATION",
        help="what tyres hold in all, (v^2 kappa)^2 + a^2 <= grip^2, such as 8 m/s^2 (default: not looked at)",
    )


def planning(options: argparse.Namespace) -> dict[str, Any]:
    """What the options of `add_planning` ask for, as far as they are given, by key of the configuration.

    Raises:
        ValueError: if the limits are no numbers.
    """
    given = {key: getattr(options, key) for key in PLANNING if getattr(options, key) is not None}
    if "control_limit" in given:
        given["control_limit"] = control_limit("--control-limit", given["control_limit"])
    return given


def control_limit(option: str, text: str) -> list[float] | str:
    """The bounds on plans that an option asks for.

    Raises:
        ValueError: if the limits are no numbers.
    """
    if text == "unlimited":
        return text
    try:
        return [float(bound) for bound in text.split(",")]
    except ValueError:
        raise ValueError(f"{option} is {text!r}; give two numbers like 0.2,9, or unlimited") from None


def add_costs(parser: argparse.ArgumentParser, measured: bool = True) -> None:
    """Add ``--costs``, which says what T(M) is, to a command; what only simulates cannot measure it."""
    parser.add_argument(
        "--costs",
        default="published",
        help="seconds per plan that switching decides with: published (0.09, 0.17, 0.37; default), "
        + ("measured on this machine, " if measured else "")
        + "or given like naive=0.1,turn=0.2,tom=0.5",
    )


def costs(text: str) -> str | dict[str, float]:
    """T(M) that ``--costs`` asks for: a word, or seconds by model.

    Raises:
        ValueError: if the seconds are no numbers.
    """
    if "=" not in text:
        return text
    try:
        return {name: float(value) for name, _, value in (part.partition("=") for part in text.split(","))}
    except ValueError:
        raise ValueError(f"--costs is {text!r}; give seconds by model like naive=0.1,turn=0.2,tom=0.5") from None


def add_devices(parser: argparse.ArgumentParser) -> None:
    """Add ``--devices``, see `ms_highway.simulation.devices.use_devices`, to a command."""
    parser.add_argument("--devices", type=int, help="how many devices to use (default: all, or one per core)")


def check_least(options: argparse.Namespace, **least: int) -> None:
    """Check numbers that options give, by name, against the least that they may be.

    Raises:
        ValueError: naming an option whose number is smaller.
    """
    for name, bound in least.items():
        value = getattr(options, name)
        if value is not None and value < bound:
            raise ValueError(f"--{name} is {value}; it must be {bound} or more")


def check_most(options: argparse.Namespace, **most: int) -> None:
    """Check numbers that options give, by name, against the most that they may be.

    Raises:
        ValueError: naming an option whose number is larger.
    """
    for name, bound in most.items():
        value = getattr(options, name)
        if value is not None and value > bound:
            raise ValueError(f"--{name.replace('_', '-')} is {value}; it must be {bound} or less")


def note_run(options: argparse.Namespace) -> None:
    """Record this run in the directory ``--out``, and say so if other versions have made what is there.

    Raises:
        ValueError: if the record cannot be read.
    """
    run = this_run(options.command_line)
    if differing := differing_versions(options.out, run):
        print(f"ms-highway: {options.out} goes on with {differing}; results may not agree", file=sys.stderr)
    add_run(options.out, run)
