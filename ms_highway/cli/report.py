"""The command ``ms-highway report``."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ms_highway.cli.console import add_command, draw_unseen, telling

if TYPE_CHECKING:
    from ms_highway.experiments.results import Results
    from ms_highway.runtime.progress import Progress
    from ms_highway.visualization.section import Section

HELP = """\
Make one HTML page of results of several kinds. It is a single file and needs no network. At its top stands what was
asked, and the answers in sentences; below, tables, figures, films, and of directories the settings, versions, machine
and commands that made them. RESULTS are, one or several:

  a directory of `ms-highway compare`: a section for each scenario, with a film of two controllers side by side; of
                                       further ones, outcomes beside those of the first
  a directory of `ms-highway frontier`: how much better the choice of models could be
  a file of `ms-highway irl evaluate --json`: how well drivers are predicted
  a film, .gif, as `ms-highway video` and `ms-highway bench road --films` make them

With --values, a section shows what a file of learned values holds, and what the values see: what each model is worth
along an episode that they choose for at a price of 1, and by where the human starts; in the scenarios of the page, or
in those that they were learned in. With --drivers, a section shows how well drivers that were learned from recordings
predict: errors, likelihood and calibration by horizon, and paths.

With --markdown, print the table of directories of `ms-highway compare` in Markdown instead."""

ONLY_COMPARISONS = "--markdown prints the table of directories of `ms-highway compare`"
KINDS = "name directories of `ms-highway compare` and `frontier`, files of `irl evaluate --json`, and films, .gif"

EXAMPLES = """\
examples:
  ms-highway report results/compare
  ms-highway report results/compare results/released --out page.html
  ms-highway report results/compare results/frontier films/merge-v0.gif --out page.html
  ms-highway report results/merger --no-videos --out merger.html
  ms-highway report results/compare results/released --markdown
  ms-highway report --values shipped --out values.html
  ms-highway report --drivers evaluation.json us101 recordings --out drivers.html"""


def add_report(commands: Any) -> None:
    """Add the command ``report`` to a parser's subparsers."""
    parser = add_command(commands, "report", "make a page of results", HELP, EXAMPLES)
    parser.add_argument("results", nargs="*", type=Path, metavar="RESULTS", help="directories and files, see above")
    parser.add_argument("--values", metavar="FILE", help="of `ms-highway values learn`, or: shipped")
    parser.add_argument(
        "--drivers",
        nargs=3,
        metavar=("EVALUATION", "THETA", "DATA"),
        help="what `ms-highway irl evaluate --json` printed, the reward that `irl fit` wrote (or: us101), and the "
        "recordings, of which a few paths are drawn",
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="an .html file (default: report.html in the first directory)"
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

    out = _checked_page(options)
    sections, directories = _sections(options.results)
    several = list(map(read_results, directories))
    if not out and sections:
        raise ValueError(f"{ONLY_COMPARISONS}; leave out the others")
    for results in several:
        if results.missing:
            remedy = "start the same `ms-highway compare` again, which resumes"
            print(f"ms-highway: {results.directory} lacks {results.missing} episodes; {remedy}", file=sys.stderr)
    if not out:
        print(markdown(overview(several)))
        return
    if several and options.videos:
        try:
            check_format(Path("film.mp4"))
        except ImportError as error:
            raise ImportError(f"{error}, or add --no-videos") from error
    draw_unseen()
    with telling() as tell:
        further = sections + _further(options, several, tell)
        text = page(several, further, options.videos, tell)
    with replacing(out) as path:
        path.write_text(text, encoding="utf-8")
    print(f"the page is {out}, {len(text) / 1e6:.1f} MB")


def _checked_page(options: argparse.Namespace) -> Path | None:
    """Return the page that is to be written, None where a table in Markdown is to be printed.

    Raises:
        ValueError: if it is no page, or there are results or options that do not go with a table.
    """
    directories = [path for path in options.results if path.is_dir()]
    if options.markdown:
        given = {"--out": options.out, "--values": options.values, "--drivers": options.drivers}
        others = [name for name, value in given.items() if value]
        others += [str(path) for path in options.results if path.exists() and path not in directories]
        if others or not options.results:
            raise ValueError(f"{ONLY_COMPARISONS}; {f'leave out {others[0]}' if others else 'name one'}")
        return None
    if not (options.out or directories):
        raise ValueError("there is neither a directory nor --out; name a directory of results, or a page to write")
    out = options.out or directories[0] / "report.html"
    if out.suffix != ".html" or out.is_dir():
        raise ValueError(f"--out is {out}; name an .html file")
    return out


def _sections(paths: list[Path]) -> "tuple[list[Section], list[Path]]":
    """Return the sections of results of other commands, and the directories of comparisons.

    Raises:
        ValueError: for a file that does not exist, cannot be read, or is of no known kind.
    """
    from ms_highway.experiments.analysis.regret import REGRETS_FILE
    from ms_highway.visualization.films import films_section
    from ms_highway.visualization.irl.tables import evaluation_section
    from ms_highway.visualization.regrets import regrets_section

    sections, directories, films = [], [], []
    if len({path.resolve() for path in paths}) < len(paths):
        raise ValueError("results are named twice; name each once")
    for path in paths:
        if path.is_dir():
            regrets = (path / REGRETS_FILE).is_file()
            sections += [regrets_section(path)] if regrets else []
            directories += [] if regrets else [path]
        elif not path.exists():
            raise ValueError(f"there is no {path}; {KINDS}")
        elif path.suffix.lower() == ".gif":
            films.append(path)
        elif path.suffix.lower() == ".json":
            sections.append(evaluation_section(path))
        else:
            raise ValueError(f"{path} holds no results; {KINDS}")
    return sections + ([films_section(films)] if films else []), directories


def _further(options: argparse.Namespace, several: "list[Results]", progress: "Progress") -> "list[Section]":
    """Return the sections of learned values and of learned drivers that are asked for."""
    from ms_highway.visualization.irl.tables import drivers_section
    from ms_highway.visualization.values import values_section

    further = []
    if options.values:
        scenarios = dict.fromkeys(scenario for results in several for scenario in results.scenarios)
        further.append(values_section(options.values, list(scenarios), progress))
    if options.drivers:
        evaluation, theta, data = options.drivers
        further.append(drivers_section(Path(evaluation), theta, data, progress))
    return further
