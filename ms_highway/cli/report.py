"""The command ``ms-highway report``."""

import argparse
import sys
from pathlib import Path
from typing import Any

from ms_highway.cli.console import add_command, draw_unseen, telling

__all__ = ["add_report"]

HELP = """\
Make one HTML page of a directory that `ms-highway compare` wrote: a table, sentences on what was found,
figures, a video of two controllers side by side, and the settings, versions, machine and commands that made it. Of
further such directories, the page has the outcomes beside those of the first, and of a directory that `ms-highway
safety` wrote, its collisions. It is a single file and needs no network.

With --markdown, print the tables in Markdown instead."""

EXAMPLES = """\
examples:
  ms-highway report results/compare
  ms-highway report results/compare results/released results/safety --out page.html
  ms-highway report results/merger --no-videos --out merger.html
  ms-highway report results/compare results/released --markdown"""


def add_report(commands: Any) -> None:
    """Add the command ``report`` to a parser's subparsers."""
    parser = add_command(commands, "report", "make a page of a comparison", HELP, EXAMPLES)
    parser.add_argument(
        "directories",
        nargs="+",
        type=Path,
        metavar="DIR",
        help="directories of results of `ms-highway compare`, and of `safety`",
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="an .html file (default: report.html in the first DIR)"
    )
    parser.add_argument(
        "--videos",
        action=argparse.BooleanOptionalAction,
        default=True,
        help='film the best fixed model beside one that is chosen online (default); needs the extra "video"',
    )
    parser.add_argument("--markdown", action="store_true", help="print a table in Markdown instead of writing a page")
    parser.set_defaults(run=_report)


def _report(options: argparse.Namespace) -> None:
    from ms_highway.experiments.analysis.selection import select_of_several
    from ms_highway.experiments.results import read_results
    from ms_highway.experiments.safety import SAFETY_FILE, read_safety, safety_cells
    from ms_highway.runtime.files import replacing
    from ms_highway.visualization.html_page import draw, render
    from ms_highway.visualization.overview import markdown, overview
    from ms_highway.visualization.video import check_format

    out = options.out or options.directories[0] / "report.html"
    if options.markdown and options.out:
        raise ValueError("--out is the file of a page; leave it out with --markdown, which prints")
    if out.suffix != ".html" or out.is_dir():
        raise ValueError(f"--out is {out}; name an .html file")
    counted = [directory for directory in options.directories if (directory / SAFETY_FILE).is_file()]
    several = [read_results(directory) for directory in options.directories if directory not in counted]
    safeties = [read_safety(directory) for directory in counted]
    for results in several:
        if results.missing:
            remedy = "start the same `ms-highway compare` again, which resumes"
            print(f"ms-highway: {results.directory} lacks {results.missing} episodes; {remedy}", file=sys.stderr)
    if options.markdown:
        tables = [overview(several)] if several else []
        print("\n\n".join(markdown(table) for table in [*tables, *map(safety_cells, safeties)]))
        return
    if not several:
        raise ValueError(f"{counted[0]} holds no comparison; name a directory that `ms-highway compare` wrote as well")
    if options.videos:
        try:
            check_format(Path("film.mp4"))
        except ImportError as error:
            raise ImportError(f"{error}, or add --no-videos") from error
    draw_unseen()
    with telling() as tell:
        page = render(several, draw(several, select_of_several(several), options.videos, tell), safeties)
    with replacing(out) as path:
        path.write_text(page, encoding="utf-8")
    print(f"the page is {out}, {len(page) / 1e6:.1f} MB")
