"""Options that several commands share, and what they stand for.

Only the functions that run a command import what computes: help needs neither JAX nor highway-env.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ms_highway.cli.console import filled
from ms_highway.runtime.files import check_writable

if TYPE_CHECKING:
    from ms_highway.experiments.comparison import Comparison

MOST = 1_000_000
"""Upper bound on episodes, parts and other counts; more would take years or all memory."""

MOST_LAMBDAS = 10_000
"""Lambdas of switching in a sweep."""

MOST_SEEDS = 2**63 - 1 - MOST
"""First seed of as many as possible that Parquet's integers hold."""

SCENARIO_NAMES = ("stay_back", "merger", "give_way", "dense_merge", "crossing_crowd")
"""Keys of `ms_highway.envs.ENVIRONMENTS`, for help texts, which need no JAX."""

CONTROLLERS = (
    "naive, turn, tom, learned:LAMBDA[:FILE], switching:LAMBDA, horizon:LAMBDA, schedule:MODEL=STEPS,...,MODEL, "
    "period:MODEL=STEPS,..., random:MODEL=SHARE,..., budget:MILLISECONDS[:FILE], nearest:K"
)
"""What controllers are called on the command line, for help texts."""

LEARNED = "learned:1"
"""The controller that commands take by default: the package's best."""

KEYS = f"""\
--set changes a key of the environments' configuration, and may be repeated. help(ms_highway.InteractionEnv) lists the
keys; these are the usual ones:

  semantics=released      the paper's released code exactly (default: paper, its dynamics and a damped theory of mind)
  human_reward=published  what humans drive for: learned from demonstrations (default), published (default in released
                          semantics), or a file that `ms-highway irl fit` wrote
  ladder=naive,tom        models to choose from, cheapest first (default: the scenario's), or best, the rungs that
                          were found to serve best; tom@8 plans in 8 ascent steps, tom@8+warm from the rest of
                          the last plan
  costs=measured          T(M), the seconds per plan that controllers decide with: published (0.09, 0.17, 0.37), the
                          default; shipped, the default among several humans, under budgets measured ones; measured on
                          this machine, not in simulations; or seconds by model: costs=naive=0.1,turn=0.2,tom=0.5
  solver=newton           how the robot improves its plans: gradient, the paper's steps (default); newton under naive
                          and turn; or convex_newton (default among several humans), for seconds
  horizon=10              controls in a plan (default: 5), each of time_step=0.1 seconds; iterations=20 gradient steps
                          of step_size=0.03 are chosen to suit the horizon unless they are given
  control_limit=0.2,9     bounds on curvature [1/m] and acceleration [m/s^2] of plans, or unlimited
  grip=8                  acceleration that tyres hold in all [m/s^2]: (v^2 kappa)^2 + a^2 <= grip^2 (default: none)
  humans=6                number of humans, 2 to 20, in {" and ".join(SCENARIO_NAMES[3:])}
  yielding=never          what humans do beside the robot: usual, plan for their reward (default); never yield, but
                          keep their velocity; always make room for it; or mixed, each of them never or always
  way_out=false           let plans leave no escape from humans who do not yield

A value is JSON, or words: a,b is a list, and a=1,b=2 a mapping."""


