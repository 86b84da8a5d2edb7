"""Define the commands ``ms-highway report``, ``video`` and ``validate``."""

import argparse
import json
from pathlib import Path

from ms_highway.cli.command import command, number, option, output
from ms_highway.cli.console import print_tables, say, tell, warn
from ms_highway.cli.options import CONTROLLERS, LEARNED, MAX_SEEDS, SCENARIO_NAMES, SET, configuration

FILM = 'film the best fixed model and a controller that chooses online (default); needs the extra "video"'
KINDS = {"action_error": "robot's control", "reward_error": "reward", "human_error": "human's control"}


@command(
    "report",
    "make a page of a comparison",
    option("directory", "of `ms-highway compare`", type=Path, metavar="DIR"),
    output("--out", "an .html file (default: report.html in DIR)", ".html"),
    option("--videos", FILM, action=argparse.BooleanOptionalAction, default=True),
)
def report(options: argparse.Namespace) -> None:
    """Make an HTML page, a single file that needs no network, of a directory of `ms-highway compare`. The page begins
    with the answers in sentences. For each scenario, it has a table, a film of two controllers and figures; at its end
    are the settings, versions, machine and commands that made the results.

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
        remedy = "start the same `ms-highway compare` again, and it resumes"
        warn(f"{directory} lacks {results.missing} episodes; {remedy}")
    if options.videos:
        try:
            check_format(Path("film.mp4"))
        except ImportError as error:
            raise ImportError(f"{error}, or add --no-videos") from error
    text = page(results, options.videos, tell)
    with replacing(out) as path:
        path.write_text(text, encoding="utf-8")
    say(f"the page is {out}, {len(text) / 1e6:.1f} MB")


@command(
    "video",
    "film an episode",
    option("scenario", ", ".join(SCENARIO_NAMES), metavar="SCENARIO"),
    option("--controller", CONTROLLERS, LEARNED, metavar="CONTROLLER"),
    option("--against", "a second controller, filmed from the same start", metavar="CONTROLLER"),
    number("--seed", 0, "of the episode", 0, MAX_SEEDS),
    number("--speed", 1.0, "1 is true speed, 0.5 slow motion", 0.01, 100),
    number("--width", None, "scale the video to this width", 160, 1280, metavar="PIXELS"),
    output("--out", "an .mp4 or .gif file", ".mp4", ".gif", required=True),
    SET,
)
def video(options: argparse.Namespace) -> None:
    """Film one episode from above: the road, the robot's plan, the predicted path of the human, and a panel with the
    model in use, planning time and reward. The film plays at true speed. Among several humans, each has the colour of
    the model that predicts it, and the panel shows the number of humans per model, and the time and budget of the step.

    With --against, a second controller drives from the same start. The film shows both, one above the other, with name,
    mean reward per step and the time spent on planning and deciding so far.

    Examples:
      ms-highway video merger --seed 0 --out merger.mp4
      ms-highway video merger --controller tom --against learned:1 --width 640 --out merger.gif
    """
    from ms_highway.visualization import video

    controllers = [name for name in (options.controller, options.against) if name]
    config = configuration(options)
    video.check_format(options.out)
    films = video.film_together(options.scenario, controllers, options.seed, **config)
    pictures = video.side_by_side(films) if options.against else films[0].pictures
    if options.width is not None:
        pictures = video.scaled(pictures, options.width)
    rate = films[0].frames_per_second * options.speed
    video.write(pictures, options.out, rate)
    say(f"{options.out}: {len(pictures)} frames, {len(pictures) / rate:.1f} s")


@command(
    "validate",
    "replay reference episodes",
    option("directory", "directory of reference files, SCENARIO__KIND.npz", type=Path, metavar="DIR"),
    option("--json", "print JSON instead of a table", action="store_true"),
)
def validate(options: argparse.Namespace) -> None:
    """Replay logged episodes of the paper's released code: plan from every logged state, and compare controls, rewards,
    human controls and switching decisions with the logs. The table has quantiles of the errors over all steps, in the
    units of the logs.

    Examples:
      ms-highway validate reference/episodes --json
    """
    from ms_highway.experiments.validation import validate
    from ms_highway.visualization.tables import grid

    result = validate(options.directory)
    if options.json:
        say(json.dumps(result, indent=2))
        return
    rows = []
    for name, errors in result["files"].items():
        row = {"file": name}
        for kind, heading in KINDS.items():
            row[heading] = " ".join(f"{value:.0e}" for value in errors[kind].values())
        row["decisions"] = "{agree} of {all}".format(**errors["decisions"]) if "decisions" in errors else ""
        rows.append(row)
    print_tables(grid("errors against the logs: median, 90 %, 99 %, largest", rows))
