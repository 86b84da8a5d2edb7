"""Film episodes of a driver in a scene."""

from pathlib import Path
from typing import Any

from ms_highway.benchmarks.road.episodes import Block, make_driver, run_episode
from ms_highway.visualization.video import write

__all__ = ["film"]

FRAMES_PER_SECOND = 15  # at most


def film(block: Block, seed: int, path: Path) -> None:
    """Drive an episode again and write it to a video file, ``.gif`` or ``.mp4``, that plays at true speed.

    Raises:
        OSError: if it cannot be written.
    """
    env = make_driver(block, render_mode="rgb_array")
    inner: Any = env.unwrapped
    frequency = inner.config["simulation_frequency"]
    every = max(1, round(frequency / FRAMES_PER_SECOND))
    pictures: list[Any] = []
    frames = 0

    def look() -> None:
        nonlocal frames
        if frames % every == 0:
            pictures.append(env.render())
        frames += 1

    run_episode(block, seed, env, look)
    env.close()
    write(pictures, path, frequency / every)
