"""Drive many episodes: a process of its own for every driver in every scene, on one core.

A process is left after its episodes, because some scenes change the class of the other vehicles for good.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from queue import Queue
from threading import Event

from ms_highway.benchmarks.road.episodes import Block, Episode, file_name, film, run_episode
from ms_highway.runtime.jax_settings import cores, low_latency_on_core, own_process


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
        ValueError: if a driver cannot be made.
    """
    reports: Queue[tuple[Block, Episode] | Future[None]] = Queue()  # episodes, and workers that are done
    remaining, stopped = iter(blocks), Event()

    def drive_blocks(core: int) -> None:
        for block in remaining:
            with own_process(partial(low_latency_on_core, core), modules) as process:
                firsts: dict[bool, int] = {}  # seeds of the first success and failure
                for seed in seeds:
                    if stopped.is_set():
                        return
                    episode = process.submit(run_episode, block, seed).result()
                    firsts.setdefault(episode.success, seed)
                    reports.put((block, episode))
                for success, seed in firsts.items():
                    name = f"{block.scene}_{block.driver}_{'success' if success else 'failure'}_{block.name(seed)}.gif"
                    if films:
                        process.submit(film, block, seed, films / file_name(name)).result()

    workers = min(jobs or cores(), len(blocks))
    with ThreadPoolExecutor(workers) as threads:
        try:
            for core in range(workers):
                threads.submit(drive_blocks, core).add_done_callback(reports.put)
            while workers:
                report = reports.get()
                if isinstance(report, Future):
                    report.result()
                    workers -= 1
                else:
                    yield report
        finally:
            stopped.set()
            threads.shutdown(wait=False, cancel_futures=True)
