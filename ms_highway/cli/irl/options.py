"""Options that several subcommands of ``irl`` have in common, and what they mean."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ms_highway.cli.options import add_number

if TYPE_CHECKING:
    from ms_highway.game.reward_model import RewardModel
    from ms_highway.irl.recordings.recording import Recording

MINARI = "minari:"
"""Prefix of a Minari data set's name on the command line."""

DENSITY_NAMES = ("sparse", "medium", "dense")
"""Keys of `ms_highway.envs.routes.DENSITIES`; repeated here so that help needs no JAX."""

OTHERS = ("predicted", "recorded", "coasting")
"""The values of `ms_highway.irl.driving.Others`; repeated here so that help needs no JAX."""

SIMULATED_WEIGHTS = ("speed", "lane_alignment", "collision_risk")
"""Weights that `ms_highway.irl.learning.SIMULATED` learns, for help texts."""

REAL_WEIGHTS = (*SIMULATED_WEIGHTS, "direction", "headway", "closing_speed", "induced_braking", "comfort_steering")
"""Weights that `ms_highway.irl.learning.REAL` learns, for help texts."""

HORIZON = 5  # steps, as the paper plans
MOST_STEPS = 1000  # in a window


def add_data(parser: argparse.ArgumentParser) -> None:
    """Add ``--data``, ``--learn`` and ``--horizon``, see `read` and `model`, to a command."""
    parser.add_argument(
        "--data",
        required=True,
        metavar="DIR|minari:NAME",
        help="a directory of CommonRoad scenarios (*.xml, *.xml.gz), or a Minari data set of `ms-highway irl record`",
    )
    parser.add_argument(
        "--learn",
        nargs="+",
        metavar="WEIGHT",
        help=f"names of the weights to learn (default: {', '.join(REAL_WEIGHTS)}; of those, from a Minari data set, "
        f"{', '.join(SIMULATED_WEIGHTS)}); comfort weights that are not learned are 0.1 and set the scale",
    )
    text = f"length of windows, in steps (default: {HORIZON})"
    add_number(parser, "--horizon", None, text, most=MOST_STEPS, metavar="K")


def read(data: str) -> "list[Recording]":
    """Read the recordings that ``--data`` names."""
    if data.startswith(MINARI):
        from ms_highway.irl.recordings.datasets import load_demonstrations

        return load_demonstrations(data.removeprefix(MINARI))
    from ms_highway.irl.recordings.commonroad import read_directory

    return read_directory(Path(data))


def model(options: argparse.Namespace, recordings: "list[Recording]") -> "tuple[RewardModel, int]":
    """Return the reward that ``--learn`` selects, by default REAL or SIMULATED, and the steps of ``--horizon``.

    Raises:
        ValueError: for an impossible model.
    """
    from ms_highway.game.reward import COMFORT
    from ms_highway.game.reward_model import RewardModel
    from ms_highway.irl.learning import COMFORT_GIVEN, REAL, SIMULATED

    usual, steps = REAL if recordings[0].measured else SIMULATED, options.horizon or HORIZON
    if not options.learn:
        return usual, steps
    given = {**dict.fromkeys(COMFORT, COMFORT_GIVEN), **usual.given}
    rest = {name: value for name, value in given.items() if name not in options.learn}
    return RewardModel(tuple(options.learn), rest, usual.tails), steps
