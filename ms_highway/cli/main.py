"""The command ``ms-highway``."""

import argparse
import shlex
import sys
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from itertools import pairwise

from ms_highway.cli.bench import bench, bench_road
from ms_highway.cli.console import (
    Parser,
    printing,
    replace_unprintable,
    warn,
    wrapped_text,
)
from ms_highway.cli.irl import evaluate, fit, record
from ms_highway.cli.runs import compare, sweep
from ms_highway.cli.show import frontier, learn, report, validate, video
from ms_highway.runtime.process import INTERRUPTED, last_line
from ms_highway.runtime.sources import import_modules

COMMANDS = {
    each.name: each
    for each in (
        compare,
        sweep,
        frontier,
        video,
        report,
        bench,
        bench_road,
        validate,
        learn,
        record,
        fit,
        evaluate,
    )
}
"""All commands by name, in the order of the help text."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status.

    The status is 0, 2 after one line about wrong input, or that of an interrupt.
    """
    given = sys.argv[1:] if arguments is None else arguments
    replace_unprintable()
    try:
        try:
            options = parse(given)
        except SystemExit:
            # A help text was printed: let a closed pipe or a full disk show here.
            with printing():
                pass
            raise
        _run(options)
    except (ValueError, OSError, ImportError) as error:
        warn(error)
        return 2
    except KeyboardInterrupt:
        print(last_line(), file=sys.stderr)
        return INTERRUPTED
    return 0


def _run(options: argparse.Namespace) -> None:
    """Set up JAX for a command, import the user's modules, and run the command."""
    # Help texts, which do not come here, need no JAX.
    from ms_highway.runtime.jax_settings import (
        check_platforms,
        high_throughput,
        keep_compilations,
        low_latency,
    )

    with warnings.catch_warnings():
        # Without file and line.
        warnings.showwarning = lambda message, *_, **__: warn(message)
        if options.command.simulates:
            high_throughput()
        else:
            low_latency()
        check_platforms()
        if not options.no_compilation_cache:
            try:
                keep_compilations()
            except OSError as error:
                warn(f"compiled planners are not kept: {error}")
        import_modules(options.modules)
        options.command.run(options)


def parse(given: Sequence[str]) -> argparse.Namespace:
    """Parse a command line.

    Returns:
        The options, the ``Command`` in ``command`` and the whole line in
            ``command_line``.

    Raises:
        ValueError: for what cannot be parsed.
        SystemExit: after help texts.
    """
    about = "Robot cars that choose how hard to think about human drivers."
    parser = Parser(prog="ms-highway", description=wrapped_text(about))
    parser.add_argument(
        "--no-compilation-cache",
        action="store_true",
        help="neither keep compiled planners in the user's cache directory nor use"
        " those kept there",
    )
    parser.add_argument(
        "--import",
        default=[],
        dest="modules",
        action="append",
        metavar="MODULE",
        help="a Python module, also of the current directory, to import first; it may"
        " add scenarios (ms_highway.add_scenario), human models (ms_highway.register),"
        " drivers and planners (ms_highway.add_driver), agents (ms_highway.add_agent),"
        " decision rules (ms_highway.add_rule) or features of rewards"
        " (ms_highway.add_feature)",
    )
    parser.add_argument(
        "--version", action="version", version=f"ms-highway {version('ms-highway')}"
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for each in COMMANDS.values():
        each.add_to(commands)

    # argparse knows a command of two words, such as "bench road", as a single word.
    words = list(given)
    for place, pair in enumerate(map(" ".join, pairwise(given))):
        if pair in COMMANDS:
            words[place : place + 2] = [pair]

    options = parser.parse_args(words)
    options.command_line = shlex.join(["ms-highway", *given])
    return options
