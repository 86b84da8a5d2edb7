"""The command ``ms-highway video``."""

import argparse
from typing import Any

from ms_highway.cli.console import add_command, say
from ms_highway.cli.options import (
    CONTROLLERS,
    LEARNED,
    MOST_SEEDS,
    SCENARIO_NAMES,
    add_keys,
    add_number,
    configuration,
    file_to_write,
)

HELP = """\
Film one episode from above: the road, the robot's plan, the human path that it counts on, and a panel with the model
in use, planning time and reward. Plays at true speed. Among several humans, each has the colour of the model that
predicts it, and the panel shows how many humans each model predicts, and the time of the step against its budget.

With --against, a second controller drives from the same start, and both are shown together, one above the other, each
under its name, its mean reward per step and what it has spent on planning and deciding so far."""

EXAMPLES = """\
examples:
  ms-highway video merger --seed 0 --out merger.mp4
  ms-highway video merger --controller tom --against learned:1 --width 640 --out merger.gif"""


def add_video(commands: Any) -> None:
    """Add the command ``video`` to a parser's subparsers."""
    parser = add_command(commands, "video", "film an episode", HELP, EXAMPLES)
    parser.add_argument("scenario", metavar="SCENARIO", help=", ".join(SCENARIO_NAMES))
    usual = f"(default: {LEARNED})"
    parser.add_argument("--controller", metavar="CONTROLLER", default=LEARNED, help=f"{CONTROLLERS} {usual}")
    parser.add_argument("--against", metavar="CONTROLLER", help="a second controller, filmed from the same start")
    add_number(parser, "--seed", 0, "of the episode", 0, MOST_SEEDS)
    add_number(parser, "--speed", 1.0, "1 is true speed, 0.5 slow motion", 0.01, 100)
    add_number(parser, "--width", None, "scale the video to this width", 160, 1280, metavar="PIXELS")
    parser.add_argument("--out", type=file_to_write, required=True, metavar="FILE", help="an .mp4 or .gif file")
    add_keys(parser)
    parser.set_defaults(run=_video)


def _video(options: argparse.Namespace) -> None:
    from ms_highway.experiments.comparison import Comparison
    from ms_highway.visualization import video

    controllers = [name for name in (options.controller, options.against) if name]
    config = configuration(options)
    Comparison({options.scenario: controllers}, config=config).check()
    video.check_format(options.out)
    films = video.film_together(options.scenario, controllers, options.seed, **config)
    pictures = video.side_by_side(films) if options.against else films[0].pictures
    if options.width is not None:
        pictures = video.scaled(pictures, options.width)
    rate = films[0].frames_per_second * options.speed
    video.write(pictures, options.out, rate)
    say(f"{options.out}: {len(pictures)} frames, {len(pictures) / rate:.1f} s")
