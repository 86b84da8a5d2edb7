"""The command ``ms-highway sweep``."""

import argparse
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from ms_highway.cli.console import add_command, count_episodes, print_tables
from ms_highway.cli.options import (
    CONTROLLERS,
    MOST,
    add_costs,
    add_devices,
    add_planning,
    add_semantics,
    check_least,
    check_most,
    costs,
    human_reward,
    note_run,
    planning,
)
from ms_highway.envs import SCENARIOS, environment_id
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.provenance import read_runs
from ms_highway.experiments.settings import check_settings
from ms_highway.runtime.files import held, replacing, tidy
from ms_highway.runtime.jax_settings import high_throughput
from ms_highway.runtime.peers import together
from ms_highway.simulation.devices import use_devices
from ms_highway.visualization.comparison import table
from ms_highway.visualization.tradeoff import curve

__all__ = ["add_sweep"]

MOST_SEEDS = 2**63  # which Parquet's integers hold
MOST_PROCESSES = 1000

HELP = """\
Simulate very many episodes of a scenario, all in JAX and many at a time, and compare reward and computation.

Episodes are those of `ms-highway compare`: the same seed gives the same start, and what happens is the same up to
rounding. Nothing is timed: planning counts the seconds of --costs. Controllers are those of --controllers, by default
the scenario's ladder, and switching with every lambda of --lambdas.

Results go to --out, as parts of --part episodes each, which are written as they are done; stopped or killed and started
again with the same --out, the sweep goes on with the parts that are missing. All at once they are read by
pandas.read_parquet("OUT/episodes"): a row per episode, and with --steps by pandas.read_parquet("OUT/steps"): a row per
step. There are a summary.csv and the figure SCENARIO_curve.png as well (reward against computation, with 90 %
intervals); settings.json and provenance.json say what they were made with. To go on, all options but --devices and
those of processes have to be the same.

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
  ms-highway sweep give_way --episodes 1000 --controllers tom schedule:tom={4,6,8},naive --out results/schedules

on two machines:
  ms-highway sweep merger --lambdas 0.001:10:25 --coordinator first:4000 --processes 2 --process 0 --out shared/sweep
  ms-highway sweep merger --lambdas 0.001:10:25 --coordinator first:4000 --processes 2 --process 1 --out shared/sweep"""


def add_sweep(commands: Any) -> None:
    """Add the command ``sweep`` to a parser's subparsers."""
    parser = add_command(commands, "sweep", "simulate thousands of episodes at once", HELP, EXAMPLES)
    parser.add_argument("scenario", metavar="SCENARIO", help=", ".join(SCENARIOS))
    parser.add_argument("--episodes", type=int, default=1000, help="episodes per controller (default: 1000)")
    parser.add_argument(
        "--lambdas",
        metavar="LOW:HIGH:COUNT",
        help="lambdas of switching, evenly spaced in their logarithm (three digits), or several with commas between "
        "(default: the paper's two, unless there are --controllers)",
    )
    parser.add_argument(
        "--controllers",
        nargs="+",
        metavar="CONTROLLER",
        help=f"{CONTROLLERS} (default: those of the ladder)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; the others count on (default: 0)")
    parser.add_argument("--ladder", nargs="+", metavar="MODEL", help="models to switch among (default: the scenario's)")
    add_semantics(parser)
    add_costs(parser, measured=False)
    add_planning(parser)
    parser.add_argument("--steps", action="store_true", help="keep a row per step as well, about 40 times as much")
    parser.add_argument("--part", type=int, default=1024, help="episodes per part, of any controller (default: 1024)")
    add_devices(parser)
    parser.add_argument("--coordinator", metavar="HOST:PORT", help="where process 0 of several is to be found")
    parser.add_argument("--processes", type=int, default=1, help="how many processes share the sweep (default: 1)")
    parser.add_argument("--process", type=int, default=0, help="which of them this one is (default: 0)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="directory of results")
    parser.set_defaults(run=_sweep, prepare=high_throughput)


def _sweep(options: argparse.Namespace) -> None:
    try:
        from ms_highway.experiments import sweep as module  # pyarrow is an extra
    except ModuleNotFoundError as error:
        raise ImportError(f"{error}; install the extra with: pip install 'ms-highway[sweep]'") from error
    check_least(options, episodes=1, part=1, devices=1, processes=1, seed=0, process=0)
    check_most(options, part=MOST, processes=MOST_PROCESSES)
    if options.process >= options.processes or (options.processes > 1) != (options.coordinator is not None):
        told = f"--process {options.process} of --processes {options.processes}, --coordinator {options.coordinator}"
        raise ValueError(
            f"{told}; processes are numbered from 0, and several need a coordinator, such as localhost:4000"
        )
    if options.seed + options.episodes > MOST_SEEDS:
        raise ValueError(f"--seed is {options.seed}; no seed may be {MOST_SEEDS} or more")
    comparison = _comparison(options, module.prices)
    comparison.check()
    job = module.Sweep(comparison, options.part, options.steps)
    if job.parts > MOST:
        told = f"--episodes {options.episodes} of {len(comparison.controllers[options.scenario])} controllers"
        raise ValueError(f"{told} are {job.parts} parts; there may be {MOST} with --part {options.part}")
    worker = module.Worker(options.process, options.processes)
    check_settings(options.out, job.settings())
    read_runs(options.out)  # refuses what cannot be read before anything is run
    with ExitStack() as stack:
        if worker.place == 0:
            stack.enter_context(held(options.out))
            tidy(options.out, *(options.out / kind for kind in (module.EPISODES, module.STEPS)))
        if worker.of > 1:
            stack.enter_context(together(options.coordinator, worker.of, worker.place))
        counts = module.run_sweep(job, options.out, use_devices(options.devices), worker)
        already, wanted = next(counts), sum(job.size(part) for part in worker.parts(job))
        if worker.place == 0 and module.missing(job, options.out):
            note_run(options)
        count_episodes(counts, already, wanted)
        module.wait_for_all(job, options.out)
        if worker.place == 0:
            _report(module.sweep_summary(module.read_sweep(job, options.out)), options.scenario, options.out)


def _comparison(options: argparse.Namespace, prices: Any) -> Comparison:
    environment_id(options.scenario)
    scenario = SCENARIOS[options.scenario]
    lambdas = prices(options.lambdas) if options.lambdas is not None else [] if options.controllers else scenario.prices
    controllers = [
        *(options.controllers or options.ladder or scenario.ladder),
        *(f"switching:{one:g}" for one in lambdas),
    ]
    return Comparison(
        {options.scenario: list(dict.fromkeys(controllers))},
        options.episodes,
        options.semantics,
        costs(options.costs),
        human_reward=human_reward(options.human_reward),
        ladder=options.ladder,
        first_seed=options.seed,
        planning=planning(options),
    )


def _report(summaries: Any, scenario: str, directory: Path) -> None:
    with replacing(directory / "summary.csv") as path:
        summaries.to_csv(path, index=False)
    with replacing(directory / f"{scenario}_curve.png") as path:
        curve(summaries, scenario).savefig(path, dpi=110)
    print_tables(table(summaries, scenario))
    print(f"results are in {directory}")
