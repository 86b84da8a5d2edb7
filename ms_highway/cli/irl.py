"""The command ``ms-highway irl``: demonstrations, and what can be learned from them."""

import argparse
import json
import typing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ms_highway.cli.console import add_command, count_episodes, print_tables, showing
from ms_highway.cli.options import MOST, check_most
from ms_highway.envs.routes import DENSITIES
from ms_highway.game.learned_reward import SHIPPED, LearnedReward, load, save, shipped
from ms_highway.game.reward import COMFORT
from ms_highway.game.reward_model import Model
from ms_highway.irl.evaluation import cross_validate, evaluate
from ms_highway.irl.learning import COMFORT_GIVEN, REAL, SIMULATED, learn
from ms_highway.irl.prediction import Cases, Others, cases_of, predictions
from ms_highway.irl.recordings import commonroad, demonstrations
from ms_highway.irl.recordings.demonstrators import TEMPERATURE
from ms_highway.irl.recordings.recording import Recording
from ms_highway.irl.recovery import recover
from ms_highway.runtime.files import replacing
from ms_highway.runtime.progress import Progress
from ms_highway.visualization import irl as irl_report

__all__ = ["add_irl"]

IRL_HELP = "Learn what human drivers are after from recordings of how they drive."

RECORD_HELP = """\
Record episodes of driving on a highway as a Minari data set, in $MINARI_DATASETS_PATH or ~/.minari/datasets.

Every episode is on disk when the next begins; stopped and started again with the same data set and settings, it goes
on where it was. With --driver keyboard the arrow keys drive: up and down for speed, left and right to steer."""

RECORD_EXAMPLES = """\
examples:
  ms-highway irl record --driver maxent --episodes 200 --dataset ms-highway/maxent-v0
  ms-highway irl record --driver keyboard --episodes 10 --dataset ms-highway/me-v0 --density sparse"""


FIT_HELP = """\
Learn the weights of a reward by maximum entropy: the reward that makes it most likely that drivers did what they did,
window after window of --horizon steps of 0.1 s (Levine and Koltun 2012). Half the least comfort weight is the floor of
the curvature that a fit believes. --out gets weights, temperature, covariance, likelihoods and where all of it is from.
The indicator of a collision has no gradient and is left out."""

FIT_EXAMPLES = """\
examples:
  ms-highway irl fit --data minari:ms-highway/maxent-v0 --out theta.json
  ms-highway irl fit --data us101 --learn headway closing_speed comfort_steering --out theta.json"""

EVALUATE_HELP = """\
Predict recorded drivers for up to 5 s, replanning at 10 Hz, and compare with where they went; beside constant velocity
and highway-env's IDM, on the same stretches of road. With --folds instead of --theta, rewards are learned from the
other recordings, fold after fold. ADE, FDE and RMSE are in metres; a miss is more than 2 m off."""

EVALUATE_EXAMPLES = """\
examples:
  ms-highway irl evaluate --theta us101 --data recordings --json
  ms-highway irl evaluate --folds 4 --data recordings"""

RECOVER_HELP = """\
Learn the weights of simulated drivers from more and more of their demonstrations, and compare them with the true ones
and by what they are worth on the last --held-out demonstrations, which are never learned from.

Results go to --out: recovery.csv (a row per driver, number of demonstrations and weight), weights.png and
likelihood.png."""

RECOVER_EXAMPLES = """\
examples:
  ms-highway irl recover --data minari:ms-highway/maxent-v0 --out results/recovery
  ms-highway irl recover --data minari:ms-highway/maxent-v0 minari:ms-highway/mpc-v0 --demonstrations 16 64 --out out"""

REPORT_HELP = """\
Draw what was learned: errors.png (error against horizon, of the evaluation), paths.png (predicted and recorded paths of
a few drivers of the recordings) and counts.png (feature counts, of the learned reward), in the directory --out."""

REPORT_EXAMPLES = """\
example:
  ms-highway irl evaluate --theta theta.json --data recordings --json > evaluation.json
  ms-highway irl report --evaluation evaluation.json --theta theta.json --data recordings --out results/report"""

DPI = 110

MINARI = "minari:"
HORIZON = 5  # steps, that of the paper's plans
MOST_STEPS = 1000  # of a window
MOST_SEED = 2**32 - 1  # that JAX's random numbers take


def add_irl(commands: Any) -> None:
    """Add the command ``irl`` with its subcommands to a parser's subparsers."""
    irl = commands.add_parser("irl", help="record driving and learn rewards from it", description=IRL_HELP)
    subcommands = irl.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_record(subcommands)
    _add_fit(subcommands)
    _add_evaluate(subcommands)
    _add_recover(subcommands)
    _add_report(subcommands)


