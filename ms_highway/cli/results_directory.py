"""A run that owns its results directory: alone in it, under the same settings, with what made it on record."""

import argparse
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ms_highway.cli.console import warn
from ms_highway.experiments.directory import ResultsDirectory
from ms_highway.runtime.files import replacing

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@contextmanager
def own_results(options: argparse.Namespace, settings: Mapping[str, Any] | None = None) -> Iterator[Callable[[], None]]:
    """Let only this run write to the directory ``--out`` while the block runs.

    Args:
        options: of the command.
        settings: of the results; without, the block checks and writes them.

    Yields:
        A function that records settings and provenance, to be called once the results are begun or there.

    Raises:
        ValueError: if another command is writing there, or what is there has other settings or cannot be read.
    """
    results = ResultsDirectory(options.out)
    with results.owned():
        if settings is not None:
            results.take_up(settings)

        def record() -> None:
            if settings is not None:
                results.write_settings(settings)
            if differing := results.record(options.command_line):
                warn(f"{options.out} continues with {differing}; results may not agree")

        yield record


def write_table(table: "pd.DataFrame", file: Path) -> None:
    """Write a table without its index to a file of comma-separated values."""
    with replacing(file) as path:
        table.to_csv(path, index=False)


def save_figure(figure: "Figure", file: Path) -> None:
    """Write a figure to a file, ``.png``, ``.pdf`` or ``.svg``."""
    from ms_highway.visualization.figures import content

    with replacing(file) as path:
        path.write_bytes(content(figure, file.suffix[1:]))
