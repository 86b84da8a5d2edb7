"""Define commands and their options, print messages and record runs."""

import argparse
import io
import os
import re
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from inspect import getdoc
from pathlib import Path
from shutil import get_terminal_size
from threading import Event, Thread
from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, TextIO

from ms_highway.runtime.files import check_writable

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from ms_highway.experiments.directory import ResultsDirectory


@dataclass(frozen=True)
class HelpLayout:
    """Set the layout of help texts."""

    max_width: int = 120
    """Largest number of characters in a line, in terminals that are wider."""
    second_column: int = 26
    """Characters before the second column of rows, where wrapped lines go on."""

    def width(self) -> int:
        """Return the number of characters in a line, in the present terminal."""
        # argparse leaves the last two columns of a terminal free, too.
        return min(get_terminal_size().columns, self.max_width) - 2


HELP = HelpLayout()

PROGRESS_SECONDS = 60.0
"""Time between two lines about progress where standard error is no terminal [s]."""

MAX_COUNT = 1_000_000
"""Largest number of episodes, parts and other counts.

More would take years or all memory.
"""


class Option(NamedTuple):
    """An option or a positional argument.

    Attributes:
        name: such as ``--seeds`` or ``scenarios``.
        arguments: of `argparse.ArgumentParser.add_argument`.
        notes: a text to print below all options.
    """

    name: str
    arguments: dict
    notes: str = ""


def option(
    name: str,
    text: str,
    default: str | float | Sequence[str | float] | None = None,
    **more: object,
) -> Option:
    """Return an option; append its default, if any, to its help text."""
    if isinstance(default, (str, float, int)):
        text += f" (default: {default})"
    elif default:
        text += f" (default: {' '.join(map(str, default))})"
    return Option(name, {"help": text, "default": default, **more})


def number(
    name: str,
    default: float | Sequence[float] | None,
    text: str,
    least: float = 1,
    most: float = MAX_COUNT,
    **more: object,
) -> Option:
    """Return an option that is a number in a range.

    It is a whole number unless ``least`` is a float.
    """
    kind = type(least)

    def read(word: str) -> float:
        with suppress(ValueError):
            value = kind(word)
            if least <= value <= most:
                return value
        whole = "whole " if kind is int else ""
        raise argparse.ArgumentTypeError(
            f"{word!r} is no {whole}number from {least:,} to {most:,}"
        )

    return option(name, text, default, type=read, **more)


def output(
    name: str,
    text: str,
    *ends: str,
    directory: bool = False,
    default: str | None = None,
    **more: object,
) -> Option:
    """Return an option that is the path of a file or directory to write.

    Args:
        name: of the option.
        text: its help text.
        ends: endings of the file's name, one of which it must have; any without these.
        directory: whether it is the path of a directory.
        default: path if the option is not given.
        more: arguments of `argparse.ArgumentParser.add_argument`.
    """

    def path(word: str) -> Path:
        # This fails for a name that results in UTF-8 cannot contain.
        word.encode()
        check_writable(Path(word), directory)
        if not word.endswith(ends or ""):
            raise argparse.ArgumentTypeError(
                f"{word!r} is no name that ends in {', '.join(ends)}"
            )
        return Path(word)

    metavar = "DIR" if directory else "FILE"
    return option(name, text, default, type=path, metavar=metavar, **more)


class Command(NamedTuple):
    """A command.

    Attributes:
        name: one word or two.
        summary: for the list of commands.
        options: in the order of the help text.
        simulates: whether it computes many episodes at once instead of plans one after
            the other.
        run: takes the parsed options. Its docstring is the help text; the part behind
            ``Examples:`` is printed unchanged, so that users can copy its lines.
    """

    name: str
    summary: str
    options: Sequence[Option]
    simulates: bool
    run: Callable[[argparse.Namespace], None]

    def add_to(self, commands: "argparse._SubParsersAction[Parser]") -> None:
        """Add a parser of the command's options to those of other commands."""
        text, _, examples = (getdoc(self.run) or "").partition("\n\nExamples:\n")
        notes = [wrapped_text(each.notes) for each in self.options if each.notes]
        epilog = "\n\n".join([*notes, f"examples:\n{examples}"])
        parser = commands.add_parser(
            self.name, help=self.summary, description=wrapped_text(text), epilog=epilog
        )
        for each in self.options:
            parser.add_argument(each.name, **each.arguments)
        parser.set_defaults(command=self)


def command(
    name: str,
    summary: str,
    *options: Option,
    simulates: bool = False,
) -> partial[Command]:
    """Make a `Command` of the function that runs it."""
    return partial(Command, name, summary, options, simulates)


