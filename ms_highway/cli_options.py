"""Options that several commands have in common, and what they stand for."""

import argparse
import os
from contextlib import suppress
from pathlib import Path

import jax
from jax.sharding import Mesh

from ms_highway.envs.configuration import HUMAN_REWARDS
from ms_highway.learnt import load
from ms_highway.simulation import device_mesh

__all__ = ["CONTROLLERS", "add_costs", "add_semantics", "costs", "devices", "human_reward"]

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


def add_costs(parser: argparse.ArgumentParser) -> None:
    """Add ``--costs``, which says what T(M) is, to a command."""
    parser.add_argument(
        "--costs",
        default="published",
        help="seconds per plan that switching decides with: published (0.09, 0.17, 0.37; default), measured on this "
        "machine, or given like naive=0.1,turn=0.2,tom=0.5",
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


def devices(count: int | None) -> Mesh:
    """The devices that ``--devices`` asks for; without, all, and on processors one per core.

    Processors have as many as they are told to before JAX begins to compute.

    Raises:
        ValueError: if there are not so many.
    """
    if "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        with suppress(RuntimeError):  # it has begun, and has those that it has
            jax.config.update("jax_num_cpu_devices", count or cores)
    known = jax.local_devices()
    if count and count > len(known):
        raise ValueError(f"--devices is {count}; this process has {len(known)}, of kind {known[0].platform}")
    return device_mesh(known[:count])
