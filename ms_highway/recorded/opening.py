"""Open a recording of traffic: a CommonRoad file, or the one in the package."""

import gzip
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path

import msgspec
import numpy as np

from ms_highway.recorded.commonroad import read_scenario
from ms_highway.recorded.scenario import TrafficRecording

SHIPPED_RECORDING = "us101"
"""Name of the recording that comes with the package."""


def open_recording(recording: str) -> TrafficRecording:
    """Return the recording of a CommonRoad file, or the one in the package by its name.

    Files are read again only after they have changed.

    Raises:
        ValueError: naming the file and the problem.
    """
    if recording == SHIPPED_RECORDING:
        return _shipped_recording()
    path = Path(recording)
    if not path.is_file():
        raise ValueError(
            f"config['recording'] is {recording!r}, which is no file; give the file of"
            f" a CommonRoad scenario, *.xml or *.xml.gz, or {SHIPPED_RECORDING!r},"
            " which comes with the package"
        )
    return _read_version(path.resolve(), path.stat().st_mtime_ns)


@cache
def _shipped_recording() -> TrafficRecording:
    file = (
        resources.files("ms_highway") / "data" / f"{SHIPPED_RECORDING}_traffic.json.gz"
    )
    unpacked = gzip.decompress(file.read_bytes())
    return msgspec.json.decode(unpacked, type=TrafficRecording, dec_hook=_array)


def _array(_: type, numbers: list) -> np.ndarray:
    """Return the array that a list of JSON stands for."""
    return np.array(numbers, float)


@lru_cache(TrafficRecording.cache_size)
def _read_version(path: Path, time_of_change: int) -> TrafficRecording:
    """Read the version of a file that was written at a time [ns]."""
    return read_scenario(path)
