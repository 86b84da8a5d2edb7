"""The command ``ms-highway``."""

import argparse
import shlex
import sys
import warnings
from collections.abc import Sequence
from functools import partial
from importlib.metadata import version
from typing import Any

from ms_highway.cli.bench import add_bench
from ms_highway.cli.bench_road import add_bench_road
from ms_highway.cli.compare import add_compare
from ms_highway.cli.console import Command, add_first_words, help_width, printing
from ms_highway.cli.frontier import add_frontier
from ms_highway.cli.irl import add_evaluate, add_fit, add_record
from ms_highway.cli.report import add_report
from ms_highway.cli.sweep import add_sweep
from ms_highway.cli.validate import add_validate
from ms_highway.cli.values import add_values
from ms_highway.cli.video import add_video
from ms_highway.runtime.extras import import_modules
from ms_highway.runtime.interrupt import INTERRUPTED, STOPPED


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 after one line on standard error if the input is at fault."""
    given = sys.argv[1:] if arguments is None else arguments
    try:
        if sys.stdout is None:
            raise OSError("standard output is closed; redirect it, to /dev/null if nobody is to read it")
        for text in given:
            if any("\ud800" <= letter <= "\udfff" for letter in text):  # how Python keeps other bytes
                raise ValueError(f"{text!r} is not UTF-8, the encoding of all results; rename it")
        try:
            options = build_parser().parse_args(given)
            options.command_line = shlex.join(["ms-highway", *given])
            with warnings.catch_warnings():
                warnings.showwarning = _show_in_one_line
                _set_jax_up(options)
                import_modules(options.modules)
                options.run(options)
        finally:  # help, which ends the process, is printed, too
            with printing():
                pass
    except (ValueError, OSError, ImportError) as error:
        print(f"ms-highway: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(STOPPED, file=sys.stderr)
        return INTERRUPTED
    return 0


def _show_in_one_line(message: Warning | str, *_: Any, **__: Any) -> None:
    """Print a warning as this command's message, without the place in its source that it comes from."""
    print(f"ms-highway: {message}", file=sys.stderr)


def _set_jax_up(options: argparse.Namespace) -> None:
    """Set JAX up as the command needs it; if compiled planners cannot be kept, say so and continue."""
    from ms_highway.runtime.jax_settings import check_platforms, high_throughput, keep_compilations, low_latency

    (high_throughput if options.simulates else low_latency)()
    check_platforms()
    if not options.no_compilation_cache:
        try:
            keep_compilations()
        except OSError as error:
            print(f"ms-highway: compiled planners are not kept: {error}", file=sys.stderr)


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands, whose result has the function that runs the command in ``run``."""
    parser = Command(
        prog="ms-highway",
        description="Robot cars that choose how hard to think about human drivers.",
        formatter_class=partial(argparse.HelpFormatter, width=help_width()),
    )
    parser.add_argument(
        "--no-compilation-cache",
        action="store_true",
        help="do not keep compiled planners in the user's cache directory, nor use those kept there",
    )
    parser.add_argument(
        "--import",
        dest="modules",
        action="append",
        default=[],
        metavar="MODULE",
        help="a Python module, also of the current directory, to be imported first: one that adds scenarios "
        "(ms_highway.add_scenario), human models (ms_highway.register), decision rules (ms_highway.add_rule) or "
        "features of rewards (ms_highway.add_feature)",
    )
    parser.add_argument("--version", action="version", version=f"ms-highway {version('ms-highway')}")
    parser.set_defaults(simulates=False)
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND", parser_class=Command)
    parser.names = commands.choices
    driving = add_compare, add_sweep, add_frontier, add_video, add_report, add_bench, add_bench_road, add_validate
    for add in (*driving, add_values, add_record, add_fit, add_evaluate):
        add(commands)
    add_first_words(commands)
    return parser
