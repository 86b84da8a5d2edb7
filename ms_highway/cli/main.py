"""The command ``ms-highway``."""

import shlex
import sys
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from itertools import pairwise
from typing import Any

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
from ms_highway.runtime.process import INTERRUPTED, STOPPED
from ms_highway.runtime.sources import import_modules

ALL = (
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
COMMANDS = {each.name: each for each in ALL}

ABOUT = "Robot cars that choose how hard to think about human drivers."
CACHE = (
    "neither keep compiled planners in the user's cache directory nor use those kept"
    " there"
)
IMPORT = (
    "a Python module, also of the current directory, to import first; it may add"
    " scenarios (ms_highway.add_scenario), human models (ms_highway.register), drivers"
    " and planners (ms_highway.add_driver), agents (ms_highway.add_agent), decision"
    " rules (ms_highway.add_rule) or features of rewards (ms_highway.add_feature)"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status: 0, 2 after one line about wrong
    input, or that of an interrupt.
    """
    given = sys.argv[1:] if arguments is None else arguments
    replace_unprintable()
    try:
        try:
            options = parse(given)
        except SystemExit:  # after help texts
            with printing():
                pass
            raise
        from ms_highway.runtime.jax_settings import (
            check_platforms,
            high_throughput,
            keep_compilations,
            low_latency,
        )

        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: warn(
                message
            )  # without file and line
            (high_throughput if options.command.simulates else low_latency)()
            check_platforms()
            if not options.no_compilation_cache:
                try:
                    keep_compilations()
                except OSError as error:
                    warn(f"compiled planners are not kept: {error}")
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
    """Return the options of a command line, its command in ``command`` and the whole
    line in ``command_line``.

    Raises:
        ValueError: for what cannot be parsed.
        SystemExit: after help texts.
    """
    parser = Parser(prog="ms-highway", description=wrapped_text(ABOUT))
    parser.add_argument("--no-compilation-cache", help=CACHE, action="store_true")
    parser.add_argument(
        "--import",
        help=IMPORT,
        default=[],
        dest="modules",
        action="append",
        metavar="MODULE",
    )
    parser.add_argument(
        "--version", action="version", version=f"ms-highway {version('ms-highway')}"
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for each in COMMANDS.values():
        each.add_to(commands)
    words = list(given)
    for place, pair in enumerate(map(" ".join, pairwise(given))):
        if pair in COMMANDS:
            words[place : place + 2] = [pair]
    options = parser.parse_args(words)
    options.command_line = shlex.join(["ms-highway", *given])
    return options