class Parser(argparse.ArgumentParser):
    """A parser that accepts no abbreviations and refuses arguments in one line."""

    def __init__(self, **more: Any) -> None:
        # Without abbreviations: --seed must not mean --seeds.
        super().__init__(formatter_class=layout, allow_abbrev=False, **more)

    def error(self, message: str) -> NoReturn:
        """Refuse arguments.

        Raises:
            ValueError: always.
        """
        raise ValueError(
            f"{message}; see the --help of the command, and that of ms-highway"
        )


def layout(prog: str) -> argparse.HelpFormatter:
    """Return argparse's formatter of options, which leaves other texts as they are."""
    return argparse.RawDescriptionHelpFormatter(prog, width=HELP.width())


def wrapped_text(text: str) -> str:
    """Wrap paragraphs and, in rows that begin with two spaces, the second column."""
    blocks = []
    for block in re.split(r"\n(?=\n|  \S)", text.rstrip()):
        wrap = textwrap.TextWrapper(HELP.width(), break_on_hyphens=False)
        if block.startswith("  "):
            wrap.subsequent_indent = " " * HELP.second_column
        blank_line = "\n" if block.startswith("\n") else ""
        words = re.sub(r"\n\s*", " ", block.strip("\n"))
        blocks.append(blank_line + wrap.fill(words))
    return "\n".join(blocks)


def replace_unprintable() -> None:
    """Let standard output print a question mark for what its encoding lacks.

    In ASCII, this is for example ². Python does so for standard error by itself.
    """
    # It may be None, as after ``>&-``, or that of a notebook.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def is_terminal(stream: TextIO | None) -> bool:
    """Return whether a stream is open and a terminal."""
    return stream is not None and stream.isatty()


@contextmanager
def printing() -> Iterator[None]:
    """Flush standard output after a block that only prints.

    If the reader has closed the pipe, as ``| head`` does, drop this and all later
    output.

    Raises:
        OSError: if standard output cannot be written, for example on a full disk.
    """
    try:
        yield
        print(end="", flush=True)
    except OSError as error:
        # Otherwise Python would try again when it exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            raise OSError(
                f"standard output cannot be written: {error.strerror}"
            ) from error


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
    """Print tables.

    In a terminal, they are no wider than it (or COLUMNS); elsewhere, every row is a
    line.
    """
    from ms_highway.visualization.tables import printed

    width = get_terminal_size().columns if is_terminal(sys.stdout) else None
    say("\n".join(printed(table, width) for table in tables))


@contextmanager
def telling_often(progress: Callable[[], str]) -> Iterator[None]:
    """Tell the progress of a block every `PROGRESS_SECONDS`, until the block ends.

    Args:
        progress: returns the message of the moment.
    """
    ended = Event()

    def tell_until_the_end() -> None:
        while not ended.wait(PROGRESS_SECONDS):
            tell(progress())

    thread = Thread(target=tell_until_the_end, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def count_episodes(counts: Iterator[int], already: int, total: int) -> int:
    """Show on standard error how many episodes are done, and return the last count.

    A terminal shows every count. Any other output gets a line a minute, also before the
    first episode has ended, and the last count.

    Args:
        counts: yields the number of episodes whenever more are done.
        already: the number at the start.
        total: the number at the end.
    """
    done = already
    start = perf_counter()

    def progress() -> str:
        """Say how many episodes are done and, after a new one, how long others take."""
        message = f"episodes: {done:,} of {total:,}"
        new = done - already
        if not new:
            return message
        left = (total - done) * (perf_counter() - start) / new
        return f"{message}, {left:.0f} s left"

    if is_terminal(sys.stderr):
        for count in counts:
            done = count
            print(progress(), end="\r", file=sys.stderr, flush=True)
        return done
    with telling_often(progress):
        for count in counts:
            done = count
    if done > already:
        tell(progress())
    return done


def record_run(
    results: "ResultsDirectory",
    options: argparse.Namespace,
    computes: bool = True,
) -> None:
    """Record the command and the versions that make results.

    Warn if earlier results were made with other versions.

    Args:
        results: directory of the results.
        options: of the command.
        computes: whether the command computes results; else it only warns.
    """
    from ms_highway.experiments.directory import this_run

    if computes:
        differing = results.record(options.command_line)
        warning = f"{options.out} continues with {differing}; results may not agree"
    else:
        differing = results.differing(this_run())
        warning = (
            f"{options.out} was computed by other software ({differing} now); nothing"
            " is computed again"
        )
    if differing:
        warn(warning)


def save_figures(
    figures: Mapping[str, "Callable[[], Figure]"],
    directory: Path,
    kind: str,
) -> None:
    """Draw figures into files of a directory, ``NAME.png``, ``.pdf`` or ``.svg``.

    Results are to be on disk before. A figure that cannot be drawn or written is a
    warning.
    """
    from ms_highway.runtime.files import replacing
    from ms_highway.visualization.style import drawn

    for name, content in drawn(figures, kind).items():
        try:
            with replacing(directory / f"{name}.{kind}") as path:
                path.write_bytes(content)
        except OSError as error:
            warn(error)
