"""Describe commands and their options, each in one place, and parse them."""

import argparse
import re
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from inspect import cleandoc
from pathlib import Path
from shutil import get_terminal_size
from typing import Any, NamedTuple, NoReturn

from ms_highway.runtime.files import check_writable

PAGE_WIDTH, NARROWEST = 120, 40  # characters of help texts
COLUMN = 26  # characters before the second column of rows in help texts

MOST = 1_000_000
"""Upper bound on episodes, parts and other counts; more would take years or all memory."""


class Option(NamedTuple):
    """An option, or an argument without a name.

    Attributes:
        name: as it is written.
        arguments: of `argparse.ArgumentParser.add_argument`.
        notes: printed below all options.
    """

    name: str
    arguments: dict[str, Any]
    notes: str = ""


def option(name: str, text: str, default: Any = None, notes: str = "", **more: Any) -> Option:
    """Return an option; append its default, if any, to its help text."""
    if default not in (None, []):
        shown = " ".join(map(str, default)) if isinstance(default, (list, tuple)) else default
        text += f" (default: {shown})"
    return Option(name, {"help": text, "default": default, **more}, notes)


def number(name: str, default: Any, text: str, least: float = 1, most: float = MOST, **more: Any) -> Option:
    """Return an option that is a number in a range: whole, unless the least is a float."""
    kind = type(least)

    def read(word: str) -> float:
        try:
            value = kind(word)
        except ValueError:
            value = float("nan")
        if not least <= value <= most:
            whole = "whole " if kind is int else ""
            raise argparse.ArgumentTypeError(f"{word!r} is no {whole}number from {least:,} to {most:,}")
        return value

    return option(name, text, default, type=read, **more)


def output(name: str, text: str, default: str | None = None, directory: bool = False, **more: Any) -> Option:
    """Return an option that is the path of a file, or of a directory of files, and is refused if it is not writable."""

    def path(word: str) -> Path:
        check_writable(Path(word), directory)
        return Path(word)

    return option(name, text, default, type=path, metavar="DIR" if directory else "FILE", **more)


@dataclass(frozen=True)
class Command:
    """A command.

    Attributes:
        name: one word or two; or none, for what stands before all commands.
        text: of its help; what follows ``Examples:`` is printed as it stands.
        options: in the order of the help text.
        run: takes the parsed options.
        summary: for the list of commands.
        simulates: whether it computes many episodes at once, rather than plans one after the other.
    """

    name: str
    text: str
    options: Sequence[Option]
    run: Callable[[argparse.Namespace], None] | None = None
    summary: str = ""
    simulates: bool = False

    def parser(self) -> "Parser":
        """Return the parser of the command's options."""
        text, _, examples = self.text.partition("\n\nExamples:\n")
        notes = [filled(each.notes) for each in self.options if each.notes]
        parser = Parser(
            prog=f"ms-highway {self.name}".strip(),
            formatter_class=partial(argparse.RawDescriptionHelpFormatter, width=help_width()),
            allow_abbrev=False,  # --seed is not short for --seeds
            description=filled(text),
            epilog="\n\n".join([*notes, *([f"examples:\n{examples}"] if examples else [])]),
        )
        for each in self.options:
            parser.add_argument(each.name, **each.arguments)
        return parser


def command(
    name: str, summary: str, *options: Option, simulates: bool = False
) -> Callable[[Callable[[argparse.Namespace], None]], Command]:
    """Make a `Command` of the function that runs it, whose docstring is the help text."""
    return lambda run: Command(name, cleandoc(run.__doc__ or ""), options, run, summary, simulates)


class Parser(argparse.ArgumentParser):
    """A parser that refuses wrong arguments in one line."""

    def error(self, message: str) -> NoReturn:
        """Refuse arguments.

        Raises:
            ValueError: always.
        """
        misplaced = message.startswith("unrecognized") and "--import" in message
        raise ValueError(
            f"{message}; {'--import MODULE goes before the command' if misplaced else f'see {self.prog} --help'}"
        )


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
    return max(min(get_terminal_size().columns, PAGE_WIDTH) - 2, NARROWEST)
