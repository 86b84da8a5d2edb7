"""Define options that several commands share, and read their values.

Modules that compute are imported only when a command runs: help needs neither JAX nor
highway-env.
"""

import argparse
import json
from collections.abc import Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from ms_highway.cli.console import MAX_COUNT, Option, number, option, output
from ms_highway.runtime.names import SCENARIO_NAMES

if TYPE_CHECKING:
    from ms_highway.experiments.comparison import Comparison

MAX_FIRST_SEED = 2**63 - 1 - MAX_COUNT
"""Largest first seed: Parquet's integers hold it and `MAX_COUNT` seeds from it on."""

CONTROLLER_NAMES = (
    "naive, turn, tom, learned:LAMBDA[:FILE], switching:LAMBDA, horizon:LAMBDA,"
    " schedule:MODEL=STEPS,...,MODEL, random:MODEL=SHARE,...,"
    " budget:MILLISECONDS[:FILE], nearest:K; your own: functions of add_driver, agents"
    " of add_agent, and files of stable-baselines3 (AGENT.zip)"
)
"""Short names of controllers, for help texts."""

DEFAULT_CONTROLLER = "learned:1"
"""The controller of commands if none is named, the best of the package."""

SET_NOTES = """\
--set changes a key of the environments' configuration, and may be repeated.
notebooks/REFERENCE.md explains all keys; the most useful ones are:

  semantics=released      paper, the paper's dynamics and a damped theory of mind
                          (default); physical, the same within what tyres hold (default
                          of scenarios that end in -v1); or released, exactly the
                          paper's released code
  human_reward=published  what humans drive for: learned from demonstrations (default),
                          published (default in released semantics), us101, learned from
                          drivers on that highway, or a file that `ms-highway irl fit`
                          wrote
  ladder=naive,tom        models to choose from, cheapest first (default: the
                          scenario's), or best, the rungs that served best; tom@8 plans
                          in 8 ascent steps, tom@8+warm starts from the rest of the last
                          plan
  costs=measured          T(M), the seconds per plan that controllers decide with:
                          published (0.09, 0.17, 0.37; default with one human); shipped
                          (default among several humans and in -v1), for which budgets
                          take measured ones; measured on this machine, not in
                          simulations; or by model: costs=naive=0.1,turn=0.2,tom=0.5
  solver=convex_newton    how plans are improved: gradient, the paper's steps (default);
                          or convex_newton, for plans of seconds (default among several
                          humans and in -v1)
  horizon=10              number of controls in a plan (default: 5; 10 or 20 in -v1),
                          each of time_step=0.1 seconds; the number and size of gradient
                          steps suit the horizon unless iterations=20 and step_size=0.03
                          set them
  control_limit=0.2,9     bounds on curvature [1/m] and acceleration [m/s^2] of plans,
                          or unlimited
  grip=8                  total acceleration that tyres hold [m/s^2]: (v^2 kappa)^2 +
                          a^2 <= grip^2 (default: none; 8 in -v1)
  humans=6                number of humans, 2 to 20, in scenes with several (Dense Merge
                          and Crossing Crowd)
  yielding=never          what humans do beside the robot: usual, plan for their reward
                          (default); never, keep their velocity; always, make room for
                          the robot; or mixed, each human never or always
  human_driver=NAME       what drives the humans instead: a driver that --import adds by
                          ms_highway.add_driver
  way_out=false           keep no way out from humans who do not yield

A value is JSON, or words: a,b is a list, and a=1,b=2 a mapping."""


SCENARIO_ARGUMENT = option(
    "scenarios",
    f"{', '.join(SCENARIO_NAMES)} (default: the paper's)",
    nargs="*",
    metavar="SCENARIO",
)
SET = Option(
    "--set",
    {
        "help": "see below",
        "default": [],
        "dest": "keys",
        "action": "append",
        "metavar": "KEY=VALUE",
    },
    SET_NOTES,
)
DEVICES = number(
    "--devices", None, "how many devices to use (default: all, or one per core)"
)
FORMATS = ("png", "pdf", "svg")
FORMAT = option("--format", "of figures", FORMATS[0], choices=FORMATS)


def controllers(text: str) -> Option:
    """Return ``--controllers``, with a text that its help shows behind the names."""
    return option(
        "--controllers", f"{CONTROLLER_NAMES}. {text}", nargs="+", metavar="CONTROLLER"
    )


