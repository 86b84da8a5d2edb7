"""Drive many episodes: a process of its own for every driver in every scene, on one core.

A process is left after its episodes, because some scenes change the class of the other vehicles for good.
"""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from queue import Queue
from threading import Event

from ms_highway.benchmarks.processes import own_process
from ms_highway.benchmarks.road.episodes import Block, Episode, run_episode
from ms_highway.benchmarks.road.films import film
from ms_highway.runtime.jax_settings import cores, low_latency

__all__ = ["run_blocks"]

Report = tuple[Block, Episode | BaseException | None]


def run_blocks(
    blocks: Sequence[Block],
    seeds: Sequence[int],
    jobs: int | None = None,
    films: Path | None = None,
    modules: Sequence[str] = (),
) -> Iterator[tuple[Block, Episode]]:
    """Drive the same starts in all blocks.

    Args:
        blocks: each has a process.
        seeds: of the starts.
        jobs: number of processes at once, each on a core of its own while there are enough; by default, that of cores.
        films: directory for films of the first failure and the first success of each block.
        modules: to import in the processes.

    Yields:
        Each block with each of its episodes, as soon as it is done; those of a block in the order of the seeds.

    Raises:
        ImportError, ValueError: if a driver cannot be made.
    """
    reports: Queue[Report] = Queue()
    jobs = min(jobs or cores(), len(blocks))
    free: Queue[int] = Queue()
    for number in range(jobs):
        free.put(number)
    stopped = Event()

    def drive(block: Block) -> None:
        number = free.get()
        try:
            with own_process(partial(_on_one_core, number), modules) as process:
                episodes: list[Episode] = []
                for seed in seeds:
                    if stopped.is_set():
                        return
                    episodes.append(process.submit(run_episode, block, seed).result())
                    reports.put((block, episodes[-1]))
                if films is not None:
                    for name, seed in _worth_a_film(episodes).items():
                        path = films / f"{block.scene}_{block.driver.replace(':', '_')}_{name}_{seed}.gif"
                        process.submit(film, block, seed, path).result()
            reports.put((block, None))
        except BaseException as error:
            reports.put((block, error))
        finally:
            free.put(number)

    with ThreadPoolExecutor(jobs) as threads:
        try:
            for block in blocks:
                threads.submit(drive, block)
            left = len(blocks)
            while left:
                block, report = reports.get()
                if isinstance(report, BaseException):
                    raise report
                if report is None:
                    left -= 1
                else:
                    yield block, report
        finally:
            stopped.set()
            threads.shutdown(wait=False, cancel_futures=True)


def _worth_a_film(episodes: Sequence[Episode]) -> dict[str, int]:
    """Return the seeds of the first success and of the first failure, by these words, as far as there are such."""
    kinds = {"success": True, "failure": False}
    firsts = {name: next((e.seed for e in episodes if e.success is kind), None) for name, kind in kinds.items()}
    return {name: seed for name, seed in firsts.items() if seed is not None}


def _on_one_core(number: int) -> None:
    """Prepare a process for drivers that decide on one core."""
    if hasattr(os, "sched_setaffinity"):
        available = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {available[number % len(available)]})
    low_latency()
