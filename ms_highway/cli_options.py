"""Options that several commands have in common, and what they stand for."""

import argparse
from pathlib import Path

from ms_highway.envs.configuration import HUMAN_REWARDS
from ms_highway.learnt import load

__all__ = ["CONTROLLERS", "add_costs", "add_devices", "add_semantics", "check_least", "costs", "human_reward"]

CONTROLLERS = "naive, turn, tom, switching:LAMBDA, schedule:MODEL=STEPS,...,MODEL"
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
        ValueError: if the text is neither a known name nor a file of a learnt reward.
    """
    if text is None or text in HUMAN_REWARDS.values():
        return text
    try:
        return load(Path(text)).weights
    except ValueError as error:
        raise ValueError(f"--human-reward is neither {' nor '.join(HUMAN_REWARDS.values())}: {error}") from error


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
    """Add ``--devices``, see `ms_highway.simulation.use_devices`, to a command."""
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
