"""The commands ``ms-highway compare`` and ``ms-highway sweep``: the same episodes, live and many at a time."""

import argparse
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING

from ms_highway.cli.command import command, number, option
from ms_highway.cli.console import count_episodes, own_results, print_tables, record, save_figure, say, warn
from ms_highway.cli.options import DEVICES, FORMATS, LEARNED, compared, comparison

if TYPE_CHECKING:
    from ms_highway.experiments.comparison import Comparison


@command(
    "compare",
    "compare controllers over many episodes",
    *compared(30, "results/compare", f"(default: all models of the ladder, {LEARNED}, and switching)"),
)
def compare(options: argparse.Namespace) -> None:
    """Run the same seeded episodes with several controllers and compare reward and computation.

    A controller is a human model that plans every step (naive, turn, tom); or learned:LAMBDA, which chooses the model
    at every step by a learned value of computation, at a price of LAMBDA reward for a second of planning
    (learned:LAMBDA:FILE with values of `ms-highway values learn`); or switching:LAMBDA, which chooses by the paper's
    Algorithm 1, or horizon:LAMBDA, by gains that are estimated over the whole plan instead of one step; or
    schedule:MODEL=STEPS,...,MODEL, an order that is fixed beforehand, such as schedule:tom=6,naive; or
    period:MODEL=STEPS,..., an order that is repeated, such as period:tom=1,naive=3; or random:MODEL=SHARE,..., a model
    drawn for every step, such as random:naive=0.7,tom=0.3: a choice that looks at nothing, which others have to beat.
    Without scenarios and controllers, the paper's comparison runs: its three scenarios, each with its ladder and the
    paper's two lambdas, and learned:1 beside them. stay-back-v1, merger-v1 and give-way-v1 are the same scenes within
    what tyres hold.

    In dense-merge-v1, dense_merge and crossing_crowd, a controller chooses a model for each of several humans. A
    model's name stands for all humans; nearest:K predicts the K nearest humans by tom, and the others naively;
    budget:MILLISECONDS chooses what is worth most within this time of planning and deciding per step.

    Any controller with +belief at the end, such as tom+belief, infers from what each human does whether it is predicted
    by naive, idm, turn or tom, and plans naively where a model would count on a response that the human does not show.

    Episodes run on two cores where there are two. Results go to --out: steps.csv (a row per step; until all episodes
    have ended, each is a file in parts), summary.csv, and per scenario the figures SCENARIO_bars (of three lambdas or
    more _curve, reward against computation), _timeline and _decisions; settings.json and provenance.json say what they
    were made with. If stopped and started again with the same --out, it resumes; with
    more controllers or scenarios, it adds them. `ms-highway report` makes a page of them.

    Examples:
      ms-highway compare
      ms-highway compare merger-v1 give-way-v1 stay-back-v1 --out results/physical
      ms-highway compare merger --controllers naive tom learned:1 switching:0.1 --seeds 10 --out results/merger
      ms-highway compare merger --controllers tom switching schedule:tom={4,6,8},naive --lambdas 0.01:1:9 --out out
      ms-highway compare merger --set ladder=naive,tom --controllers switching:0.1 --out results/two_rungs
      ms-highway compare give_way --set semantics=released --set costs=measured --out results/measured
      ms-highway compare stay_back --controllers naive turn --set solver=newton --seeds 100 --out results/newton
      ms-highway compare --seeds 300 --set control_limit=0.2,9 --out results/what_tyres_hold
      ms-highway compare dense_merge --controllers naive tom nearest:1 budget:20 --out results/dense_merge
      ms-highway compare merger --set yielding=never --controllers tom tom+belief --out results/never
    """
    from ms_highway.experiments.directory import write_table
    from ms_highway.experiments.results import read_results
    from ms_highway.experiments.runner import only, run
    from ms_highway.experiments.summary import summary
    from ms_highway.visualization.figures import CAPTIONS, figures
    from ms_highway.visualization.tables import table

    asked = comparison(options)
    if not options.controllers:
        asked = _with_learned(asked)
    with own_results(options) as directory:
        counts, wanted = run(asked, options.out, 2, options.modules), len(list(asked.episodes()))
        already = next(counts)
        if already < wanted:
            record(directory, options)
            for scenario, name, kind in product(asked.controllers, CAPTIONS, FORMATS):  # of fewer episodes
                (options.out / f"{scenario}_{name}.{kind}").unlink(missing_ok=True)
        count_episodes(counts, already, wanted)
        results = read_results(options.out)  # of this command and of those before
        own = summary(only(asked, results.records))
        print_tables(*(table(own, scenario) for scenario in asked.controllers))
        write_table(results.summaries, options.out / "summary.csv")
        for scenario in asked.controllers:
            for name, draw in figures(results.records, results.summaries, scenario).items():
                save_figure(draw(), options.out / f"{scenario}_{name}.{options.format}")
    say(f"results are in {options.out}")


