"""Options that several commands have in common, and what they stand for.

Only the functions that run a command import what computes: help needs neither JAX nor highway-env.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ms_highway.experiments.comparison import Comparison

__all__ = [
    "CONTROLLERS",
    "CROWD_CONTROLLERS",
    "CROWD_NAMES",
    "EFFORTS",
    "MOST",
    "MOST_LAMBDAS",
    "MOST_PROCESSES",
    "MOST_SEEDS",
    "SCENARIO_NAMES",
    "SEMANTICS",
    "SOLVERS",
    "add_controllers",
    "add_costs",
    "add_devices",
    "add_humans",
    "add_ladder",
    "add_out",
    "add_planning",
    "add_scenarios",
    "add_semantics",
    "asked_comparison",
    "check_least",
    "check_most",
    "control_limit",
    "controllers_by_scenario",
    "costs",
    "human_reward",
    "lambdas",
    "planning",
]

MOST = 1_000_000
"""Upper bound on episodes, parts and other counts; more would take years or all memory."""

MOST_LAMBDAS = 10_000
"""Lambdas of switching in a sweep."""

MOST_SEEDS = 2**63
"""Seeds that Parquet's integers hold."""

MOST_PROCESSES = 1000
"""Processes that share a sweep."""

SCENARIO_NAMES = ("stay_back", "merger", "give_way")
"""`ms_highway.envs.PAPER_SCENARIOS`, for help texts."""

CROWD_NAMES = ("dense_merge", "crossing_crowd")
"""`ms_highway.envs.CROWD_SCENARIOS`, for help texts."""

SEMANTICS = ("paper", "released")
"""Keys of `ms_highway.envs.settings.HUMAN_REWARDS`; told here so that help needs no JAX."""

SOLVERS = ("gradient", "newton", "damped_newton")
"""The values of `ms_highway.optimization.solvers.Solver`; told here so that help needs no JAX."""

EFFORTS = "tom@8 plans in 8 ascent steps, tom@8+warm or tom+warm from the rest of the last plan"
"""What a model's name may say of its effort, for help texts."""

CONTROLLERS = (
    "naive, turn, tom, learned:LAMBDA[:FILE], switching:LAMBDA, horizon:LAMBDA, schedule:MODEL=STEPS,...,MODEL, "
    "period:MODEL=STEPS,..., random:MODEL=SHARE,..."
)
"""What controllers are called on the command line, for help texts."""


CROWD_CONTROLLERS = (
    "naive, turn, tom, switching:LAMBDA, learned:LAMBDA[:FILE], budget:MILLISECONDS[:FILE], nearest:K, ttc:K, "
    "influence:K, random:MODEL=SHARE,..."
)
"""What controllers among several humans are called, for help texts."""


def add_scenarios(
    parser: argparse.ArgumentParser, default: str = "the paper's", known: Sequence[str] = SCENARIO_NAMES
) -> None:
    """Add the scenarios, any number of them, to a command."""
    names = ", ".join(known)
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO", help=f"{names} (default: {default})")


def add_controllers(parser: argparse.ArgumentParser, default: str = "the paper's") -> None:
    """Add ``--controllers`` to a command."""
    parser.add_argument(
        "--controllers", nargs="+", metavar="CONTROLLER", help=f"{CONTROLLERS}; {EFFORTS} (default: {default})"
    )


def add_ladder(parser: argparse.ArgumentParser) -> None:
    """Add ``--ladder`` to a command."""
    parser.add_argument(
        "--ladder",
        nargs="+",
        metavar="MODEL",
        help="models to choose from, cheapest first, or best, the rungs that were found to serve best (default: the "
        f"scenario's). {EFFORTS}",
    )


def add_out(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """Add ``--out``, the directory of results, to a command; it is required if it has no default."""
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        required=default is None,
        default=None if default is None else Path(default),
        help="directory of results" + ("" if default is None else f" (default: {default})"),
    )


