"""The command ``ms-highway report``."""

import argparse
from pathlib import Path

from ms_highway.cli.command import command, option, output
from ms_highway.cli.console import say, telling, warn

FILM = 'film the best fixed model beside one that is chosen online (default); needs the extra "video"'


@command(
    "report",
    "make a page of a comparison",
    option("directory", "of `ms-highway compare`", type=Path, metavar="DIR"),
    output("--out", "an .html file (default: report.html in DIR)", ".html"),
    option("--videos", FILM, action=argparse.BooleanOptionalAction, default=True),
)
def report(options: argparse.Namespace) -> None:
    """Make one HTML page of a directory of `ms-highway compare`. It is a single file and needs no network. At its top
    stand the answers in sentences; below, a table, a film of two controllers and figures for each scenario, and the
    settings, versions, machine and commands that made the results.

    Examples:
      ms-highway report results/compare
      ms-highway report results/merger --no-videos --out merger.html
    """
    from ms_highway.experiments.results import read_results
    from ms_highway.runtime.files import check_writable, replacing
    from ms_highway.visualization.html_page import page
    from ms_highway.visualization.video import check_format

    directory = options.directory
    out = options.out or directory / "report.html"
    check_writable(out)
    results = read_results(directory)
    if results.missing:
        remedy = "start the same `ms-highway compare` again, which resumes"
        warn(f"{directory} lacks {results.missing} episodes; {remedy}")
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
