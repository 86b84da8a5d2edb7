"""The commands ``ms-highway irl ...``, and the options that they share."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from ms_highway.cli.console import add_command, count_episodes, print_tables, say, telling
from ms_highway.cli.options import add_number, directory_to_write, file_to_write
from ms_highway.irl import DRIVERS, REAL_WEIGHTS, SIMULATED_WEIGHTS, TEMPERATURE, Others

if TYPE_CHECKING:
    from ms_highway.game.reward import RewardModel
    from ms_highway.irl.recording import Recording

MINARI = "minari:"
"""Prefix of a Minari data set's name on the command line."""

DENSITY_NAMES = ("sparse", "medium", "dense")
"""Keys of `ms_highway.envs.demonstration.DENSITIES`; repeated here so that help needs no JAX."""

HORIZON = 5  # steps, as the paper plans
MOST_STEPS = 1000  # in a segment


def add_data(parser: argparse.ArgumentParser) -> None:
    """Add ``--data``, ``--learn`` and ``--horizon``, see `read_recordings` and `chosen_model`, to a command."""
    parser.add_argument(
        "--data",
        required=True,
        metavar="DIR|minari:NAME",
        help="a directory of CommonRoad scenarios (*.xml, *.xml.gz), or a Minari data set of `ms-highway irl record`",
    )
    parser.add_argument(
        "--learn",
        nargs="+",
        metavar="WEIGHT",
        help=f"names of the weights to learn (default: {', '.join(REAL_WEIGHTS)}; of those, from a Minari data set, "
        f"{', '.join(SIMULATED_WEIGHTS)}); comfort weights that are not learned are 0.1 and set the scale",
    )
    text = f"length of segments, in steps (default: {HORIZON})"
    add_number(parser, "--horizon", None, text, most=MOST_STEPS, metavar="K")


def read_recordings(data: str) -> "list[Recording]":
    """Read the recordings that ``--data`` names."""
    if data.startswith(MINARI):
        from ms_highway.irl.demonstrations import load_demonstrations

        return load_demonstrations(data.removeprefix(MINARI))
    from ms_highway.irl.commonroad import read_directory

    return read_directory(Path(data))


def chosen_model(options: argparse.Namespace, recordings: "list[Recording]") -> "tuple[RewardModel, int]":
    """Return the reward that ``--learn`` selects, by default REAL or SIMULATED, and the steps of ``--horizon``.

    Raises:
        ValueError: for an impossible model.
    """
    from ms_highway.game.reward import COMFORT, RewardModel
    from ms_highway.irl.learning import COMFORT_GIVEN, REAL, SIMULATED

    usual, steps = REAL if recordings[0].measured else SIMULATED, options.horizon or HORIZON
    if not options.learn:
        return usual, steps
    given = {**dict.fromkeys(COMFORT, COMFORT_GIVEN), **usual.given}
    rest = {name: value for name, value in given.items() if name not in options.learn}
    return RewardModel(tuple(options.learn), rest, usual.tails), steps


EVALUATE_HELP = """\
Predict recorded drivers for up to 5 s and compare with where they went, beside constant velocity, highway-env's IDM
and a fitted IDM. All predict every driver, from the same moments, once a second.

With --folds instead of --theta, everything is learned from the other recordings, fold after fold. FDE, the distance at
the horizon, and RMSE are in metres; a miss is more than 2 m off; log p is the mean log density of the recorded position
in 1/m^2; "in 90 %" is the share of drivers in the region that holds 90 % of the predicted probability. Segments are
--horizon steps of controls, see irl fit.

With --figures, errors.png, likelihood.png and calibration.png are written to a directory; with --theta also paths.png,
predicted and recorded paths of all drivers at one moment."""

EVALUATE_EXAMPLES = """\
examples:
  ms-highway irl evaluate --theta us101 --data recordings --figures results/us101
  ms-highway irl evaluate --theta us101 --data recordings --json
  ms-highway irl evaluate --folds 4 --data recordings"""


def add_evaluate(commands: Any) -> None:
    """Add the command ``evaluate`` to a parser's subparsers."""
    parser = add_command(commands, "irl evaluate", "predict recorded drivers", EVALUATE_HELP, EVALUATE_EXAMPLES)
    add_data(parser)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument(
        "--theta",
        metavar="FILE",
        help="a reward learned from real recordings: a file of `ms-highway irl fit`, or us101",
    )
    which.add_argument("--folds", type=int, metavar="N", help="cross-validate by recording, in N folds")
    parser.add_argument(
        "--others",
        choices=get_args(Others),
        default="predicted",
        help="what predicted drivers meet: the others as they are predicted, all together, so that nothing of the "
        "future is known (default); the others where they were recorded to be, a leak of the future; or the others at "
        "constant velocity",
    )
    parser.add_argument("--figures", type=directory_to_write, metavar="DIR", help="a directory for figures, *.png")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.set_defaults(run=_evaluate)


