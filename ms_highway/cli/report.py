"""The command ``ms-highway report``."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ms_highway.cli.console import add_command, draw_unseen, telling

if TYPE_CHECKING:
    from ms_highway.experiments.results import Results
    from ms_highway.runtime.progress import Progress
    from ms_highway.visualization.html_page import Drawn

HELP = """\
Make one HTML page of a directory that `ms-highway compare` wrote: a table, sentences on what was found,
figures, a video of two controllers side by side, and the settings, versions, machine and commands that made it. Of
further such directories, the page has the outcomes beside those of the first. It is a single file and needs no network.

With --values, a section shows what a file of learned values holds, and what the values see: what each model is worth
along an episode that they choose for at a price of 1, and by where the human starts; in the scenarios of the page, or
in those that they were learned in. With --drivers, a section shows how well drivers that were learned from recordings
predict: errors, likelihood and calibration by horizon, and paths. DIR may then be left out.

With --markdown, print the table of the directories in Markdown instead."""

EXAMPLES = """\
examples:
  ms-highway report results/compare
  ms-highway report results/compare results/released --out page.html
  ms-highway report results/merger --no-videos --out merger.html
  ms-highway report results/compare results/released --markdown
  ms-highway report --values shipped --out values.html
  ms-highway report --drivers evaluation.json us101 recordings --out drivers.html"""


def add_report(commands: Any) -> None:
    """Add the command ``report`` to a parser's subparsers."""
    parser = add_command(commands, "report", "make a page of results", HELP, EXAMPLES)
    parser.add_argument("directories", nargs="*", type=Path, metavar="DIR", help="results of `ms-highway compare`")
    parser.add_argument("--values", metavar="FILE", help="of `ms-highway values learn`, or: shipped")
    parser.add_argument(
        "--drivers",
        nargs=3,
        metavar=("EVALUATION", "THETA", "DATA"),
        help="what `ms-highway irl evaluate --json` printed, the reward that `irl fit` wrote (or: us101), and the "
        "recordings, of which a few paths are drawn",
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
    from ms_highway.experiments.results import read_results
    from ms_highway.runtime.files import replacing
    from ms_highway.visualization.html_page import page
    from ms_highway.visualization.overview import overview
    from ms_highway.visualization.tables import markdown
    from ms_highway.visualization.video import check_format

    directories = options.directories
    if not (options.out or directories):
        raise ValueError("there is neither DIR nor --out; name a directory of results, or a page to write")
    out = options.out or directories[0] / "report.html"
    if options.markdown and (options.out or options.values or options.drivers):
        raise ValueError("--markdown prints the table of the directories; leave the other options out")
    if out.suffix != ".html" or out.is_dir():
        raise ValueError(f"--out is {out}; name an .html file")
    several = list(map(read_results, directories))
    for results in several:
        if results.missing:
            remedy = "start the same `ms-highway compare` again, which resumes"
            print(f"ms-highway: {results.directory} lacks {results.missing} episodes; {remedy}", file=sys.stderr)
    if options.markdown:
        print(markdown(overview(several)))
        return
    if several and options.videos:
        try:
            check_format(Path("film.mp4"))
        except ImportError as error:
            raise ImportError(f"{error}, or add --no-videos") from error
    draw_unseen()
    with telling() as tell:
        text = page(several, _further(options, several, tell), options.videos, tell)
    with replacing(out) as path:
        path.write_text(text, encoding="utf-8")
    print(f"the page is {out}, {len(text) / 1e6:.1f} MB")


def _further(options: argparse.Namespace, several: "list[Results]", progress: "Progress") -> "dict[str, Drawn]":
    """Return the sections of learned values and of learned drivers that are asked for."""
    from ms_highway.visualization.irl.tables import drawn as drawn_drivers
    from ms_highway.visualization.values import drawn as drawn_values

    further: dict[str, Drawn] = {}
    if options.values:
        scenarios = dict.fromkeys(scenario for results in several for scenario in results.scenarios)
        further["Values of computation"] = drawn_values(options.values, list(scenarios), progress)
    if options.drivers:
        evaluation, theta, data = options.drivers
        further["Drivers learned from recordings"] = drawn_drivers(Path(evaluation), theta, data, progress)
    return further
