"""Drive many episodes: a process of its own for every driver in every scene, on one core.

A process is left after its episodes, because some scenes change the class of the other vehicles for good.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from queue import Queue

from ms_highway.benchmarks.road.episodes import Block, Episode, file_name, film, run_episode
from ms_highway.runtime.jax_settings import cores, low_latency_on_core, own_process


def run_blocks(
    blocks: Sequence[Block],
    seeds: Sequence[int],
    jobs: int | None = None,
    films: Path | None = None,
    modules: Sequence[str] = (),
) -> Iterator[tuple[Block, list[Episode]]]:
    """Drive the same starts in all blocks; yield each block with its episodes, in the order of blocks and seeds.

    Args:
        blocks: each has a process.
        seeds: of the starts.
        jobs: number of processes at once, each on a core of its own while there are enough; by default, that of cores.
        films: directory for films of the first failure and the first success of each block.
        modules: to import in the processes.

    Raises:
        ValueError: if a driver cannot be made.
    """
    workers, free = min(jobs or cores(), len(blocks)), Queue[int]()
    for core in range(workers):
        free.put(core)

    def drive(block: Block) -> tuple[Block, list[Episode]]:
        core = free.get()
        try:
            with own_process(partial(low_latency_on_core, core), modules) as process:
                return block, drive_on(process, block)
        finally:
            free.put(core)

    def drive_on(process: ProcessPoolExecutor, block: Block) -> list[Episode]:
        episodes = [process.submit(run_episode, block, seed).result() for seed in seeds]
        firsts = {episode.success: episode.seed for episode in reversed(episodes)}
        for success, seed in firsts.items():
            name = f"{block.scene}_{block.driver}_{'success' if success else 'failure'}_{block.name(seed)}.gif"
            if films:
                process.submit(film, block, seed, films / file_name(name)).result()
        return episodes

    with ThreadPoolExecutor(workers) as threads:
        yield from threads.map(drive, blocks)
