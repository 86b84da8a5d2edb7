"""The command ``ms-highway sweep``."""

import argparse
import json
from contextlib import ExitStack
from typing import Any

from ms_highway.cli.console import add_command, count_episodes, print_tables
from ms_highway.cli.options import MOST, MOST_PROCESSES, add_comparison, add_devices, add_number, comparison
from ms_highway.runtime.extras import needing

HELP = """\
Simulate very many episodes of one scenario, all in JAX and many at a time, and compare reward and computation.

Episodes are those of `ms-highway compare`, which explains the controllers: the same seed gives the same start, and what
happens is the same up to rounding. Nothing is timed: planning counts the seconds of --set costs=..., which among
several humans are those of a plan in which one human is predicted by a model and the others naively. A budget counts
these seconds, and deciding as nothing: no plan is late.

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
  ms-highway sweep merger --seeds 10000 --lambdas 0.001:10:25 --out results/sweep
  ms-highway sweep dense_merge --seeds 100 --controllers naive tom nearest:1 \\
    --set costs=naive=0.001,turn=0.002,tom=0.01 --out results/crowd
  ms-highway sweep give_way --seeds 1000 --controllers tom schedule:tom={4,6,8},naive --out results/schedules

on two machines:
  ms-highway sweep merger --lambdas 0.001:10:25 --coordinator first:4000 --processes 2 --process 0 --out shared/sweep
  ms-highway sweep merger --lambdas 0.001:10:25 --coordinator first:4000 --processes 2 --process 1 --out shared/sweep"""


def add_sweep(commands: Any) -> None:
    """Add the command ``sweep`` to a parser's subparsers."""
    parser = add_command(commands, "sweep", "simulate thousands of episodes at once", HELP, EXAMPLES)
    add_comparison(parser, 1000, None)
    parser.add_argument("--steps", action="store_true", help="keep a row per step as well, about 40 times as much")
    add_number(parser, "--part", 1024, "episodes per part, of any controller")
    add_devices(parser)
    parser.add_argument("--coordinator", metavar="HOST:PORT", help="where process 0 of several is to be found")
    add_number(parser, "--processes", 1, "how many processes share the sweep", most=MOST_PROCESSES)
    add_number(parser, "--process", 0, "which of them this one is", 0)
    parser.set_defaults(run=_sweep, simulates=True)


def _sweep(options: argparse.Namespace) -> None:
    with needing("sweep"):
        from ms_highway.experiments import sweep as module
    from ms_highway.cli.results_directory import own_results, save_figures, write_table
    from ms_highway.experiments.analysis.summary import summary
    from ms_highway.runtime.peers import together
    from ms_highway.simulation.devices import use_devices
    from ms_highway.visualization.comparison import table
    from ms_highway.visualization.tradeoff import curve

    place, processes = options.process, options.processes
    if place >= processes or (processes > 1) != (options.coordinator is not None):
        given = f"--process {place} of --processes {processes}, --coordinator {options.coordinator}"
        remedy = "processes are numbered from 0, and several need a coordinator, such as localhost:4000"
        raise ValueError(f"{given}; {remedy}")
    if len(options.scenarios) != 1:
        raise ValueError(f"there are {len(options.scenarios)} scenarios; a sweep is of one")
    job = module.Sweep(comparison(options), options.out, options.part, options.steps, place, processes)
    if len(job.parts) > MOST:
        parts = f"{job.episodes} episodes are {len(job.parts)} parts"
        raise ValueError(f"{parts}; there may be {MOST}, of --part episodes each")
    with ExitStack() as stack:
        if place == 0:
            kinds = [options.out / kind for kind in (module.EPISODES, module.STEPS)]
            record = stack.enter_context(own_results(options, job.settings(), *kinds))
        if processes > 1:
            stack.enter_context(together(options.coordinator, processes, place, json.dumps(job.settings())))
        counts = module.run_sweep(job, use_devices(options.devices))
        already = next(counts)
        if place == 0 and job.missing():
            record()
        count_episodes(counts, already, job.size(*job.own))
        episodes = module.read_sweep(job)
        if place == 0:
            summaries = summary(episodes)
            write_table(summaries, options.out / "summary.csv")
            save_figures({f"{job.scenario}_curve": curve(summaries, job.scenario)}, options.out)
            print_tables(table(summaries, job.scenario))
            print(f"results are in {options.out}")
