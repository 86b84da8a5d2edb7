"""What the commands share: how they are declared, what they print, and how they show that they are at work."""

import argparse
import os
import re
import sys
import textwrap
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from shutil import get_terminal_size
from typing import TYPE_CHECKING, Any, NoReturn

from ms_highway.runtime.retired import OPTIONS, replacement

if TYPE_CHECKING:
    from rich.progress import Progress
    from rich.table import Table

TABLE_WIDTH = 120  # characters
NARROWEST = 40  # characters of help texts
COLUMN = 26  # characters before the second column of rows in help texts


class Command(argparse.ArgumentParser):
    """Parse arguments, of which one word or two name a command.

    Attributes:
        names: of all commands, where this parser is that of several.
        words: of the arguments.
        summary: of the command, in a list of commands.
    """

    names: Collection[str] = ()
    words: Sequence[str] = ()
    summary: str = ""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse arguments; two words that name a command become one."""
        self.words = words = list(args)
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
        command = next((word for word in self.words if word in self.names), self.prog.removeprefix("ms-highway "))
        words = " ".join(self.words).replace("=", " ").split()
        given = [*words, *map(" ".join, pairwise(words))]
        if gone := replacement(OPTIONS, *(f"{command} {each}" for each in given)):
            raise ValueError(gone)
        misplaced = message.startswith("unrecognized") and "--import" in message
        remedy = "--import MODULE goes before the command" if misplaced else f"see {self.prog} --help"
        raise ValueError(f"{message}; {remedy}")


def add_command(commands: Any, name: str, summary: str, description: str, examples: str = "") -> Command:
    """Add a command to subparsers, which list it if it has a summary; its examples are printed as they are."""
    parser = commands.add_parser(
        name,
        formatter_class=partial(argparse.RawDescriptionHelpFormatter, width=help_width()),
        allow_abbrev=False,  # --seed is not short for --seeds
        description=filled(description),
        epilog=examples,
        **({"help": summary} if summary else {}),
    )
    parser.summary = summary
    return parser


def add_first_words(commands: Any) -> None:
    """Add a help page for each first word of two-word commands, such as ``irl``; it lists these commands."""
    for word in dict.fromkeys(name.split()[0] for name in commands.choices if name.split()[0] not in commands.choices):
        names = {name: parser.summary for name, parser in commands.choices.items() if name.startswith(f"{word} ")}
        rows = "\n".join(f"  {name:{COLUMN - 2}}{summary}" for name, summary in names.items())
        parser = add_command(commands, word, "", f"commands:\n{rows}")
        parser.usage = f"ms-highway {word} COMMAND ..."
        message = f"{word} is no command; name one of {', '.join(names)}"
        parser.add_argument("words", nargs="*", action=_Refuse, const=message, help=argparse.SUPPRESS)


class _Refuse(argparse.Action):
    """Refuse any arguments during parsing, before anything is loaded."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        parser.error(str(self.const))


def filled(text: str) -> str:
    """Return a text of help with its paragraphs, and its rows of two columns, wrapped to `help_width`."""
    rows = re.split(r"\n(?=\n|  \S)", text)
    return "\n".join(
        textwrap.fill(
            re.sub(r"\n\s*", " ", row.strip("\n")),
            help_width(),
            initial_indent="\n" * row.startswith("\n"),
            subsequent_indent=" " * COLUMN * row.startswith("  "),
            break_on_hyphens=False,
        )
        for row in rows
    )


def help_width() -> int:
    """Return the width of help texts [characters]: that of the terminal, but no more than that of a page."""
    return max(min(get_terminal_size().columns, TABLE_WIDTH) - 2, NARROWEST)


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


def print_tables(*tables: "Table") -> None:
    """Print to standard output, no wider than the terminal or COLUMNS, and where there is neither, than a page."""
    from rich.console import Console

    from ms_highway.visualization.tables import fitting

    known = sys.stdout.isatty() or "COLUMNS" in os.environ
    console = Console(width=None if known else TABLE_WIDTH)
    with console.capture() as printed:  # or else rich would end the process where nobody reads
        for table in tables:
            for part in fitting(table, console):
                console.print(part)
    say(printed.get().removesuffix("\n"))


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
