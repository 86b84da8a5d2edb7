"""Define ``ms-highway compare`` and ``sweep``: the same episodes, live or simulated."""

import argparse
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from itertools import product, takewhile
from typing import TYPE_CHECKING

from ms_highway.cli.console import (
    command,
    count_episodes,
    number,
    option,
    print_tables,
    record_run,
    save_figures,
    say,
    warn,
)
from ms_highway.cli.options import (
    DEFAULT_CONTROLLER,
    DEVICES,
    FORMATS,
    comparison_options,
    read_comparison,
)

if TYPE_CHECKING:
    from ms_highway.experiments.comparison import Comparison


@command(
    "compare",
    "compare controllers over many episodes",
    *comparison_options(
        30,
        "results/compare",
        f"(default: all models of the ladder, {DEFAULT_CONTROLLER}, and switching)",
    ),
)
def compare(options: argparse.Namespace) -> None:
    r"""Compare the reward and computation of controllers on the same seeded episodes.

    The controllers are:

      naive, turn, tom        this human model in every step
      learned:LAMBDA          chooses the model at every step by a learned value of
                              computation, at a price of LAMBDA reward for a second of
                              planning; learned:LAMBDA:FILE takes values of `ms-highway
                              values learn`
      switching:LAMBDA        chooses by the paper's Algorithm 1
      horizon:LAMBDA          the same, with gains over the whole plan instead of one
                              step
      schedule:tom=6,naive    a fixed order: tom for six steps, then naive
      random:tom=0.3,naive=0.7  a model drawn for every step with these shares, a
                              baseline for every choice

    Without scenarios and controllers, the paper's comparison runs: its three scenarios,
    each with its ladder and the paper's two lambdas, and also learned:1. stay-back-v1,
    merger-v1 and give-way-v1 are the same scenes within what tyres hold.

    In dense-merge-v1 and crossing-crowd-v1, and in the easier dense_merge and
    crossing_crowd, there are several humans, and a controller chooses a model for each.
    A model's name stands for all humans; nearest:K predicts the K nearest humans by tom
    and the others naively; budget:MILLISECONDS chooses what gains most within this time
    of planning and deciding per step.

    Any controller with +belief at the end, such as tom+belief, infers whether naive,
    idm, turn or tom predicts each human, and plans naively where a model would count on
    a response that the human does not show.

    Episodes run on two cores if there are two. Results go to --out: steps.csv (a row
    per step; before all episodes have ended, a file per episode in parts), summary.csv,
    and the figures SCENARIO_bars (SCENARIO_curve, reward against computation, for three
    lambdas or more), SCENARIO_reward (reward along the episode, with 90 % intervals),
    SCENARIO_timeline and SCENARIO_decisions; settings.json and provenance.json say how
    they were made. The same command with the same --out resumes a comparison that was
    stopped; more controllers or scenarios are added to it. If a module of --import or a
    file that a controller names has changed since, it is refused. `ms-highway report`
    makes a page of the results.

    Examples:
      ms-highway compare
      ms-highway compare merger-v1 give-way-v1 stay-back-v1 --out results/physical
      ms-highway compare merger --controllers naive tom learned:1 switching:0.1 \
        --seeds 10 --out results/merger
      ms-highway compare merger --controllers tom switching schedule:tom={4,6,8},naive \
        --lambdas 0.01:1:9 --out out
      ms-highway compare merger --set ladder=naive,tom --controllers switching:0.1 \
        --out results/two_rungs
      ms-highway compare give_way --set semantics=released --set costs=measured \
        --out results/measured
      ms-highway compare --seeds 300 --set control_limit=0.2,9 \
        --out results/what_tyres_hold
      ms-highway compare dense_merge --controllers naive tom nearest:1 budget:20 \
        --out results/dense_merge
      ms-highway compare merger --set yielding=never --controllers tom tom+belief \
        --out results/never
    """
    from ms_highway.experiments.directory import ResultsDirectory, write_table
    from ms_highway.experiments.runner import only, run
    from ms_highway.experiments.summary import read_results, summary
    from ms_highway.visualization.figures import CAPTIONS, figures
    from ms_highway.visualization.tables import table

    comparison = read_comparison(options)
    if not options.controllers:
        comparison = _with_learned(comparison)
    with ResultsDirectory(options.out).owned() as directory:
        counts = run(comparison, options.out, 2, options.modules)
        total = len(list(comparison.episodes()))
        already = next(counts)
        record_run(directory, options, computes=already < total)
        if already < total:
            # Figures that are there show fewer episodes.
            for scenario, name, kind in product(
                comparison.controllers, CAPTIONS, FORMATS
            ):
                (options.out / f"{scenario}_{name}.{kind}").unlink(missing_ok=True)
        count_episodes(counts, already, total)

        # Print the results of this command; keep also those of commands before it.
        results = read_results(options.out)
        own = summary(only(comparison, results.records))
        print_tables(*(table(own, scenario) for scenario in comparison.controllers))
        write_table(results.summaries, options.out / "summary.csv")
        for scenario in comparison.controllers:
            drawings = figures(results.records, results.summaries, scenario)
            named = {f"{scenario}_{name}": draw for name, draw in drawings.items()}
            save_figures(named, options.out, options.format)
    say(f"results are in {options.out}")


