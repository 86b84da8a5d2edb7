"""What the commands print, and how they keep their results."""

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
    """Write what the block prints to standard output at once; the block should do nothing else.

    Once the reader has closed the pipe, as ``| head`` does, drop this and all later output.

    Raises:
        OSError: if standard output is on a full disk.
    """
    try:
        yield
        print(end="", flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or else Python would try again at its end
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
    """Print tables, no wider than the terminal or COLUMNS, and where there is neither, than a page."""
    from ms_highway.visualization.tables import printed

    width = get_terminal_size((PAGE_WIDTH, 0)).columns
    say("\n".join(printed(table, width) for table in tables))


def count_episodes(counts: Iterator[int], already: int, total: int) -> int:
    """Show on standard error how many episodes are done, in a terminal as they are; return the last count.

    Args:
        counts: the number of episodes, each time that more are done.
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
    """Let only this run write to the directory ``--out`` while the block runs.

    Raises:
        ValueError: if another command is writing there, or what is there cannot be read.
    """
    from ms_highway.experiments.directory import ResultsDirectory

    results = ResultsDirectory(options.out)
    with results.owned():
        yield results


def record(results: "ResultsDirectory", options: argparse.Namespace) -> None:
    """Keep what makes the results on record, and warn of what differs from what made those before."""
    if differing := results.record(options.command_line):
        warn(f"{options.out} continues with {differing}; results may not agree")


def save_figure(figure: "Figure", file: Path) -> None:
    """Write a figure to a file, ``.png``, ``.pdf`` or ``.svg``."""
    from ms_highway.runtime.files import replacing
    from ms_highway.visualization.style import content

    with replacing(file) as path:
        path.write_bytes(content(figure, file.suffix[1:]))