def _evaluate(options: argparse.Namespace) -> None:
    import msgspec

    from ms_highway.cli.results_directory import save_figures
    from ms_highway.game.learned_reward import named
    from ms_highway.irl.evaluation import evaluate
    from ms_highway.irl.prediction import check_drivers
    from ms_highway.visualization.irl import evaluation_figures, evaluation_tables, paths_figure

    learned = named(options.theta) if options.theta else None
    if learned and (options.learn or options.horizon):
        raise ValueError("--learn and --horizon are those of the learned reward --theta; leave them out")
    drivers = check_drivers(learned.drivers, f"--theta {options.theta}") if learned else None
    with telling() as tell:
        recordings = read_recordings(options.data)
        if learned:
            found = evaluate(recordings, learned, options.others, progress=tell)
        else:
            chosen, steps = chosen_model(options, recordings)
            found = evaluate(recordings, chosen, options.others, horizon=steps, parts=options.folds, progress=tell)
        if options.figures:
            figures = evaluation_figures(found)
            if drivers:
                figures["paths"] = paths_figure(recordings, drivers)
            save_figures(figures, options.figures)
    if options.json:
        say(msgspec.json.format(msgspec.json.encode(found), indent=2).decode())
    else:
        print_tables(*evaluation_tables(found))


FIT_HELP = """\
Learn the weights of a reward by maximum entropy: the reward that makes it most likely that drivers did what they did,
segment after segment of --horizon steps of 0.1 s (Levine and Koltun 2012). The curvature of the reward counts as at
least half the smallest comfort weight. The indicator of a collision has no gradient and is left out.

From real recordings, a second set of weights is learned from where drivers are 1 to 5 s later, and with it how drivers
differ, when they change lanes and how far off predictions are; irl evaluate predicts with these.

Write to --out: weights, temperature, covariance, likelihoods, drivers and provenance."""

FIT_EXAMPLES = """\
examples:
  ms-highway irl fit --data minari:ms-highway/maxent-v0 --out theta.json
  ms-highway irl fit --data us101 --learn headway closing_speed comfort_steering --out theta.json"""


def add_fit(commands: Any) -> None:
    """Add the command ``fit`` to a parser's subparsers."""
    parser = add_command(commands, "irl fit", "learn a reward", FIT_HELP, FIT_EXAMPLES)
    add_data(parser)
    parser.add_argument(
        "--out", type=file_to_write, required=True, metavar="FILE", help="a .json file for the learned reward"
    )
    parser.set_defaults(run=_fit_reward)


def _fit_reward(options: argparse.Namespace) -> None:
    from ms_highway.game.learned_reward import save
    from ms_highway.irl.learning import learn_reward
    from ms_highway.visualization.irl import learned_tables

    source = options.data if options.data.startswith(MINARI) else Path(options.data).resolve().name
    with telling() as tell:
        recordings = read_recordings(options.data)
        learned = learn_reward(recordings, *chosen_model(options, recordings), source, progress=tell)
    save(learned, options.out)
    print_tables(*learned_tables(learned))
    train, held_out = (learned.log_likelihood[part] for part in ("train", "held_out"))
    rest = "" if held_out is None else f", {held_out:.3f} on those held out"
    say(f"log-likelihood per segment: {train:.3f}{rest}")
    say(f"the learned reward is in {options.out}")


RECORD_HELP = """\
Record episodes of driving on a highway (ms-highway/demonstration-v0) as a Minari data set, in $MINARI_DATASETS_PATH or
~/.minari/datasets.

Every episode is on disk when the next begins; started again with the same data set and settings, recording goes on
after the last one. With --driver keyboard the arrow keys drive: up and down for speed, left and right to steer."""

RECORD_EXAMPLES = """\
examples:
  ms-highway irl record --driver maxent --episodes 200 --dataset ms-highway/maxent-v0
  ms-highway irl record --driver keyboard --episodes 10 --dataset ms-highway/me-v0 --density sparse"""

MOST_SEED = 2**32 - 1  # that JAX's random numbers take


def add_record(commands: Any) -> None:
    """Add the command ``record`` to a parser's subparsers."""
    parser = add_command(commands, "irl record", "record demonstrations", RECORD_HELP, RECORD_EXAMPLES)
    drivers = "; ".join(f"{name}: {meaning}" for name, meaning in DRIVERS.items())
    parser.add_argument("--driver", choices=list(DRIVERS), required=True, help=drivers)
    add_number(parser, "--episodes", None, "episodes that the data set is to have", required=True, metavar="N")
    parser.add_argument("--dataset", required=True, metavar="NAME", help="such as ms-highway/maxent-v0")
    parser.add_argument(
        "--density",
        nargs="+",
        choices=DENSITY_NAMES,
        default=list(DENSITY_NAMES),
        help="densities of the traffic, in turn (default: all)",
    )
    parser.add_argument(
        "--temperature",
        type=float,
        default=TEMPERATURE,
        help=f"of the driver maxent, in reward (default: {TEMPERATURE:g})",
    )
    add_number(parser, "--seed", 0, "seed of the first episode", least=0, most=MOST_SEED)
    parser.set_defaults(run=_record)


def _record(options: argparse.Namespace) -> None:
    from ms_highway.irl.demonstrations import record

    asked = options.driver, options.episodes, options.dataset, options.density, options.seed, options.temperature
    counts = record(*asked)
    already = next(counts)
    done = count_episodes(counts, already, options.episodes)
    say(f"{options.dataset}: {done} episodes of {options.driver}, {done - already} of them new")
