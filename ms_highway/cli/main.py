"""The command ``ms-highway``."""

import argparse
import shlex
import sys
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from itertools import pairwise
from typing import Any

from ms_highway.cli.bench import bench
from ms_highway.cli.bench_road import bench_road
from ms_highway.cli.command import COLUMN, Command, option
from ms_highway.cli.compare import compare
from ms_highway.cli.console import printing, warn
from ms_highway.cli.frontier import frontier
from ms_highway.cli.irl import evaluate, fit, record
from ms_highway.cli.report import report
from ms_highway.cli.sweep import sweep
from ms_highway.cli.validate import validate
from ms_highway.cli.values import learn
from ms_highway.cli.video import video
from ms_highway.runtime.extras import import_modules
from ms_highway.runtime.interrupt import INTERRUPTED, STOPPED
from ms_highway.runtime.retired import OPTIONS, replacement

DRIVING = compare, sweep, frontier, video, report, bench, bench_road, validate
COMMANDS = {each.name: each for each in (*DRIVING, learn, record, fit, evaluate)}

CACHE = "do not keep compiled planners in the user's cache directory, nor use those kept there"
IMPORT = (
    "a Python module, also of the current directory, to be imported first: one that adds scenarios "
    "(ms_highway.add_scenario), human models (ms_highway.register), decision rules (ms_highway.add_rule) or features "
    "of rewards (ms_highway.add_feature)"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 after one line on standard error if the input is at fault."""
    given = sys.argv[1:] if arguments is None else arguments
    try:
        if sys.stdout is None:
            raise OSError("standard output is closed; redirect it, to /dev/null if nobody is to read it")
        for word in given:
            if any("\ud800" <= letter <= "\udfff" for letter in word):  # how Python keeps other bytes
                raise ValueError(f"{word!r} is not UTF-8, the encoding of all results; rename it")
        try:
            options = parse(given)
        except SystemExit:  # after help texts
            with printing():
                pass
            raise
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: warn(message)  # without its place in the source
            _set_jax_up(options)
            import_modules(options.modules)
            options.command.run(options)
    except (ValueError, OSError, ImportError) as error:
        warn(error)
        return 2
    except KeyboardInterrupt:
        print(STOPPED, file=sys.stderr)
        return INTERRUPTED
    return 0


def parse(given: Sequence[str]) -> Any:
    """Return the options of a command line, with its text in ``command_line``, and the command in ``command``.

    Raises:
        ValueError: saying what cannot be parsed, and what to use instead of what is retired.
        SystemExit: after help texts.
    """
    options = _before().parser().parse_args(given)
    first = options.words[0]
    name = next((name for name in (" ".join(options.words[:2]), first) if name in COMMANDS), "")
    if not name:
        longer = [each for each in COMMANDS if each.startswith(f"{first} ")]
        raise ValueError(f"{first} is no command; name one of {', '.join(longer or COMMANDS)}")
    options.command, options.command_line = COMMANDS[name], shlex.join(["ms-highway", *given])
    rest = options.words[len(name.split()) :]
    try:
        return options.command.parser().parse_args(rest, options)
    except ValueError:
        words = " ".join(rest).replace("=", " ").split()
        given = [*words, *map(" ".join, pairwise(words))]
        if gone := replacement(OPTIONS, *(f"{name} {each}" for each in given)):
            raise ValueError(gone) from None
        raise


def _before() -> Command:
    """Describe what stands before a command; the command and its own options are in ``words``."""
    return Command(
        "",
        "Robot cars that choose how hard to think about human drivers.",
        (
            option("--no-compilation-cache", CACHE, action="store_true"),
            option("--import", IMPORT, [], dest="modules", action="append", metavar="MODULE"),
            option("--version", "show the version", action="version", version=f"ms-highway {version('ms-highway')}"),
            option("words", "with its options", notes=_commands(), nargs=argparse.PARSER, metavar="COMMAND"),
        ),
    )


def _commands() -> str:
    rows = [f"  {name:{COLUMN - 2}}{command.summary}" for name, command in COMMANDS.items()]
    return "\n".join(["commands:", *rows])


def _set_jax_up(options: Any) -> None:
    """Set JAX up as the command needs it; if compiled planners cannot be kept, say so and continue."""
    from ms_highway.runtime.jax_settings import check_platforms, high_throughput, keep_compilations, low_latency

    (high_throughput if options.command.simulates else low_latency)()
    check_platforms()
    if not options.no_compilation_cache:
        try:
            keep_compilations()
        except OSError as error:
            warn(f"compiled planners are not kept: {error}")