def _add_record(commands: Any) -> None:
    record = add_command(commands, "record", "record demonstrations", RECORD_HELP, RECORD_EXAMPLES)
    drivers = "; ".join(f"{name}: {meaning}" for name, meaning in demonstrations.DRIVERS.items())
    record.add_argument("--driver", choices=list(demonstrations.DRIVERS), required=True, help=drivers)
    record.add_argument("--episodes", type=int, required=True, metavar="N", help="episodes the data set shall have")
    record.add_argument("--dataset", required=True, metavar="NAME", help="such as ms-highway/maxent-v0")
    record.add_argument(
        "--density",
        nargs="+",
        choices=list(DENSITIES),
        default=list(DENSITIES),
        help="densities of the traffic, in turn (default: all)",
    )
    record.add_argument(
        "--temperature",
        type=float,
        default=TEMPERATURE,
        help=f"of the driver maxent, in reward (default: {TEMPERATURE:g})",
    )
    record.add_argument("--seed", type=int, default=0, help="seed of the first episode (default: 0)")
    record.set_defaults(run=_record)


def _record(options: argparse.Namespace) -> None:
    check_most(options, episodes=MOST, seed=MOST_SEED)
    counts = demonstrations.record(
        options.driver, options.episodes, options.dataset, options.density, options.seed, options.temperature
    )
    already = next(counts)
    done = count_episodes(counts, already, options.episodes)
    print(f"{options.dataset}: {done} episodes of {options.driver}, {done - already} of them new")


def _add_fit(commands: Any) -> None:
    fit = add_command(commands, "fit", "learn a reward", FIT_HELP, FIT_EXAMPLES)
    _add_data(fit)
    _add_model(fit)
    fit.add_argument("--out", type=Path, required=True, metavar="FILE", help="a .json file for the learned reward")
    fit.set_defaults(run=_fit)


def _add_data(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--data",
        required=True,
        metavar="DIR|minari:NAME",
        help="a directory of CommonRoad scenarios (*.xml, *.xml.gz), or a Minari data set of `ms-highway irl record`",
    )


def _add_model(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--learn",
        nargs="+",
        metavar="WEIGHT",
        help=f"names of the weights to learn (default: {', '.join(REAL.learned)}; of those, from a Minari data set, "
        f"{', '.join(SIMULATED.learned)}); comfort weights that are not learned are 0.1 and set the scale",
    )
    _add_horizon(parser)


def _add_horizon(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--horizon", type=int, metavar="K", help=f"length of windows and plans, in steps (default: {HORIZON})"
    )


