"""What the commands share: how they are declared, what they print, and how they show that they are at work."""

import argparse
import os
import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from rich.progress import Progress
    from rich.table import Table

TABLE_WIDTH = 120  # characters


class Command(argparse.ArgumentParser):
    """Parse arguments, of which one word or two name a command.

    Attributes:
        names: of all commands, where this parser is that of several.
    """

    names: Collection[str] = ()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse arguments; two words that name a command become one."""
        words = list(args)
        for place, pair in enumerate(pairwise(words)):
            if " ".join(pair) in self.names:
                words[place : place + 2] = [" ".join(pair)]
                break
        return super().parse_known_args(words, namespace)

    def error(self, message: str) -> NoReturn:
        """Refuse arguments in one line.

        Raises:
            ValueError: always.
        """
        raise ValueError(f"{message}; see {self.prog} --help")


def add_command(commands: Any, name: str, summary: str, description: str, epilog: str = "") -> Command:
    """Add a command to a parser's subparsers; its description and epilog are printed as they are."""
    return commands.add_parser(
        name,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,  # --seed is not short for --seeds
        help=summary,
        description=description,
        epilog=epilog,
    )


def draw_unseen() -> None:
    """Use SDL's dummy display, unless the environment names a driver."""
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")


@contextmanager
def printing() -> Iterator[None]:
    """Write what the block prints to standard output at once; the block should do nothing else.

    Raises:
        OSError: if standard output is on a full disk, or nobody reads it any more.
    """
    try:
        yield
        sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or else Python would try again at its end
        raise OSError(f"standard output cannot be written: {error.strerror}") from error


def print_tables(*tables: "Table") -> None:
    """Print to standard output, wide enough also where it is no terminal."""
    from rich.console import Console

    console = Console(width=max(Console().width, TABLE_WIDTH))
    with console.capture() as printed:  # or else rich would end the process where nobody reads
        for table in tables:
            console.print(table)
    with printing():
        sys.stdout.write(printed.get())


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
        task = bar.add_task("episodes", total=max(total, already), completed=already)
        for done in counts:
            bar.update(task, completed=done)
    return done


@contextmanager
def telling() -> Iterator[Callable[[str], None]]:
    """Show progress messages on standard error; yields the function that sets the message."""
    with _progress(transient=True) as bar:
        task = bar.add_task("reading", total=None)
        yield lambda message: bar.update(task, description=message)


def _progress(*columns: Any, transient: bool = False) -> "Progress":
    """Return a line on standard error of a text, these columns and the time that has passed."""
    from rich.console import Console
    from rich.progress import Progress, TextColumn, TimeElapsedColumn

    text = TextColumn("{task.description}")
    return Progress(text, *columns, TimeElapsedColumn(), console=Console(stderr=True), transient=transient)
