"""Keep what learning has computed, by round and course, so that an interrupted run goes on from there."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np

from ms_highway.experiments.resuming import cannot_resume
from ms_highway.runtime.files import replacing

__all__ = ["keep", "read_kept"]

Kept = TypeVar("Kept", bound=tuple[Any, ...])


def keep(file: Path, done: Mapping[tuple[int, int], Any], about: str) -> None:
    """Write named tuples of arrays by round and number of the course, atomically; ``about`` says what made them."""
    arrays = {"about": np.array(about)} | {
        f"{number}/{place}/{name}": array
        for (number, place), part in done.items()
        for name, array in part._asdict().items()
    }
    with replacing(file) as path, path.open("wb") as opened:
        np.savez(opened, **arrays)


def read_kept(file: Path, about: str, kind: type[Kept]) -> dict[tuple[int, int], Kept]:
    """Read what `keep` wrote.

    Args:
        file: that it wrote.
        about: what must have made it.
        kind: named tuple of the arrays.

    Raises:
        ValueError: if the file cannot be read, or something else made it.
    """
    fields: tuple[str, ...] = kind._fields  # type: ignore[attr-defined]
    try:
        with file.open("rb") as opened, np.load(opened, allow_pickle=False) as archive:
            if str(archive["about"]) != about:
                raise ValueError(f"it holds {kind.__name__.lower()} of other settings")
            names = [name.split("/") for name in archive.files if name != "about"]
            places = dict.fromkeys((int(number), int(place)) for number, place, _ in names)
            return {(a, b): kind(*(archive[f"{a}/{b}/{name}"] for name in fields)) for a, b in places}
    except (BadZipFile, EOFError, KeyError, OSError, TypeError, ValueError) as error:
        raise cannot_resume(file, error, "remove it, or choose another --out") from error