def number(least: float, most: float = MOST, kind: type = int) -> Callable[[str], Any]:
    """Return a reader of the numbers in a range, for the type of an option."""

    def read(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = float("nan")
        if not least <= value <= most:
            whole = "whole " if kind is int else ""
            raise argparse.ArgumentTypeError(f"{text!r} is no {whole}number from {least:,} to {most:,}")
        return value

    return read


def add_number(
    parser: Any, name: str, default: float | None, text: str, least: float = 1, most: float = MOST, **more: Any
) -> None:
    """Add an option that is a number in a range: whole unless its default has a decimal point.

    Args:
        parser: of a command.
        name: of the option.
        default: its value where it is left out, which the help text tells unless it is None.
        text: of help.
        least: that it may be.
        most: that it may be.
        more: arguments of `argparse.ArgumentParser.add_argument`.
    """
    usual = "" if default is None else f" (default: {default})"
    kind = number(least, most, float if isinstance(default, float) else int)
    parser.add_argument(name, type=kind, default=default, help=text + usual, **more)


def file_to_write(text: str) -> Path:
    """Return the path of a file after checking that it can be written; the type of an option.

    Raises:
        OSError: if it cannot.
    """
    check_writable(Path(text))
    return Path(text)


def directory_to_write(text: str) -> Path:
    """Return the path of a directory after checking that files can be written there; the type of an option.

    Raises:
        OSError: if they cannot.
    """
    check_writable(Path(text), directory=True)
    return Path(text)


def add_scenarios(parser: argparse.ArgumentParser) -> None:
    """Add names of scenarios to a command."""
    names = ", ".join(SCENARIO_NAMES)
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO", help=f"{names} (default: the paper's)")


def add_controllers(parser: argparse.ArgumentParser, text: str) -> None:
    """Add ``--controllers`` to a command, with what its help text says behind their names."""
    parser.add_argument("--controllers", nargs="+", metavar="CONTROLLER", help=f"{CONTROLLERS}. {text}")


def add_comparison(parser: argparse.ArgumentParser, seeds: int, out: str | None, controllers: str = "") -> None:
    """Add the options that say what is compared, see `comparison`: all but ``--set`` of `add_keys`.

    Args:
        parser: of a command.
        seeds: default number of episodes.
        out: default directory of results; without, it has to be named.
        controllers: what the help text says of ``--controllers``, by default that they are all that is compared.
    """
    add_scenarios(parser)
    usual = controllers or "(default: all models of the ladder, and switching)"
    kinds = "A kind that has a lambda, without it, stands for one controller at each of --lambdas"
    add_controllers(parser, f"{kinds} {usual}")
    parser.add_argument(
        "--lambdas",
        nargs="+",
        type=lambdas,
        metavar="LAMBDA",
        help="several, or LOW:HIGH:COUNT evenly spaced in the logarithm (three digits) (default: the scenario's two)",
    )
    add_number(parser, "--seeds", seeds, "episodes per controller")
    add_number(parser, "--first-seed", 0, "of the first episode, from which the others count on", 0, MOST_SEEDS)
    usual = "" if out is None else f" (default: {out})"
    parser.add_argument(
        "--out", type=directory_to_write, metavar="DIR", required=not out, default=out, help=f"of results{usual}"
    )
    add_keys(parser)


def add_keys(parser: argparse.ArgumentParser) -> None:
    """Add ``--set``, see `configuration`, to a command."""
    group = parser.add_argument_group("environments", filled(KEYS))
    group.add_argument("--set", dest="keys", action="append", default=[], metavar="KEY=VALUE", help="see above")


def add_devices(parser: Any) -> None:
    """Add ``--devices``, see `ms_highway.loop.devices.use_devices`, to a command."""
    add_number(parser, "--devices", None, "how many devices to use (default: all, or one per core)")


def configuration(options: argparse.Namespace) -> dict[str, Any]:
    """Return the configuration of environments that ``--set`` gives, by key.

    Raises:
        ValueError: for what is no key and value, and for a human's reward that cannot be read.
    """
    from ms_highway.envs.settings import HUMAN_REWARDS
    from ms_highway.game.learned_reward import load

    config = {}
    for text in options.keys:
        key, sign, value = text.partition("=")
        if not sign or key in ("controller", "action"):
            raise ValueError(f"--set {text}: say it like --set horizon=10; who drives is no key that can be set")
        config[key] = _value(value)
    reward, known = config.get("human_reward"), HUMAN_REWARDS.values()
    if isinstance(reward, str) and reward not in known:
        try:
            config["human_reward"] = load(Path(reward)).weights
        except ValueError as error:
            raise ValueError(f"--set human_reward is neither {' nor '.join(known)}: {error}") from error
    return config


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        pass
    parts = [part for part in text.split(",") if part]
    if "=" in text:
        return {name: _value(value) for name, _, value in (part.partition("=") for part in parts)}
    return list(map(_value, parts)) if "," in text else text


def comparison(
    options: argparse.Namespace, always: Sequence[str] = (), prices: Sequence[float] | None = None
) -> "Comparison":
    """Return the comparison that a command's options describe, checked.

    Args:
        options: of the command, see `add_comparison`.
        always: controllers that run in addition to those of ``--controllers``, and to the models of the ladder.
        prices: lambdas of learned controllers that are named without one, where these are not ``--lambdas``.

    Raises:
        ValueError: naming what cannot be compared.
    """
    from ms_highway.envs import ENVIRONMENTS, PAPER_SCENARIOS, environment_id
    from ms_highway.envs.registry import priced_types
    from ms_highway.experiments.comparison import Comparison
    from ms_highway.planning.human_models import rung_names

    config, controllers = configuration(options), {}
    for name in options.scenarios or PAPER_SCENARIOS:
        environment_id(name)
        scenario = ENVIRONMENTS[name].scenario
        given = list(options.controllers or ["switching"])
        if always or not options.controllers:
            given = [*rung_names(config.get("ladder", scenario.ladder)), *given, *always]
        several = list(chain(*(options.lambdas or [scenario.prices])))
        kinds = {kind: prices if kind == "learned" and prices else several for kind in priced_types()}
        named = ([f"{kind}:{price:g}" for price in kinds[kind]] if kind in kinds else [kind] for kind in given)
        controllers[name] = list(dict.fromkeys(chain(*named)))
    asked = Comparison(controllers, options.seeds, options.first_seed, config)
    asked.check()
    return asked


def lambdas(text: str) -> list[float]:
    """Return the lambdas that a word of an option gives: one, or a range.

    A range is ``LOW:HIGH:COUNT``, evenly spaced in the logarithm and rounded to three significant digits, which make
    short names of controllers.

    Raises:
        ArgumentTypeError: for a text that is neither, names negative lambdas, or spaces them so closely that some are
            equal.
    """
    import numpy as np

    values = []
    with suppress(ValueError):
        match text.split(":"):
            case [price]:
                values = [float(price) + 0.0]  # -0 is 0
            case [low, high, count] if 1 < int(count) <= MOST_LAMBDAS:
                values = [float(f"{value:.3g}") for value in np.geomspace(float(low), float(high), int(count))]
    if not values or len(set(values)) < len(values) or not all(0 <= value < np.inf for value in values):
        remedy = "give a number like 0.1, or LOW:HIGH:COUNT that differ in three digits, such as 0.001:10:25"
        raise argparse.ArgumentTypeError(f"lambdas are {text!r}; {remedy}")
    return values
