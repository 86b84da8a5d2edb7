"""Options that several commands share, and what they stand for.

Only the functions that run a command import what computes: help needs neither JAX nor highway-env.
"""

import argparse
import json
from collections.abc import Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ms_highway.cli.command import MOST, Option, number, option, output

if TYPE_CHECKING:
    from ms_highway.experiments.comparison import Comparison

MAX_LAMBDAS = 10_000
"""Lambdas of switching in a sweep."""

MAX_SEEDS = 2**63 - 1 - MOST
"""First seed of as many as possible that Parquet's integers hold."""

SCENARIO_NAMES = (
    "stay_back",
    "merger",
    "give_way",
    "dense_merge",
    "crossing_crowd",
    "stay-back-v1",
    "merger-v1",
    "give-way-v1",
    "dense-merge-v1",
)
"""Keys of `ms_highway.envs.ENVIRONMENTS`, for help texts, which need no JAX."""

CONTROLLERS = (
    "naive, turn, tom, learned:LAMBDA[:FILE], switching:LAMBDA, horizon:LAMBDA, schedule:MODEL=STEPS,...,MODEL, "
    "period:MODEL=STEPS,..., random:MODEL=SHARE,..., budget:MILLISECONDS[:FILE], nearest:K; "
    "your own: functions of add_driver, agents of add_agent, and files of stable-baselines3 (AGENT.zip)"
)
"""What controllers are called on the command line, for help texts."""

LEARNED = "learned:1"
"""The controller that commands take by default: the package's best."""

KEYS = """\
--set changes a key of the environments' configuration, and may be repeated. help(ms_highway.InteractionEnv) lists the
keys; these are the usual ones:

  semantics=released      the paper's released code exactly; paper, its dynamics and a damped theory of mind; physical,
                          the same within what tyres hold (default of scenarios that end in -v1; else paper)
  human_reward=published  what humans drive for: learned from demonstrations (default), published (default in released
                          semantics), or a file that `ms-highway irl fit` wrote
  ladder=naive,tom        models to choose from, cheapest first (default: the scenario's), or best, the rungs that
                          were found to serve best; tom@8 plans in 8 ascent steps, tom@8+warm from the rest of
                          the last plan
  costs=measured          T(M), the seconds per plan that controllers decide with: published (0.09, 0.17, 0.37), the
                          default; shipped, that among several humans and in -v1, under budgets measured ones; measured
                          on this machine, not in simulations; or by model: costs=naive=0.1,turn=0.2,tom=0.5
  solver=newton           how the robot improves its plans: gradient, the paper's steps (default); newton under naive
                          and turn; or convex_newton (default among several humans and in -v1), for seconds
  horizon=10              controls in a plan (default: 5; 10 or 20 in -v1), each of time_step=0.1 seconds; iterations=20
                          gradient steps of step_size=0.03 are chosen to suit the horizon unless they are given
  control_limit=0.2,9     bounds on curvature [1/m] and acceleration [m/s^2] of plans, or unlimited
  grip=8                  acceleration that tyres hold in all [m/s^2]: (v^2 kappa)^2 + a^2 <= grip^2 (default: none; 8
                          in -v1)
  humans=6                number of humans, 2 to 20, in dense_merge, dense-merge-v1 and crossing_crowd
  yielding=never          what humans do beside the robot: usual, plan for their reward (default); never yield, but
                          keep their velocity; always make room for it; or mixed, each of them never or always
  human_driver=NAME       what drives the humans instead: what --import adds by ms_highway.add_driver
  way_out=false           let plans leave no escape from humans who do not yield

A value is JSON, or words: a,b is a list, and a=1,b=2 a mapping."""


SCENARIOS = option("scenarios", f"{', '.join(SCENARIO_NAMES)} (default: the paper's)", nargs="*", metavar="SCENARIO")
KEY = {"default": [], "dest": "keys", "action": "append", "metavar": "KEY=VALUE"}
SET = Option("--set", {"help": "see below", **KEY}, KEYS)
DEVICES = number("--devices", None, "how many devices to use (default: all, or one per core)")
FORMATS = ("png", "pdf", "svg")
FORMAT = option("--format", "of figures", FORMATS[0], choices=FORMATS)


