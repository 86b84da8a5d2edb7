"""The command ``ms-highway report``."""

import argparse
import sys
from pathlib import Path
from typing import Any

from ms_highway.cli.console import add_command, say, telling
from ms_highway.cli.options import file_to_write

HELP = """\
Make one HTML page of a directory of `ms-highway compare`. It is a single file and needs no network. At its top stand
the answers in sentences; below, a table, a film of two controllers and figures for each scenario, and the settings,
versions, machine and commands that made the results."""

EXAMPLES = """\
examples:
  ms-highway report results/compare
  ms-highway report results/merger --no-videos --out merger.html"""


def add_report(commands: Any) -> None:
    """Add the command ``report`` to a parser's subparsers."""
    parser = add_command(commands, "report", "make a page of a comparison", HELP, EXAMPLES)
    parser.add_argument("directories", nargs="*", type=Path, metavar="DIR", help="of `ms-highway compare`")
    parser.add_argument("--out", type=file_to_write, metavar="FILE", help="an .html file (default: report.html in DIR)")
    parser.add_argument(
        "--videos",
        action=argparse.BooleanOptionalAction,
        default=True,
        help='film the best fixed model beside one that is chosen online (default); needs the extra "video"',
    )
    parser.set_defaults(run=_report)


def _report(options: argparse.Namespace) -> None:
    from ms_highway.experiments.results import read_results
    from ms_highway.runtime.files import check_writable, replacing
    from ms_highway.visualization.html_page import page
    from ms_highway.visualization.video import check_format

    if len(options.directories) != 1:
        count = len(options.directories)
        raise ValueError(f"a page shows one comparison, not {count}; name one directory, such as results/compare")
    directory = options.directories[0]
    out = options.out or directory / "report.html"
    if out.suffix != ".html":
        raise ValueError(f"--out is {out}; name an .html file")
    check_writable(out)
    results = read_results(directory)
    if results.missing:
        remedy = "start the same `ms-highway compare` again, which resumes"
        print(f"ms-highway: {directory} lacks {results.missing} episodes; {remedy}", file=sys.stderr)
    if options.videos:
        try:
            check_format(Path("film.mp4"))
        except ImportError as error:
            raise ImportError(f"{error}, or add --no-videos") from error
    with telling() as tell:
        text = page(results, options.videos, tell)
    with replacing(out) as path:
        path.write_text(text, encoding="utf-8")
    say(f"the page is {out}, {len(text) / 1e6:.1f} MB")