def _add_evaluate(commands: Any) -> None:
    parser = add_command(commands, "evaluate", "predict recorded drivers", EVALUATE_HELP, EVALUATE_EXAMPLES)
    _add_data(parser)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--theta", metavar="FILE", help=f"a learned reward: a file, or one of {', '.join(SHIPPED)}")
    which.add_argument("--folds", type=int, metavar="N", help="cross-validate by recording, in N folds")
    _add_model(parser)
    parser.add_argument(
        "--others",
        choices=typing.get_args(Others),
        default="recorded",
        help="what predicted drivers meet: the others where they were recorded to be at each step (default), or where "
        "they would be had they kept their velocity from the start, so that nothing of the future is known",
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.set_defaults(run=_evaluate)


def _fit(options: argparse.Namespace) -> None:
    if options.out.is_dir():
        raise ValueError(f"--out is {options.out}, a directory; name a .json file")
    recordings = _read(options.data)
    source = options.data if options.data.startswith(MINARI) else Path(options.data).resolve().name
    with showing() as show:
        learned = learn(recordings, _model(options, recordings), _horizon(options), source, progress=show)
    save(learned, options.out)
    print_tables(irl_report.learned_table(learned))
    likely = learned.log_likelihood
    held_out = "" if likely["held_out"] is None else f", {likely['held_out']:.3f} on those held out"
    print(f"log-likelihood per window: {likely['train']:.3f}{held_out}")
    print(f"the learned reward is in {options.out}")


def _evaluate(options: argparse.Namespace) -> None:
    if options.theta and (options.learn or options.horizon):
        raise ValueError("--learn and --horizon are those of the learned reward --theta; leave them out")
    learned = _theta(options.theta) if options.theta else None
    recordings = _read(options.data)
    with showing() as show:
        if learned:
            found = evaluate(recordings, learned, options.others, progress=show)
        else:
            model, horizon = _model(options, recordings), _horizon(options)
            found = cross_validate(recordings, model, horizon, options.folds, options.others, progress=show)
    if options.json:
        print(json.dumps(found, indent=2))
        return
    print_tables(irl_report.evaluation_table(found), irl_report.situations_table(found))


def _check_directory(path: Path) -> None:
    """Refuse a file where results shall go, before they are worked out."""
    if path.exists() and not path.is_dir():
        raise ValueError(f"--out is {path}, a file; name a directory")


def _read(data: str) -> list[Recording]:
    if data.startswith(MINARI):
        return demonstrations.load(data.removeprefix(MINARI))
    return commonroad.read_directory(Path(data))


def _theta(name: str) -> LearnedReward:
    return shipped(name) if name in SHIPPED else load(Path(name))


def _horizon(options: argparse.Namespace) -> int:
    steps = HORIZON if options.horizon is None else options.horizon
    if steps < 1:
        raise ValueError(f"--horizon is {steps}; a window has at least one step")
    check_most(options, horizon=MOST_STEPS)
    return steps


def _model(options: argparse.Namespace, recordings: list[Recording]) -> Model:
    usual = REAL if recordings[0].measured else SIMULATED
    if not options.learn:
        return usual
    given = {**dict.fromkeys(COMFORT, COMFORT_GIVEN), **usual.given}
    return Model(tuple(options.learn), {name: value for name, value in given.items() if name not in options.learn})


def _add_recover(commands: Any) -> None:
    parser = add_command(commands, "recover", "recover known weights", RECOVER_HELP, RECOVER_EXAMPLES)
    parser.add_argument(
        "--data", nargs="+", required=True, metavar="minari:NAME", help="data sets of `ms-highway irl record`"
    )
    parser.add_argument(
        "--demonstrations",
        nargs="+",
        type=int,
        default=[4, 16, 64, 256],
        metavar="N",
        help="numbers of demonstrations to learn from (default: 4 16 64 256)",
    )
    parser.add_argument(
        "--held-out", type=int, default=64, metavar="N", help="demonstrations to judge by, the last (default: 64)"
    )
    _add_horizon(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="directory of results")
    parser.set_defaults(run=_recover)


def _recover(options: argparse.Namespace) -> None:
    _check_directory(options.out)
    horizon = _horizon(options)
    data = list(dict.fromkeys(options.data))
    for name in data:
        if not name.startswith(MINARI):
            raise ValueError(f"--data is {name!r}; true weights are known of simulated drivers only, minari:NAME")
    names = [name.removeprefix(MINARI) for name in data]
    for name in names:
        if demonstrations.known_weights(name) is None:
            raise ValueError(f"nobody knows what the person drove for who recorded {name}; choose another data set")
    sets = {name: demonstrations.load(name) for name in names}
    tables = []
    for name, recordings in sets.items():
        with showing() as show:
            found = recover(recordings, options.demonstrations, SIMULATED, horizon, options.held_out, progress=show)
        found.insert(0, "driver", name)
        tables.append(found)
    rows = pd.concat(tables, ignore_index=True)
    figures = {"weights": irl_report.weights_figure(rows), "likelihood": irl_report.likelihood_figure(rows)}
    with replacing(options.out / "recovery.csv") as path:
        rows.to_csv(path, index=False)
    _save_figures(figures, options.out)
    print_tables(irl_report.recovery_table(rows))
    print(f"results are in {options.out}")


def _add_report(commands: Any) -> None:
    parser = add_command(commands, "report", "draw what was learned", REPORT_HELP, REPORT_EXAMPLES)
    parser.add_argument(
        "--evaluation", type=Path, required=True, metavar="FILE", help="what `ms-highway irl evaluate --json` prints"
    )
    parser.add_argument(
        "--theta", required=True, metavar="FILE", help=f"a learned reward: a file, or one of {', '.join(SHIPPED)}"
    )
    _add_data(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="directory of results")
    parser.set_defaults(run=_report)


def _report(options: argparse.Namespace) -> None:
    _check_directory(options.out)
    evaluation = irl_report.load_evaluation(options.evaluation)
    learned, recordings = _theta(options.theta), _read(options.data)
    with showing() as show:
        cases, titles, paths = _drive_examples(recordings, learned, show)
    figures = {
        "errors": irl_report.errors_figure(evaluation),
        "paths": irl_report.paths_figure(cases, paths, titles),
        "counts": irl_report.counts_figure(learned),
    }
    _save_figures(figures, options.out)
    print_tables(irl_report.evaluation_table(evaluation), irl_report.situations_table(evaluation))
    print(f"figures are in {options.out}")


def _drive_examples(
    recordings: list[Recording], learned: LearnedReward, progress: Progress
) -> tuple[Cases, list[str], dict[str, Any]]:
    """Examples of the recordings, what is special about each, and where all predictors get in them."""
    progress("choosing examples")
    cases = cases_of(recordings)
    chosen = irl_report.examples(cases)
    cases = cases.of(np.array(list(chosen.values())))
    progress(f"driving {len(cases)} examples")
    return cases, list(chosen), predictions(cases, learned.sharp_weights, learned.horizon)


def _save_figures(figures: dict[str, Figure], directory: Path) -> None:
    for name, figure in figures.items():
        with replacing(directory / f"{name}.png") as path:
            figure.savefig(path, dpi=DPI)