def controllers(text: str) -> Option:
    """Return ``--controllers``, with what its help text says behind their names."""
    return option("--controllers", f"{CONTROLLERS}. {text}", nargs="+", metavar="CONTROLLER")


def compared(
    seeds: int,
    out: str | None,
    beside: str = "(default: all models of the ladder, and switching)",
    prices: str = "the scenario's two",
) -> list[Option]:
    """Return the options for what to compare, see `comparison`, and for the directory of results.

    Args:
        seeds: default number of episodes.
        out: default directory of results; without, it has to be named.
        beside: what the help text says of ``--controllers``.
        prices: what it says of the default ``--lambdas``.
    """
    kinds = "A kind that has a lambda, without it, stands for one controller at each of --lambdas"
    several = f"several, or LOW:HIGH:COUNT evenly spaced in the logarithm (three digits) (default: {prices})"
    return [
        SCENARIOS,
        controllers(f"{kinds} {beside}"),
        option("--lambdas", several, nargs="+", type=lambdas, metavar="LAMBDA"),
        number("--seeds", seeds, "episodes per controller"),
        number("--first-seed", 0, "of the first episode, from which the others count on", 0, MAX_SEEDS),
        output("--out", "of results", directory=True, default=out, required=not out),
        FORMAT,
        SET,
    ]


def configuration(options: argparse.Namespace) -> dict:
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
    reward, known = config.get("human_reward"), dict.fromkeys(HUMAN_REWARDS.values())
    if isinstance(reward, str) and reward not in known:
        try:
            config["human_reward"] = load(Path(reward)).weights
        except ValueError as error:
            raise ValueError(f"--set human_reward is neither {' nor '.join(known)}: {error}") from error
    return config


def _value(text: str) -> Any:
    with suppress(ValueError, RecursionError):
        return json.loads(text)
    parts = [part for part in text.split(",") if part]
    if "=" in text:
        return {name: _value(value) for name, _, value in (part.partition("=") for part in parts)}
    return list(map(_value, parts)) if "," in text else text


def comparison(
    options: argparse.Namespace, always: Sequence[str] = (), prices: Sequence[float] | None = None
) -> "Comparison":
    """Return the comparison that a command's options describe.

    Args:
        options: of the command, see `compared`.
        always: controllers that run in addition to those of ``--controllers``, and to the models of the ladder.
        prices: lambdas of learned controllers that are named without one, where these are not ``--lambdas``.

    Raises:
        ValueError: naming what cannot be compared.
    """
    from ms_highway.envs import ENVIRONMENTS, PAPER_SCENARIOS, scenario_name
    from ms_highway.envs.registry import priced_types
    from ms_highway.experiments.comparison import Comparison
    from ms_highway.planning.ladders import rung_names

    config, controllers = configuration(options), {}
    for name in map(scenario_name, options.scenarios or PAPER_SCENARIOS):
        scenario = ENVIRONMENTS[name].scenario
        given = list(options.controllers or ["switching"])
        if always or not options.controllers:
            given = [*rung_names(config.get("ladder", scenario.ladder)), *given, *always]
        several = list(chain(*(getattr(options, "lambdas", None) or [scenario.prices])))
        kinds = {kind: prices if kind == "learned" and prices else several for kind in priced_types()}
        named = ([f"{kind}:{price:g}" for price in kinds[kind]] if kind in kinds else [kind] for kind in given)
        controllers[name] = list(dict.fromkeys(chain(*named)))
    seeds = {name: getattr(options, name) for name in ("seeds", "first_seed") if hasattr(options, name)}
    return Comparison(controllers, config=config, **seeds)


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
            case [low, high, count] if 1 < int(count) <= MAX_LAMBDAS:
                values = [float(f"{value:.3g}") for value in np.geomspace(float(low), float(high), int(count))]
    if not values or len(set(values)) < len(values) or not all(0 <= value < np.inf for value in values):
        remedy = "give a number like 0.1, or LOW:HIGH:COUNT that differ in three digits, such as 0.001:10:25"
        raise argparse.ArgumentTypeError(f"lambdas are {text!r}; {remedy}")
    return values
