"""Options that several commands have in common, and what they stand for."""

import argparse
from pathlib import Path

from ms_highway.envs.configuration import HUMAN_REWARDS
from ms_highway.learnt import load

__all__ = ["CONTROLLERS", "add_semantics", "human_reward"]

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
