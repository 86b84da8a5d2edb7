"""The command ``ms-highway video``."""

import argparse

from ms_highway.cli.command import command, number, option, output
from ms_highway.cli.console import say
from ms_highway.cli.options import CONTROLLERS, LEARNED, MOST_SEEDS, SCENARIO_NAMES, SET, configuration


@command(
    "video",
    "film an episode",
    option("scenario", ", ".join(SCENARIO_NAMES), metavar="SCENARIO"),
    option("--controller", CONTROLLERS, LEARNED, metavar="CONTROLLER"),
    option("--against", "a second controller, filmed from the same start", metavar="CONTROLLER"),
    number("--seed", 0, "of the episode", 0, MOST_SEEDS),
    number("--speed", 1.0, "1 is true speed, 0.5 slow motion", 0.01, 100),
    number("--width", None, "scale the video to this width", 160, 1280, metavar="PIXELS"),
    output("--out", "an .mp4 or .gif file", ".mp4", ".gif", required=True),
    SET,
)
def video(options: argparse.Namespace) -> None:
    """Film one episode from above: the road, the robot's plan, the human path that it counts on, and a panel with the
    model in use, planning time and reward. Plays at true speed. Among several humans, each has the colour of the model
    that predicts it, and the panel shows how many humans each model predicts, and the time of the step against its
    budget.

    With --against, a second controller drives from the same start, and both are shown together, one above the other,
    each under its name, its mean reward per step and what it has spent on planning and deciding so far.

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
