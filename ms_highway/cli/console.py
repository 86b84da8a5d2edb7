"""What the commands print, and how they show that they are at work."""

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from shutil import get_terminal_size
from typing import TYPE_CHECKING, Any

from ms_highway.cli.command import PAGE_WIDTH

if TYPE_CHECKING:
    from pandas import DataFrame
    from rich.progress import Progress


@contextmanager
def printing() -> Iterator[None]:
    """Write what the block prints to standard output at once; the block should do nothing else.

    Once the reader has closed the pipe, as ``| head`` does, drop this and all later output.

    Raises:
        OSError: if standard output is on a full disk.
    """
    try:
        yield
        sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or else Python would try again at its end
        if not isinstance(error, BrokenPipeError):
            raise OSError(f"standard output cannot be written: {error.strerror}") from error


def say(text: str) -> None:
    """Print a text to standard output."""
    with printing():
        print(text)


def warn(message: object) -> None:
    """Print one line to standard error."""
    print(f"ms-highway: {message}", file=sys.stderr)


def print_tables(*tables: "DataFrame") -> None:
    """Print tables, no wider than the terminal or COLUMNS, and where there is neither, than a page."""
    from ms_highway.visualization.tables import printed

    width = get_terminal_size((PAGE_WIDTH, 0)).columns
    say("\n".join(printed(table, width) for table in tables))


def count_episodes(counts: Iterable[int], already: int, total: int) -> int:
    """Show a progress bar on standard error while episodes are counted; return the last count.

    Args:
        counts: the number of episodes, each time that one more is done.
        already: the number at the start.
        total: the number at the end.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, TimeRemainingColumn

    done = already
    with _progress(BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()) as bar:
        task = bar.add_task("episodes", total=total, completed=already)
        for done in counts:
            bar.update(task, completed=done)
    return done


@contextmanager
def telling() -> Iterator[Callable[[str], None]]:
    """Show progress messages on standard error, line by line where it is no terminal; yields what sets the message."""
    with _progress(transient=True) as bar:
        task = bar.add_task("reading", total=None)

        def tell(message: str) -> None:
            bar.update(task, description=message)
            if not bar.console.is_terminal:
                print(message, file=sys.stderr, flush=True)

        yield tell


def _progress(*columns: Any, transient: bool = False) -> "Progress":
    """Return a line on standard error of a text, these columns and the time that has passed."""
    from rich.console import Console
    from rich.progress import Progress, TextColumn, TimeElapsedColumn

    text = TextColumn("{task.description}")
    return Progress(text, *columns, TimeElapsedColumn(), console=Console(stderr=True), transient=transient)
