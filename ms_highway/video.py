"""Videos of episodes."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ms_highway.experiment import episode, make_environment
from ms_highway.files import replacing

__all__ = ["check_format", "frames", "write"]

FORMATS = (".mp4", ".gif")


def frames(scenario: str, controller: str, seed: int, **config: Any) -> tuple[list[UInt8[np.ndarray, "h w 3"]], int]:
    """All frames of an episode in a configured environment, and the frames per second of true speed."""
    env = make_environment(scenario, controller, render=True, **config)
    pictures = [np.asarray(env.render()) for _ in episode(env, seed)]
    rate = env.metadata["render_fps"]
    env.close()
    return pictures, rate


def check_format(path: Path) -> None:
    """Refuse a file name that says no known format.

    Raises:
        ValueError: if the name does not end in .mp4 or .gif.
    """
    if path.suffix not in FORMATS:
        raise ValueError(f"cannot tell the format of {path}; its name must end in {' or '.join(FORMATS)}")


def write(pictures: list[UInt8[np.ndarray, "h w 3"]], path: Path, frames_per_second: float) -> None:
    """Write a video under a temporary name and move it into place.

    Raises:
        ValueError: if the name does not end in .mp4 or .gif.
        ImportError: without the packages of the extra ``video``.
    """
    check_format(path)
    try:
        import imageio.v3 as imageio
    except ImportError as error:
        raise ImportError("videos need the extra 'video': pip install 'ms-highway[video]'") from error
    with replacing(path) as temporary:
        if path.suffix == ".gif":
            imageio.imwrite(temporary, np.stack(pictures), duration=1000 / frames_per_second, loop=0)
        else:
            imageio.imwrite(temporary, np.stack(pictures), plugin="pyav", fps=frames_per_second, codec="libx264")
