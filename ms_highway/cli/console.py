"""Print what commands tell, and keep their results."""

import argparse
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from shutil import get_terminal_size
from time import perf_counter
from typing import TYPE_CHECKING

from ms_highway.cli.command import PAGE_WIDTH

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from ms_highway.experiments.directory import ResultsDirectory


@contextmanager
def printing() -> Iterator[None]:
    """Flush standard output after a block that only prints.

    If the reader has closed the pipe, as ``| head`` does, drop this and all later output.

    Raises:
        OSError: if standard output cannot be written, for example on a full disk.
    """
    try:
        yield
        print(end="", flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python would try again when it exits
        if not isinstance(error, BrokenPipeError):
            raise OSError(f"standard output cannot be written: {error.strerror}") from error


def say(text: str) -> None:
    """Print a text to standard output."""
    with printing():
        print(text)


def tell(message: str) -> None:
    """Print a message about progress to standard error."""
    print(message, file=sys.stderr, flush=True)


def warn(message: object) -> None:
    """Print one line to standard error."""
    tell(f"ms-highway: {message}")


def print_tables(*tables: "DataFrame") -> None:
    """Print tables no wider than the terminal or COLUMNS or, without both, than `PAGE_WIDTH`."""
    from ms_highway.visualization.tables import printed

    width = get_terminal_size((PAGE_WIDTH, 0)).columns
    say("\n".join(printed(table, width) for table in tables))


def count_episodes(counts: Iterator[int], already: int, total: int) -> int:
    """Show on standard error how many episodes are done, and return the last count.

    A terminal shows every count, any other output only the last.

    Args:
        counts: yields the number of episodes whenever more are done.
        already: the number at the start.
        total: the number at the end.
    """
    done, start, end = already, perf_counter(), "\r" if sys.stderr.isatty() else "\n"
    for done in counts:
        left = (total - done) * (perf_counter() - start) / max(done - already, 1)
        if end == "\r" or done == total:
            print(f"episodes: {done:,} of {total:,}, {left:.0f} s left", end=end, file=sys.stderr, flush=True)
    return done


@contextmanager
def own_results(options: argparse.Namespace) -> Iterator["ResultsDirectory"]:
    """Reserve the directory ``--out`` for this run while the block runs.

    Raises:
        ValueError: if another command is writing there, or its files cannot be read.
    """
    from ms_highway.experiments.directory import ResultsDirectory

    results = ResultsDirectory(options.out)
    with results.owned():
        yield results


def record(results: "ResultsDirectory", options: argparse.Namespace) -> None:
    """Record the command and versions that make the results; warn if earlier results were made with others."""
    if differing := results.record(options.command_line):
        warn(f"{options.out} continues with {differing}; results may not agree")


def save_figure(figure: "Figure", file: Path) -> None:
    """Write a figure to a file, ``.png``, ``.pdf`` or ``.svg``."""
    from ms_highway.runtime.files import replacing
    from ms_highway.visualization.style import content

    with replacing(file) as path:
        path.write_bytes(content(figure, file.suffix[1:]))
