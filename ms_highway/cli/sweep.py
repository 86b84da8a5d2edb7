"""The command ``ms-highway sweep``."""

import argparse
from contextlib import ExitStack
from functools import partial

from ms_highway.cli.command import MOST, command, number, option
from ms_highway.cli.console import count_episodes, print_tables, say
from ms_highway.cli.options import DEVICES, compared, comparison
from ms_highway.runtime.extras import needing


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
    a time, which takes 25 kB for each episode of --part. The summary at the end reads 0.1 kB for each episode. Needs
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
    with needing("sweep"):
        from ms_highway.experiments import sweep as module
    from ms_highway.cli.results_directory import own_results, save_figure, write_table
    from ms_highway.experiments.analysis.summary import summary
    from ms_highway.loop.devices import use_devices
    from ms_highway.visualization.comparison import table
    from ms_highway.visualization.tradeoff import curve

    if len(options.scenarios) != 1:
        raise ValueError(f"there are {len(options.scenarios)} scenarios; a sweep is of one")
    if options.devices and options.scheduler:
        raise ValueError("--devices are of this machine, and --scheduler computes on others; leave one out")
    job = module.Sweep(comparison(options), options.out, options.part, options.steps)
    if len(job.parts) > MOST:
        parts = f"{job.episodes} episodes are {len(job.parts)} parts"
        raise ValueError(f"{parts}; there may be {MOST}, of --part episodes each")
    with ExitStack() as stack:
        record = stack.enter_context(own_results(options, job.settings()))
        if options.scheduler:
            with needing("sweep"):
                from ms_highway.experiments.cluster import connected
            compute = stack.enter_context(connected(options.scheduler, options.modules))
        else:
            compute = partial(module.compute_here, mesh=use_devices(options.devices))
        counts = module.run_sweep(job, compute)
        already = next(counts)
        if already < job.episodes:
            record()
        count_episodes(counts, already, job.episodes)
        summaries = summary(job.read())
        write_table(summaries, options.out / "summary.csv")
        save_figure(curve(summaries, job.scenario), options.out / f"{job.scenario}_curve.{options.format}")
        print_tables(table(summaries, job.scenario))
        say(f"results are in {options.out}")
