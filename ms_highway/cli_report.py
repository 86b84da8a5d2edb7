"""The command ``ms-highway report``."""

import argparse
import sys
from pathlib import Path
from typing import Any

from ms_highway.console import add_command, draw_unseen, work
from ms_highway.files import replacing
from ms_highway.markdown import markdown_table
from ms_highway.page import draw, render
from ms_highway.results import Results, read_results
from ms_highway.video import check_format

__all__ = ["add_report"]

HELP = """\
Make one HTML page of a directory that `ms-highway compare` wrote: tables, figures, a video of two controllers side by
side, and the settings, versions, machine and commands that made it. The page is a single file and needs no network.

With --markdown, print the table of results in Markdown instead; several directories get columns beside each other."""

EXAMPLES = """\
examples:
  ms-highway report results/compare
  ms-highway report results/merger --no-videos --out merger.html
  ms-highway report results/compare results/released --markdown"""


def add_report(commands: Any) -> None:
    """Add the command ``report`` to a parser's subparsers."""
    parser = add_command(commands, "report", "make a page of a comparison", HELP, EXAMPLES)
    parser.add_argument(
        "directories", nargs="+", type=Path, metavar="DIR", help="directory of results of `ms-highway compare`"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="an .html file (default: DIR/report.html)")
    parser.add_argument(
        "--videos",
        action=argparse.BooleanOptionalAction,
        default=True,
        help='film the best fixed model beside switching (default); needs the extra "video"',
    )
    parser.add_argument("--markdown", action="store_true", help="print a table in Markdown instead of writing a page")
    parser.set_defaults(run=_report)


def _report(options: argparse.Namespace) -> None:
    if options.markdown:
        if options.out:
            raise ValueError("--out is the file of a page; leave it out with --markdown, which prints")
        several = [read_results(directory) for directory in options.directories]
        for results in several:
            _tell_what_is_missing(results)
        print(markdown_table(several))
        return
    if len(options.directories) > 1:
        raise ValueError("a page shows one directory of results; name one, or add --markdown")
    (directory,) = options.directories
    out = options.out or directory / "report.html"
    if out.suffix != ".html" or out.is_dir():
        raise ValueError(f"--out is {out}; name an .html file")
    results = read_results(directory)
    _tell_what_is_missing(results)
    if options.videos:
        try:
            check_format(Path("film.mp4"))
        except ImportError as error:
            raise ImportError(f"{error}, or add --no-videos") from error
    draw_unseen()
    page = render(results, work(draw(results, options.videos)))
    with replacing(out) as path:
        path.write_text(page, encoding="utf-8")
    print(f"the page is {out}, {len(page) / 1e6:.1f} MB")


def _tell_what_is_missing(results: Results) -> None:
    if results.missing:
        remedy = "start the same `ms-highway compare` again, which goes on"
        print(f"ms-highway: {results.directory} lacks {results.missing} episodes; {remedy}", file=sys.stderr)