def comparison_options(
    seeds: int,
    out: str | None,
    beside: str = "(default: all models of the ladder, and switching)",
    prices: str = "the scenario's two",
) -> list[Option]:
    """Return the options that say what to compare and where the results go.

    `read_comparison` reads them.

    Args:
        seeds: default number of episodes.
        out: default directory of results; None to require ``--out``.
        beside: text in the help of ``--controllers`` about the default.
        prices: text in the help of ``--lambdas`` about the default.
    """
    kinds = (
        "A kind that needs a lambda, given without one, stands for a controller at each"
        " of --lambdas"
    )
    several = (
        "several, or LOW:HIGH:COUNT evenly spaced in the logarithm (three digits)"
        f" (default: {prices})"
    )
    return [
        SCENARIO_ARGUMENT,
        controllers(f"{kinds} {beside}"),
        option("--lambdas", several, nargs="+", type=lambdas, metavar="LAMBDA"),
        number("--seeds", seeds, "episodes per controller"),
        number(
            "--first-seed",
            0,
            "seed of the first episode; the others count on from it",
            0,
            MAX_FIRST_SEED,
        ),
        output("--out", "of results", directory=True, default=out, required=not out),
        FORMAT,
        SET,
    ]


def configuration(options: argparse.Namespace) -> dict:
    """Return the configuration of environments that ``--set`` gives, by key.

    Raises:
        ValueError: for anything but a key and a value, and for a file of a human's
            reward that cannot be read.
    """
    from ms_highway.data.learned_reward import load
    from ms_highway.envs.settings import NAMED_REWARDS

    config = {}
    for text in options.keys:
        key, sign, value = text.partition("=")
        if not sign or key in ("controller", "action"):
            remedy = (
                "give a key and a value, such as horizon=10; controller and action"
                " cannot be set"
            )
            raise ValueError(f"--set {text}: {remedy}")
        config[key] = _value(value)
    reward = config.get("human_reward")
    if isinstance(reward, str) and reward not in NAMED_REWARDS:
        try:
            config["human_reward"] = load(Path(reward)).weights
        except ValueError as error:
            raise ValueError(
                f"--set human_reward is neither {' nor '.join(NAMED_REWARDS)}: {error}"
            ) from error
    return config


def _value(text: str) -> object:
    """Return the value that a text of ``--set`` stands for: JSON, or words."""
    with suppress(ValueError, RecursionError):
        return json.loads(text)
    parts = [part for part in text.split(",") if part]
    if "=" in text:
        pairs = [part.partition("=") for part in parts]
        return {name: _value(value) for name, _, value in pairs}
    if "," in text:
        return [_value(part) for part in parts]
    return text


def read_comparison(
    options: argparse.Namespace,
    always: Sequence[str] = (),
    prices: Sequence[float] | None = None,
) -> "Comparison":
    """Return the comparison that a command's options describe.

    Args:
        options: of the command, see `comparison_options`.
        always: controllers to compare in any case, together with the models of the
            ladder.
        prices: lambdas of learned controllers that are named without one; by default,
            those of ``--lambdas``.

    Raises:
        ValueError: naming what cannot be compared.
    """
    from ms_highway.envs import ENVIRONMENTS, PAPER_SCENARIOS, scenario_name
    from ms_highway.envs.registry import priced_types
    from ms_highway.experiments.comparison import Comparison
    from ms_highway.planning.ladders import rung_names

    config = configuration(options)
    # Some commands have no such option.
    lambdas_given = getattr(options, "lambdas", None)
    seeds = {
        name: getattr(options, name)
        for name in ("seeds", "first_seed")
        if hasattr(options, name)
    }

    controllers = {}
    for name in map(scenario_name, options.scenarios or PAPER_SCENARIOS):
        scenario = ENVIRONMENTS[name].scenario
        given = list(options.controllers or ["switching"])
        if always or not options.controllers:
            rungs = rung_names(config.get("ladder", scenario.ladder))
            given = [*rungs, *given, *always]

        # A kind that needs a lambda, named without one, is compared at several.
        usual_prices = list(chain(*(lambdas_given or [scenario.prices])))
        named = []
        for each in given:
            if each not in priced_types():
                named.append(each)
                continue
            own = prices if each == "learned" and prices else usual_prices
            named.extend(f"{each}:{price:g}" for price in own)
        controllers[name] = list(dict.fromkeys(named))
    return Comparison(controllers, config=config, **seeds)


def lambdas(text: str) -> list[float]:
    """Return the lambdas that a word of an option gives: one, or a range.

    A range is ``LOW:HIGH:COUNT``, evenly spaced in the logarithm and rounded to three
    significant digits, so that names of controllers are short.

    Raises:
        ArgumentTypeError: for any other text, negative lambdas, or a range in which
            rounded lambdas are equal.
    """
    import numpy as np

    largest_count = 10_000
    values = []
    with suppress(ValueError):
        match text.split(":"):
            case [price]:
                # Adding 0 makes 0 of -0.
                values = [float(price) + 0.0]
            case [low, high, count] if 1 < int(count) <= largest_count:
                exact = np.geomspace(float(low), float(high), int(count))
                values = [float(f"{value:.3g}") for value in exact]
    possible = all(0 <= value < np.inf for value in values)
    distinct = len(set(values)) == len(values)
    if not (values and possible and distinct):
        remedy = (
            "give a number like 0.1, or LOW:HIGH:COUNT that differ in three digits,"
            " such as 0.001:10:25"
        )
        raise argparse.ArgumentTypeError(f"lambdas are {text!r}; {remedy}")
    return values
