"""Options that several subcommands of ``irl`` have in common, and what they stand for."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from ms_highway.cli.options import check_most
from ms_highway.runtime.files import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ms_highway.game.learned_reward import LearnedReward
    from ms_highway.game.reward_model import RewardModel
    from ms_highway.irl.recordings.recording import Recording

__all__ = [
    "DENSITY_NAMES",
    "MINARI",
    "OTHERS",
    "REAL_DRIVERS_HELP",
    "REAL_WEIGHTS",
    "SIMULATED_WEIGHTS",
    "add_data",
    "add_horizon",
    "add_model",
    "check_directory",
    "horizon",
    "model",
    "read",
    "real_drivers",
    "save_figures",
]

MINARI = "minari:"
"""Prefix of a Minari data set's name on the command line."""

DENSITY_NAMES = ("sparse", "medium", "dense")
"""Keys of `ms_highway.envs.routes.DENSITIES`; told here so that help needs no JAX."""

OTHERS = ("predicted", "recorded", "coasting")
"""The values of `ms_highway.irl.driving.Others`; told here so that help needs no JAX."""

SIMULATED_WEIGHTS = ("speed", "lane_alignment", "collision_risk")
"""Weights that `ms_highway.irl.learning.SIMULATED` learns, for help texts."""

REAL_WEIGHTS = (*SIMULATED_WEIGHTS, "direction", "headway", "closing_speed", "induced_braking", "comfort_steering")
"""Weights that `ms_highway.irl.learning.REAL` learns, for help texts."""

REAL_DRIVERS_HELP = "a reward learned from real recordings: a file of `ms-highway irl fit`, or us101"

DPI = 110
HORIZON = 5  # steps, as the paper plans
MOST_STEPS = 1000  # in a window


def add_data(parser: argparse.ArgumentParser) -> None:
    """Add ``--data``, see `read`, to a command."""
    parser.add_argument(
        "--data",
        required=True,
        metavar="DIR|minari:NAME",
        help="a directory of CommonRoad scenarios (*.xml, *.xml.gz), or a Minari data set of `ms-highway irl record`",
    )


def add_model(parser: argparse.ArgumentParser) -> None:
    """Add ``--learn``, see `model`, and ``--horizon`` to a command."""
    parser.add_argument(
        "--learn",
        nargs="+",
        metavar="WEIGHT",
        help=f"names of the weights to learn (default: {', '.join(REAL_WEIGHTS)}; of those, from a Minari data set, "
        f"{', '.join(SIMULATED_WEIGHTS)}); comfort weights that are not learned are 0.1 and set the scale",
    )
    add_horizon(parser)


def add_horizon(parser: argparse.ArgumentParser) -> None:
    """Add ``--horizon``, see `horizon`, to a command."""
    parser.add_argument(
        "--horizon", type=int, metavar="K", help=f"length of windows and plans, in steps (default: {HORIZON})"
    )


def read(data: str) -> "list[Recording]":
    """Read the recordings that ``--data`` names."""
    if data.startswith(MINARI):
        from ms_highway.irl.recordings.datasets import load as load_dataset

        return load_dataset(data.removeprefix(MINARI))
    from ms_highway.irl.recordings.commonroad import read_directory

    return read_directory(Path(data))


def real_drivers(name: str) -> "LearnedReward":
    """Read the learned reward that ``--theta`` names.

    Raises:
        ValueError: naming it, if it cannot be read or has no drivers that were learned seconds ahead.
    """
    from ms_highway.game.learned_reward import SHIPPED, load, shipped
    from ms_highway.irl.predictors import check_drivers

    learned = shipped(name) if name in SHIPPED else load(Path(name))
    try:
        check_drivers(learned.drivers)
    except ValueError as error:
        raise ValueError(f"--theta {name}: {error}") from error
    return learned


def horizon(options: argparse.Namespace) -> int:
    """Return the number of steps that ``--horizon`` gives, or the default.

    Raises:
        ValueError: if the number is out of range.
    """
    steps = HORIZON if options.horizon is None else options.horizon
    if steps < 1:
        raise ValueError(f"--horizon is {steps}; a window has at least one step")
    check_most(options, horizon=MOST_STEPS)
    return steps


def model(options: argparse.Namespace, recordings: "list[Recording]") -> "RewardModel":
    """Return the reward model that ``--learn`` selects; by default REAL for measured recordings, else SIMULATED."""
    from ms_highway.game.reward import COMFORT
    from ms_highway.game.reward_model import RewardModel
    from ms_highway.irl.learning import COMFORT_GIVEN, REAL, SIMULATED

    usual = REAL if recordings[0].measured else SIMULATED
    if not options.learn:
        return usual
    given = {**dict.fromkeys(COMFORT, COMFORT_GIVEN), **usual.given}
    rest = {name: value for name, value in given.items() if name not in options.learn}
    return RewardModel(tuple(options.learn), rest, usual.tails)


def check_directory(path: Path) -> None:
    """Refuse a file where a directory of results shall go, before the results are computed.

    Raises:
        ValueError: if the path is a file.
    """
    if path.exists() and not path.is_dir():
        raise ValueError(f"--out is {path}, a file; name a directory")


def save_figures(figures: Mapping[str, "Figure"], directory: Path) -> None:
    """Write figures to ``NAME.png`` in a directory."""
    for name, figure in figures.items():
        with replacing(directory / f"{name}.png") as path:
            figure.savefig(path, dpi=DPI)
