"""The command ``ms-highway irl fit``."""

import argparse
from pathlib import Path
from typing import Any

from ms_highway.cli.console import add_command, print_tables, telling
from ms_highway.cli.irl.options import MINARI, add_data, model, read

HELP = """\
Learn the weights of a reward by maximum entropy: the reward that makes it most likely that drivers did what they did,
window after window of --horizon steps of 0.1 s (Levine and Koltun 2012). The curvature of the reward counts as at least
half the smallest comfort weight. The indicator of a collision has no gradient and is left out.

From real recordings, a second set of weights is learned from where drivers are 1 to 5 s later, and with it how drivers
differ, when they change lanes and how far off predictions are; irl evaluate predicts with these.

Write to --out: weights, temperature, covariance, likelihoods, drivers and provenance."""

EXAMPLES = """\
examples:
  ms-highway irl fit --data minari:ms-highway/maxent-v0 --out theta.json
  ms-highway irl fit --data us101 --learn headway closing_speed comfort_steering --out theta.json"""


def add_fit(commands: Any) -> None:
    """Add the command ``fit`` to a parser's subparsers."""
    parser = add_command(commands, "irl fit", "learn a reward", HELP, EXAMPLES)
    add_data(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="a .json file for the learned reward")
    parser.set_defaults(run=_fit_reward)


def _fit_reward(options: argparse.Namespace) -> None:
    from ms_highway.game.learned_reward import save
    from ms_highway.irl.learning import learn_reward
    from ms_highway.visualization.irl.tables import learned_tables

    if options.out.is_dir():
        raise ValueError(f"--out is {options.out}, a directory; name a .json file")
    recordings = read(options.data)
    source = options.data if options.data.startswith(MINARI) else Path(options.data).resolve().name
    with telling() as tell:
        learned = learn_reward(recordings, *model(options, recordings), source, progress=tell)
    save(learned, options.out)
    print_tables(*learned_tables(learned))
    train, held_out = (learned.log_likelihood[part] for part in ("train", "held_out"))
    rest = "" if held_out is None else f", {held_out:.3f} on those held out"
    print(f"log-likelihood per window: {train:.3f}{rest}")
    print(f"the learned reward is in {options.out}")