def _with_learned(asked: "Comparison") -> "Comparison":
    """Return a comparison with learned values, before switching, where they suit the ladder."""
    controllers = {}
    for scenario, names in asked.controllers.items():
        controllers[scenario] = list(names)
        place = next((place for place, name in enumerate(names) if name.startswith("switching")), len(names))
        try:
            asked.environment_config(scenario, LEARNED)
            controllers[scenario].insert(place, LEARNED)
        except ValueError as error:
            warn(f"{scenario} is compared without {LEARNED}: {error}")
    return replace(asked, controllers=controllers)


@command(
    "sweep",
    "simulate thousands of episodes at once",
    *compared(1000, None),
    option("--steps", "keep a row per step as well, about 40 times as much", action="store_true"),
    number("--part", 1024, "episodes per part, of any controller"),
    DEVICES,
    option("--scheduler", "of a cluster of Dask that computes, tcp://HOST:PORT", metavar="ADDRESS"),
    simulates=True,
)
def sweep(options: argparse.Namespace) -> None:
    r"""Simulate very many episodes of one scenario, all in JAX and many at a time, and compare reward and computation.

    Episodes are those of `ms-highway compare`, which explains the controllers: the same seed gives the same start, and
    what happens is the same up to rounding. Nothing is timed: planning counts the seconds of --set costs=..., which
    among several humans are those of a plan in which one human is predicted by a model and the others naively. A budget
    counts these seconds, and deciding as nothing: no plan is late.

    Results go to --out, as parts of --part episodes each, which are written as they are done; if stopped or killed and
    started again with the same --out, the sweep computes the missing parts. pandas.read_parquet("OUT/episodes") reads
    all parts at once: a row per episode; with --steps, pandas.read_parquet("OUT/steps") reads a row per step. There are
    a summary.csv and the figure SCENARIO_curve as well (reward against computation, with 90 % intervals); settings.json
    and provenance.json say what they were made with. To resume, all options but --devices and --scheduler have to be
    the same.

    Episodes are shared by all devices (on CPUs, by default one per core), or, with --scheduler, by the workers of a
    cluster of dask.distributed, which return their rows: they need the same versions, and the modules of --import and
    the files that controllers name, but no disk in common. A part of a worker that is lost goes to another one.
    Episodes are the same byte for byte, however often the sweep is stopped and whatever computes it; only other kinds
    of processors may round otherwise, so do not mix them. Whoever reaches a scheduler of Dask can run any program
    there: keep it inside your own network.

    Memory is bounded. Every device compiles its own program, which takes about half a GB, and they compute one part at
    a time, which takes 25 kB for each episode of --part. The summary at the end takes 0.5 kB for each episode. Needs
    the extra "sweep".

    Examples:
      ms-highway sweep merger --seeds 10000 --lambdas 0.001:10:25 --out results/sweep
      ms-highway sweep dense_merge --seeds 100 --controllers naive tom nearest:1 \
        --set costs=naive=0.001,turn=0.002,tom=0.01 --out results/crowd
      ms-highway sweep give_way --seeds 1000 --controllers tom schedule:tom={4,6,8},naive --out results/schedules

    on a cluster of Dask; HOST runs the scheduler, and every machine the line with `dask worker`:
      dask scheduler &
      dask worker tcp://HOST:8786 --nworkers 4 --nthreads 1 &
      ms-highway sweep merger --lambdas 0.001:10:25 --scheduler tcp://HOST:8786 --out results/sweep

    on a cluster of Slurm (pip install dask-jobqueue), the Python program:
    import subprocess
    from dask_jobqueue import SLURMCluster
    cluster = SLURMCluster(cores=4, processes=4, memory="8GB", walltime="04:00:00")  # of a job, with 4 workers
    cluster.scale(jobs=10)
    command = "ms-highway sweep merger --lambdas 0.001:10:25 --out results/sweep --scheduler"
    subprocess.run([*command.split(), cluster.scheduler_address], check=True)
    """
    from ms_highway.experiments.batch import simulate_parts
    from ms_highway.experiments.directory import write_table
    from ms_highway.experiments.runner import Compute, read_episodes, run_batched
    from ms_highway.experiments.summary import summary
    from ms_highway.loop.devices import use_devices
    from ms_highway.runtime.extras import needing
    from ms_highway.visualization.tables import table
    from ms_highway.visualization.tradeoff import curve

    if options.devices and options.scheduler:
        raise ValueError("--devices are of this machine, and --scheduler computes on others; leave one out")
    asked, out = comparison(options), options.out
    with ExitStack() as stack:
        with needing("sweep"):
            import pyarrow  # noqa: F401  # writes the parts

            if options.scheduler:
                from ms_highway.experiments.cluster import connected
        directory = stack.enter_context(own_results(options))
        if options.scheduler:
            compute: Compute = stack.enter_context(connected(options.scheduler, options.modules))
        else:
            compute = partial(simulate_parts, mesh=use_devices(options.devices))
        counts, wanted = run_batched(asked, out, options.part, options.steps, compute), len(list(asked.episodes()))
        already = next(counts)
        if already < wanted:
            record(directory, options)
        count_episodes(counts, already, wanted)
        (scenario,) = asked.controllers
        summaries = summary(read_episodes(out))
        write_table(summaries, out / "summary.csv")
        save_figure(curve(summaries, scenario), out / f"{scenario}_curve.{options.format}")
        print_tables(table(summaries, scenario))
    say(f"results are in {out}")