def add_semantics(parser: argparse.ArgumentParser) -> None:
    """Add ``--semantics`` and ``--human-reward``, which say what drives and how it moves, to a command."""
    parser.add_argument(
        "--semantics",
        choices=SEMANTICS,
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
    """Return the human's reward that ``--human-reward`` names: a name, the weights of a file, or None if not given.

    Raises:
        ValueError: if the text is neither a known name nor a file of a learned reward.
    """
    from ms_highway.envs.settings import HUMAN_REWARDS
    from ms_highway.game.learned_reward import load

    if text is None or text in HUMAN_REWARDS.values():
        return text
    try:
        return load(Path(text)).weights
    except ValueError as error:
        raise ValueError(f"--human-reward is neither {' nor '.join(HUMAN_REWARDS.values())}: {error}") from error


def add_planning(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how robot and human plan, see `planning`, to a command."""
    group = parser.add_argument_group("plans of robot and human", "what is left out is chosen to suit the horizon")
    group.add_argument("--horizon", type=int, metavar="K", help="controls in a plan (default: 5)")
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
        help="what tyres hold in all, (v^2 kappa)^2 + a^2 <= grip^2, such as 8 m/s^2 (default: no limit)",
    )


def planning(options: argparse.Namespace) -> dict[str, Any]:
    """Return what the options of plans and of humans give, by key of the configuration.

    Raises:
        ValueError: if the limits are no numbers.
    """
    from ms_highway.envs.settings import PLANNING

    own = ("humans", "yielding", "way_out")
    given = {key: value for key in (*PLANNING, *own) if (value := getattr(options, key, None)) is not None}
    if "control_limit" in given:
        given["control_limit"] = control_limit("--control-limit", given["control_limit"])
    return given


def control_limit(option: str, text: str) -> list[float] | str:
    """Return the bounds on plans that an option gives.

    Raises:
        ValueError: if the limits are no numbers.
    """
    if text == "unlimited":
        return text
    try:
        return [float(bound) for bound in text.split(",")]
    except ValueError:
        raise ValueError(f"{option} is {text!r}; give two numbers like 0.2,9, or unlimited") from None


def add_humans(parser: argparse.ArgumentParser) -> None:
    """Add ``--humans``, the number of humans of the scenarios with several, to a command."""
    parser.add_argument(
        "--humans", type=int, metavar="N", help=f"number of humans, 2 to 12, in {', '.join(CROWD_NAMES)}"
    )


def add_costs(parser: argparse.ArgumentParser, measured: bool = True) -> None:
    """Add ``--costs``, which says what T(M) is, to a command; a simulation cannot measure it."""
    parser.add_argument(
        "--costs",
        help="seconds per plan that controllers decide with: published (0.09, 0.17, 0.37; default), "
        + ("measured on this machine (default among several humans), " if measured else "")
        + "or given like naive=0.1,turn=0.2,tom=0.5",
    )


def costs(text: str | None) -> str | dict[str, float] | None:
    """Return T(M) as ``--costs`` gives it: a word, or seconds by model; None if not given.

    Raises:
        ValueError: if the seconds are no numbers.
    """
    if text is None or "=" not in text:
        return text
    try:
        return {name: float(value) for name, _, value in (part.partition("=") for part in text.split(","))}
    except ValueError:
        raise ValueError(f"--costs is {text!r}; give seconds by model like naive=0.1,turn=0.2,tom=0.5") from None


def add_devices(parser: argparse.ArgumentParser) -> None:
    """Add ``--devices``, see `ms_highway.simulation.devices.use_devices`, to a command."""
    parser.add_argument("--devices", type=int, help="how many devices to use (default: all, or one per core)")


def controllers_by_scenario(options: argparse.Namespace) -> dict[str, list[str]]:
    """Return ``--controllers``, or else the paper's, of each of the scenarios, or else of the paper's.

    Raises:
        ValueError: for an unknown scenario.
    """
    from ms_highway.envs import PAPER_SCENARIOS
    from ms_highway.experiments.comparison import paper_controllers

    scenarios = dict.fromkeys(options.scenarios or PAPER_SCENARIOS)
    return {name: options.controllers or paper_controllers(name) for name in scenarios}


def asked_comparison(
    options: argparse.Namespace, controllers: Mapping[str, Sequence[str]], episodes: int
) -> "Comparison":
    """Return the comparison that a command's options describe; options that it lacks keep their defaults.

    Args:
        options: of the command.
        controllers: short names by scenario; one that is named twice runs once.
        episodes: number of each controller's.

    Raises:
        ValueError: if costs, limits or the human's reward cannot be read.
    """
    from ms_highway.experiments.comparison import Comparison

    return Comparison(
        {scenario: list(dict.fromkeys(names)) for scenario, names in controllers.items()},
        episodes,
        options.semantics,
        costs(options.costs),
        getattr(options, "solver", None),
        human_reward(options.human_reward),
        getattr(options, "ladder", None),
        getattr(options, "seed", 0),
        planning(options),
    )


def lambdas(text: str) -> list[float]:
    """Return the lambdas of switching that ``--lambdas`` gives: a range or several.

    A range is ``LOW:HIGH:COUNT``, evenly spaced in the logarithm and rounded to three significant digits, which make
    short names of controllers; several have commas between them.

    Raises:
        ValueError: if the text is neither, names negative lambdas, or spaces them so closely that some are equal.
    """
    import numpy as np

    try:
        if ":" in text:
            low, high, count = text.split(":")
            if not 0 < float(low) < float(high) < np.inf or not 2 <= int(count) <= MOST_LAMBDAS:
                raise ValueError
            values = [float(f"{value:.3g}") for value in np.geomspace(float(low), float(high), int(count))]
            if len(set(values)) < int(count):
                raise ValueError
        else:
            values = [float(part) for part in text.split(",")]
            if not all(0 <= value < np.inf for value in values):
                raise ValueError
    except ValueError:
        remedy = (
            "give LOW:HIGH:COUNT with 0 < LOW < HIGH and two or more that differ in three digits, such as 0.001:10:25, "
            "or lambdas like 0.1,0.5"
        )
        raise ValueError(f"lambdas are {text!r}; {remedy}") from None
    return list(dict.fromkeys(abs(value) for value in values))  # also of -0


def check_least(options: argparse.Namespace, **least: int) -> None:
    """Check numbers that options give, by name, against the least that they may be.

    Raises:
        ValueError: naming an option whose number is smaller.
    """
    for name, bound in least.items():
        value = getattr(options, name)
        if value is not None and value < bound:
            raise ValueError(f"--{name.replace('_', '-')} is {value}; it must be {bound} or more")


def check_most(options: argparse.Namespace, **most: int) -> None:
    """Check numbers that options give, by name, against the most that they may be.

    Raises:
        ValueError: naming an option whose number is larger.
    """
    for name, bound in most.items():
        value = getattr(options, name)
        if value is not None and value > bound:
            raise ValueError(f"--{name.replace('_', '-')} is {value}; it must be {bound} or less")
