"""The command ``ms-highway video``."""

import argparse
from pathlib import Path
from typing import Any

from ms_highway.cli.console import add_command, draw_unseen
from ms_highway.cli.options import (
    CONTROLLERS,
    CROWD_CONTROLLERS,
    CROWD_NAMES,
    EFFORTS,
    SCENARIO_NAMES,
    add_humans,
    add_planning,
    add_semantics,
    human_reward,
    planning,
)

__all__ = ["add_video"]

SLOWEST, FASTEST = 0.01, 100

HELP = """\
Film one episode from above: the road, the robot's plan, the human path that it counts on, and a panel with the model
in use, planning time and reward. Plays at true speed. Among several humans, each has the colour of the model that
predicts it, and the panel shows how many humans each model predicts, and the time of the step against its budget.

With --against, a second controller drives from the same start, and both are shown together, one above the other, each
under its name, its mean reward per step and what it has spent on planning and deciding so far."""

EXAMPLES = """\
examples:
  ms-highway video merger --controller switching:0.1 --seed 0 --out merger.mp4
  ms-highway video merger --controller tom --against switching:0.1 --width 640 --out merger.gif"""


def add_video(commands: Any) -> None:
    """Add the command ``video`` to a parser's subparsers."""
    parser = add_command(commands, "video", "film an episode", HELP, EXAMPLES)
    parser.add_argument("scenario", metavar="SCENARIO", help=", ".join((*SCENARIO_NAMES, *CROWD_NAMES)))
    parser.add_argument(
        "--controller",
        metavar="CONTROLLER",
        help=f"{CONTROLLERS}; {EFFORTS}; among several humans {CROWD_CONTROLLERS} (default: switching with the "
        "conservative lambda)",
    )
    parser.add_argument("--against", metavar="CONTROLLER", help="a second controller, filmed from the same start")
    parser.add_argument("--seed", type=int, default=0, help="seed of the episode (default: 0)")
    add_semantics(parser)
    add_planning(parser)
    add_humans(parser)
    parser.add_argument("--speed", type=float, default=1.0, help="1 is true speed (default), 0.5 slow motion")
    parser.add_argument("--width", type=int, metavar="PIXELS", help="scale the video down to this width")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="an .mp4 or .gif file")
    parser.set_defaults(run=_video)


def _video(options: argparse.Namespace) -> None:
    from ms_highway.envs import ENVIRONMENTS, environment_id
    from ms_highway.experiments.comparison import paper_controllers
    from ms_highway.visualization import video
    from ms_highway.visualization.side_by_side import side_by_side

    if not SLOWEST <= options.speed <= FASTEST:
        raise ValueError(f"--speed is {options.speed}; it must be between {SLOWEST} and {FASTEST}")
    if options.seed < 0:
        raise ValueError(f"--seed is {options.seed}; it must not be negative")
    environment_id(options.scenario)
    if options.width is not None:
        video.check_width(options.width, ENVIRONMENTS[options.scenario].default_config()["screen_width"])
    video.check_format(options.out)
    controllers = [options.controller or paper_controllers(options.scenario)[-1]]
    controllers += [options.against] if options.against else []
    for controller in controllers:
        ENVIRONMENTS[options.scenario].controller_config(controller)
    config = {"semantics": options.semantics, "human_reward": human_reward(options.human_reward)} | planning(options)
    draw_unseen()
    films = [video.film(options.scenario, controller, options.seed, **config) for controller in controllers]
    pictures = side_by_side(films) if options.against else films[0].pictures
    if options.width is not None:
        pictures = video.scaled(pictures, options.width)
    rate = films[0].frames_per_second * options.speed
    video.write(pictures, options.out, rate)
    print(f"{options.out}: {len(pictures)} frames, {len(pictures) / rate:.1f} s")
