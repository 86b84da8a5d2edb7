"""The command ``ms-highway sweep``."""

import argparse
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from ms_highway.cli.console import add_command, count_episodes, print_tables
from ms_highway.cli.options import (
    CROWD_CONTROLLERS,
    CROWD_NAMES,
    MOST,
    MOST_PROCESSES,
    MOST_SEEDS,
    SCENARIO_NAMES,
    add_controllers,
    add_costs,
    add_devices,
    add_humans,
    add_ladder,
    add_out,
    add_planning,
    add_semantics,
    asked_comparison,
    check_least,
    check_most,
    lambdas,
)

if TYPE_CHECKING:
    from ms_highway.experiments.comparison import Comparison

__all__ = ["add_sweep"]

HELP = f"""\
Simulate very many episodes of a scenario, all in JAX and many at a time, and compare reward and computation.

Episodes are those of `ms-highway compare`: the same seed gives the same start, and what happens is the same up to
rounding. Nothing is timed: planning counts the seconds of --costs. Controllers are those of --controllers, by default
the scenario's ladder, and switching with every lambda of --lambdas.

Controllers of {" and ".join(CROWD_NAMES)} are those of `ms-highway compare`: {CROWD_CONTROLLERS}.
Their number of humans is --humans. They need --costs in seconds by model, each of a plan in which one human is
predicted by it and the others naively. A budget counts these seconds, and deciding as nothing: no plan is late.

Results go to --out, as parts of --part episodes each, which are written as they are done; if stopped or killed and
started again with the same --out, the sweep computes the missing parts. pandas.read_parquet("OUT/episodes") reads all
parts at once: a row per episode; with --steps, pandas.read_parquet("OUT/steps") reads a row per step. There are a
summary.csv and the figure SCENARIO_curve.png as well (reward against computation, with 90 % intervals); settings.json
and provenance.json say what they were made with. To resume, all options but --devices and those of processes have to
be the same.

Episodes are shared by all devices (on CPUs, by default one per core). They are the same byte for byte, however often
the sweep is stopped, and however many parts, devices and processes share it; only other kinds of CPUs may round
otherwise. Several processes need the same options and the same --out, on a disk that they share; if one ends, all do.
Process 0 listens at the address --coordinator, at which the others have to reach it, and at no other.

Memory is bounded: about half a GB for every device, each of which compiles its own program, and 6 kB (with --steps 25)
for every episode of --part, of which each device has one at a time. The summary at the end reads all rows per episode,
of 0.1 kB. Needs the extra "sweep"."""

EXAMPLES = """\
examples:
  ms-highway sweep merger --episodes 10000 --lambdas 0.001:10:25 --out results/sweep
  ms-highway sweep dense_merge --episodes 100 --controllers naive tom nearest:1 \\
    --costs naive=0.001,turn=0.002,tom=0.01 --out results/crowd
  ms-highway sweep give_way --episodes 1000 --controllers tom schedule:tom={4,6,8},naive --out results/schedules

on two machines:
  ms-highway sweep merger --lambdas 0.001:10:25 --coordinator first:4000 --processes 2 --process 0 --out shared/sweep
  ms-highway sweep merger --lambdas 0.001:10:25 --coordinator first:4000 --processes 2 --process 1 --out shared/sweep"""


def add_sweep(commands: Any) -> None:
    """Add the command ``sweep`` to a parser's subparsers."""
    parser = add_command(commands, "sweep", "simulate thousands of episodes at once", HELP, EXAMPLES)
    parser.add_argument("scenario", metavar="SCENARIO", help=", ".join((*SCENARIO_NAMES, *CROWD_NAMES)))
    parser.add_argument("--episodes", type=int, default=1000, help="episodes per controller (default: 1000)")
    parser.add_argument(
        "--lambdas",
        metavar="LOW:HIGH:COUNT",
        help="lambdas of switching, evenly spaced in their logarithm (three digits), or several with commas between "
        "(default: the paper's two, unless there are --controllers)",
    )
    add_controllers(parser, "those of the ladder")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; the others count on (default: 0)")
    add_ladder(parser)
    add_semantics(parser)
    add_costs(parser, measured=False)
    add_planning(parser)
    add_humans(parser)
    parser.add_argument("--steps", action="store_true", help="keep a row per step as well, about 40 times as much")
    parser.add_argument("--part", type=int, default=1024, help="episodes per part, of any controller (default: 1024)")
    add_devices(parser)
    parser.add_argument("--coordinator", metavar="HOST:PORT", help="where process 0 of several is to be found")
    parser.add_argument("--processes", type=int, default=1, help="how many processes share the sweep (default: 1)")
    parser.add_argument("--process", type=int, default=0, help="which of them this one is (default: 0)")
    add_out(parser)
    parser.set_defaults(run=_sweep, simulates=True)