def _with_learned(comparison: "Comparison") -> "Comparison":
    """Insert learned values before switching, in scenarios whose ladder they know."""
    controllers = {}
    for scenario, names in comparison.controllers.items():
        controllers[scenario] = list(names)
        try:
            comparison.environment_config(scenario, DEFAULT_CONTROLLER)
        except ValueError as error:
            warn(f"{scenario} is compared without {DEFAULT_CONTROLLER}: {error}")
            continue
        before_switching = list(takewhile(_does_not_switch, names))
        controllers[scenario].insert(len(before_switching), DEFAULT_CONTROLLER)
    return replace(comparison, controllers=controllers)


def _does_not_switch(controller: str) -> bool:
    return not controller.startswith("switching")


@command(
    "sweep",
    "simulate thousands of episodes at once",
    *comparison_options(1000, None),
    option(
        "--steps",
        "also keep a row per step, about 40 times as much data",
        action="store_true",
    ),
    number("--part", 1024, "episodes per part"),
    DEVICES,
    option(
        "--scheduler",
        "address of a Dask cluster that computes, tcp://HOST:PORT",
        metavar="ADDRESS",
    ),
    simulates=True,
)
def sweep(options: argparse.Namespace) -> None:
    r"""Simulate many episodes of one scenario at once in JAX, and compare controllers.

    The episodes and controllers are those of `ms-highway compare`: the same seed gives
    the same start and, up to rounding, the same episode. Nothing is timed: planning
    counts the seconds of --set costs=...; among several humans, these are of a plan
    that predicts one human by a model and the others naively. A budget counts these
    seconds and none for deciding, and no plan is late.

    Results go to --out, in parts of --part episodes, each written when it is done. The
    same command with the same --out computes the missing parts of a sweep that was
    stopped or killed; only --devices and --scheduler may differ.
    pandas.read_parquet("OUT/episodes") reads a row per episode and, with --steps,
    pandas.read_parquet("OUT/steps") a row per step. There are also summary.csv and the
    figure SCENARIO_curve (reward against computation, with 90 % intervals);
    settings.json and provenance.json say how they were made.

    All devices share the work (on CPUs, by default one per core) or, with --scheduler,
    the workers of a cluster of dask.distributed. Workers return their rows. They need
    the same versions, the modules of --import and the files that controllers name, but
    no common disk. A part of a lost worker goes to another one. Episodes are the same
    byte for byte, however often the sweep is stopped and whatever computes it, except
    that other kinds of processors may round differently: do not mix them. Anybody who
    reaches a Dask scheduler can run any program there: keep it inside your own network.

    Memory is bounded. Every device compiles its own program, which takes about half a
    GB. A part takes 25 kB for each of its episodes, and the summary 0.5 kB for each
    episode. Needs the extra "sweep".

    Examples:
      ms-highway sweep merger --seeds 10000 --lambdas 0.001:10:25 --out results/sweep
      ms-highway sweep dense_merge --seeds 100 --controllers naive tom nearest:1 \
        --set costs=naive=0.001,turn=0.002,tom=0.01 --out results/crowd
      ms-highway sweep give_way --seeds 1000 \
        --controllers tom schedule:tom={4,6,8},naive --out results/schedules

    on a cluster of Dask: HOST runs the scheduler, every machine runs `dask worker`:
      dask scheduler &
      dask worker tcp://HOST:8786 --nworkers 4 --nthreads 1 &
      ms-highway sweep merger --lambdas 0.001:10:25 --scheduler tcp://HOST:8786 \
        --out results/sweep

    on a cluster of Slurm (pip install dask-jobqueue), the Python program:
    import subprocess
    from dask_jobqueue import SLURMCluster
    # Each job has these resources, and 4 workers.
    cluster = SLURMCluster(cores=4, processes=4, memory="8GB", walltime="04:00:00")
    cluster.scale(jobs=10)
    sweep = "ms-highway sweep merger --lambdas 0.001:10:25 --out results/sweep"
    command = [*sweep.split(), "--scheduler", cluster.scheduler_address]
    subprocess.run(command, check=True)
    """
    from ms_highway.experiments.batch import simulate_parts
    from ms_highway.experiments.directory import ResultsDirectory, write_table
    from ms_highway.experiments.runner import Compute, read_episodes, run_batched
    from ms_highway.experiments.summary import summary
    from ms_highway.runtime.compilation import use_devices
    from ms_highway.runtime.extras import needing
    from ms_highway.visualization.tables import table
    from ms_highway.visualization.tradeoff import curve

    if options.devices and options.scheduler:
        raise ValueError(
            "--devices compute on this machine, and --scheduler on others; leave"
            " one out"
        )
    comparison = read_comparison(options)
    out = options.out
    with needing("sweep"):
        # It writes the parts.
        import pyarrow  # noqa: F401

        if options.scheduler:
            from ms_highway.experiments.cluster import connected

    # What computes the parts: workers of a cluster, or this machine.
    computing: AbstractContextManager[Compute]
    if options.scheduler:
        computing = connected(options.scheduler, comparison, options.modules)
    else:
        devices = use_devices(options.devices)
        computing = nullcontext(partial(simulate_parts, devices=devices))

    with ResultsDirectory(out).owned() as directory, computing as compute:
        counts = run_batched(comparison, out, options.part, options.steps, compute)
        total = len(list(comparison.episodes()))
        already = next(counts)
        record_run(directory, options, computes=already < total)
        count_episodes(counts, already, total)

        (scenario,) = comparison.controllers
        summaries = summary(read_episodes(out, comparison, options.part))
        write_table(summaries, out / "summary.csv")
        print_tables(table(summaries, scenario))
        drawings = {f"{scenario}_curve": partial(curve, summaries, scenario)}
        save_figures(drawings, out, options.format)
    say(f"results are in {out}")