def _sweep(options: argparse.Namespace) -> None:
    try:
        from ms_highway.experiments import sweep as module  # pyarrow is an extra
    except ModuleNotFoundError as error:
        raise ImportError(f"{error}; install the extra with: pip install 'ms-highway[sweep]'") from error
    from ms_highway.cli.results_directory import own_results
    from ms_highway.runtime.files import replacing
    from ms_highway.runtime.peers import together
    from ms_highway.simulation.devices import use_devices
    from ms_highway.visualization.comparison import table
    from ms_highway.visualization.tradeoff import curve

    _check(options)
    comparison = _comparison(options)
    job = module.Sweep(comparison, options.part, options.steps)
    if job.parts > MOST:
        episodes = f"--episodes {options.episodes} of {len(comparison.controllers[options.scenario])} controllers"
        raise ValueError(f"{episodes} are {job.parts} parts; there may be {MOST} with --part {options.part}")
    worker = module.Worker(options.process, options.processes)
    with ExitStack() as stack:
        if worker.place == 0:
            parts = [options.out / kind for kind in (module.EPISODES, module.STEPS)]
            record = stack.enter_context(own_results(options, job.settings(), *parts))
        if worker.of > 1:
            stack.enter_context(together(options.coordinator, worker.of, worker.place))
        counts = module.run_sweep(job, options.out, use_devices(options.devices), worker)
        already, wanted = next(counts), sum(job.size(part) for part in worker.parts(job))
        if worker.place == 0 and module.missing_parts(job, options.out):
            record()
        count_episodes(counts, already, wanted)
        module.wait_for_all(job, options.out)
        if worker.place == 0:
            summaries = module.sweep_summary(module.read_sweep(job, options.out))
            with replacing(options.out / "summary.csv") as path:
                summaries.to_csv(path, index=False)
            with replacing(options.out / f"{options.scenario}_curve.png") as path:
                curve(summaries, options.scenario).savefig(path, dpi=110)
            print_tables(table(summaries, options.scenario))
            print(f"results are in {options.out}")


def _check(options: argparse.Namespace) -> None:
    """Check the numbers of episodes, parts and processes.

    Raises:
        ValueError: naming the option that is impossible.
    """
    check_least(options, episodes=1, part=1, devices=1, processes=1, seed=0, process=0)
    check_most(options, part=MOST, processes=MOST_PROCESSES)
    if options.process >= options.processes or (options.processes > 1) != (options.coordinator is not None):
        given = f"--process {options.process} of --processes {options.processes}, --coordinator {options.coordinator}"
        remedy = "processes are numbered from 0, and several need a coordinator, such as localhost:4000"
        raise ValueError(f"{given}; {remedy}")
    if options.seed + options.episodes > MOST_SEEDS:
        raise ValueError(f"--seed is {options.seed}; no seed may be {MOST_SEEDS} or more")


def _comparison(options: argparse.Namespace) -> "Comparison":
    """Return the episodes of the sweep, checked.

    Raises:
        ValueError: naming what cannot be simulated.
    """
    from ms_highway.envs import ENVIRONMENTS, environment_id
    from ms_highway.planning.human_models import rung_names

    environment_id(options.scenario)
    scenario = ENVIRONMENTS[options.scenario].scenario
    prices = lambdas(options.lambdas) if options.lambdas is not None else [] if options.controllers else scenario.prices
    controllers = [
        *(options.controllers or rung_names(options.ladder or scenario.ladder)),
        *(f"switching:{price:g}" for price in prices),
    ]
    comparison = asked_comparison(options, {options.scenario: controllers}, options.episodes)
    comparison.check()
    return comparison
