"""Define the commands ``ms-highway irl ...``."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ms_highway.cli.console import (
    command,
    count_episodes,
    number,
    option,
    output,
    print_tables,
    save_figures,
    say,
    tell,
    warn,
)
from ms_highway.cli.options import FORMAT
from ms_highway.irl import DEMONSTRATORS, REAL_WEIGHTS, SIMULATED_WEIGHTS, TEMPERATURE

if TYPE_CHECKING:
    from ms_highway.data.learned_reward import LearnedReward
    from ms_highway.game.reward import RewardModel
    from ms_highway.irl.recording import Recording

MINARI = "minari:"
"""Prefix of a Minari data set's name on the command line."""

DENSITY_NAMES = ("sparse", "medium", "dense")
"""Keys of `ms_highway.envs.demonstration.DENSITIES`; help needs no JAX to show them."""

RECORDINGS = option(
    "--data",
    "a directory of CommonRoad scenarios (*.xml, *.xml.gz), or a Minari data set of"
    " `ms-highway irl record`",
    required=True,
    metavar="DIR|minari:NAME",
)


def read_recordings(data: str) -> "list[Recording]":
    """Read the recordings that ``--data`` names."""
    if data.startswith(MINARI):
        from ms_highway.irl.demonstrations import load_demonstrations

        return load_demonstrations(data.removeprefix(MINARI))
    from ms_highway.irl.commonroad import read_directory

    return read_directory(Path(data))


def reward_with_drivers(name: str) -> "LearnedReward":
    """Return the reward that ``--theta`` names, which predicts real drivers.

    Raises:
        ValueError: if no drivers were learned with it, or none that can be predicted
            with.
    """
    from ms_highway.data.learned_reward import named
    from ms_highway.irl.peers import check_peers

    reward = named(name)
    if not reward.drivers:
        raise ValueError(
            f"--theta {name} has no drivers that were learned from real recordings;"
            " use us101"
        )
    try:
        check_peers(reward.drivers)
    except ValueError as error:
        raise ValueError(f"--theta {name} cannot be used ({error})") from error
    return reward


def chosen_model(
    learn: list[str] | None,
    recordings: "list[Recording]",
) -> "RewardModel":
    """Return the reward model whose weights are learned.

    Args:
        learn: names of the weights of ``--learn``; by default, those that suit the
            recordings.
        recordings: that it is learned from.

    Raises:
        ValueError: for an impossible model.
    """
    from ms_highway.game.reward import COMFORT, RewardModel
    from ms_highway.irl.learning import COMFORT_GIVEN, REAL, SIMULATED

    usual = REAL if recordings[0].measured else SIMULATED
    if not learn:
        return usual
    given = {**dict.fromkeys(COMFORT, COMFORT_GIVEN), **usual.given}
    return RewardModel(
        tuple(learn),
        {name: given[name] for name in given if name not in learn},
        usual.tails,
    )


@command(
    "irl evaluate",
    "predict recorded drivers",
    RECORDINGS,
    option(
        "--theta",
        "a reward learned from real recordings: a file of `ms-highway irl fit`, or"
        " us101",
        metavar="FILE",
    ),
    number("--folds", None, "cross-validate by recording, in N folds", 2, metavar="N"),
    output("--figures", "a directory for figures", directory=True),
    FORMAT,
    option("--json", "print JSON instead of a table", action="store_true"),
)
def evaluate(options: argparse.Namespace) -> None:
    """Predict recorded drivers for up to 5 s and compare predictions with their paths.

    Constant velocity, highway-env's IDM and a fitted IDM predict the same drivers from
    the same snapshots, one a second.

    With --folds instead of --theta, each fold is predicted by drivers learned from the
    other folds. FDE, the distance at the horizon, and RMSE are in metres; a miss is
    more than 2 m off; log p is the mean log density of the recorded position in 1/m^2;
    "in 90 %" is the share of drivers in the region that holds 90 % of the predicted
    probability.

    With --figures, a directory gets figures of errors, likelihood and calibration and,
    with --theta, of the predicted and recorded paths of all drivers at one moment.

    A warning says if FILE was learned from some of the same recordings.

    Examples:
      ms-highway irl evaluate --theta us101 --data recordings --figures results/us101
      ms-highway irl evaluate --theta us101 --data recordings --json
      ms-highway irl evaluate --folds 4 --data recordings
    """
    import msgspec

    from ms_highway.irl.evaluation import evaluate
    from ms_highway.irl.recording import known_from
    from ms_highway.visualization.irl import (
        PANELS,
        evaluation_tables,
        metrics_figure,
        paths_figure,
    )

    if bool(options.theta) == bool(options.folds):
        raise ValueError(
            "give either --theta FILE, to predict by, or --folds N, to learn and"
            " predict"
        )
    reward = reward_with_drivers(options.theta) if options.theta else None
    learned = reward.drivers if reward else None
    recordings = read_recordings(options.data)
    known = known_from(recordings, reward.learned_from) if reward else []
    if known:
        warn(
            f"{options.theta} was learned from {len(known)} of these {len(recordings)}"
            " recordings: errors of learned drivers and of the fitted IDM are smaller"
            " than for new drivers; --folds 4 instead of --theta predicts only drivers"
            " that were not learned from"
        )
    found = evaluate(recordings, learned, parts=options.folds, progress=tell)
    found = msgspec.structs.replace(found, learned_from=len(known))
    if options.json:
        say(msgspec.json.format(msgspec.json.encode(found), indent=2).decode())
    else:
        print_tables(*evaluation_tables(found))
    if options.figures:
        drawings = {name: partial(metrics_figure, found, name) for name in PANELS}
        if learned:
            drawings["paths"] = partial(paths_figure, recordings, learned)
        save_figures(drawings, options.figures, options.format)


@command(
    "irl fit",
    "learn a reward",
    RECORDINGS,
    option(
        "--learn",
        f"names of the weights to learn (default: {', '.join(REAL_WEIGHTS)}; from a"
        f" Minari data set only {', '.join(SIMULATED_WEIGHTS)}); comfort weights that"
        " are not learned are 0.1 and set the scale",
        nargs="+",
        metavar="WEIGHT",
    ),
    # 5 steps, as the paper plans.
    number("--horizon", 5, "length of segments, in steps", most=1000, metavar="K"),
    output("--out", "a .json file for the learned reward", required=True),
)
def fit(options: argparse.Namespace) -> None:
    r"""Learn the weights of a reward by maximum entropy.

    Maximise the likelihood of the recorded controls in segments of --horizon steps of
    0.1 s (Levine and Koltun 2012). The curvature of the reward counts as at least half
    the smallest comfort weight. The indicator of a collision has no gradient and is
    left out.

    From real recordings, a second set of weights is learned from where drivers are 1 to
    5 s later, together with the differences between drivers, their lane changes and the
    errors of predictions. `ms-highway irl evaluate` predicts with these.

    Drivers that only stand, jump, drive backwards, were seen with a gap or are where
    another one is, are left out with a warning. --out gets weights, temperature,
    covariance, likelihoods, drivers, provenance and fingerprints of the recordings, by
    which `ms-highway irl evaluate` knows them again.

    Examples:
      ms-highway irl fit --data minari:ms-highway/maxent-v0 --out theta.json
      ms-highway irl fit --data us101 --learn headway closing_speed comfort_steering \
        --out theta.json
    """
    from ms_highway.data.learned_reward import save
    from ms_highway.irl.learning import learn_reward
    from ms_highway.visualization.irl import learned_tables

    is_data_set = options.data.startswith(MINARI)
    source = options.data if is_data_set else Path(options.data).resolve().name
    recordings = read_recordings(options.data)
    model = chosen_model(options.learn, recordings)
    learned = learn_reward(recordings, model, options.horizon, source, progress=tell)
    save(learned, options.out)
    print_tables(*learned_tables(learned))
    told = [
        f"{part} {value:.3f}"
        for part, value in learned.log_likelihood.items()
        if value is not None
    ]
    say(f"log-likelihood per segment: {', '.join(told)}")
    say(f"the learned reward is in {options.out}")


@command(
    "irl record",
    "record demonstrations",
    option(
        "--driver",
        "; ".join(f"{name}: {meaning}" for name, meaning in DEMONSTRATORS.items()),
        choices=list(DEMONSTRATORS),
        required=True,
    ),
    number(
        "--episodes",
        None,
        "number of episodes of the complete data set",
        required=True,
        metavar="N",
    ),
    option(
        "--dataset",
        "name of the data set, such as ms-highway/maxent-v0",
        required=True,
        metavar="NAME",
    ),
    option(
        "--density",
        "of the traffic, in turn",
        DENSITY_NAMES,
        nargs="+",
        choices=DENSITY_NAMES,
        metavar="DENSITY",
    ),
    option("--temperature", "of the driver maxent, in reward", TEMPERATURE, type=float),
    # The largest seed is that of JAX's random numbers.
    number("--seed", 0, "seed of the first episode", 0, 2**32 - 1),
)
def record(options: argparse.Namespace) -> None:
    r"""Record episodes of driving on a highway as a Minari data set.

    The environment is ms-highway/demonstration-v0. The data set is in
    $MINARI_DATASETS_PATH or ~/.minari/datasets.

    Every episode is on disk before the next begins; the same command continues a data
    set after its last episode. With --driver keyboard the arrow keys drive: up and down
    for speed, left and right to steer.

    Examples:
      ms-highway irl record --driver maxent --episodes 200 \
        --dataset ms-highway/maxent-v0
      ms-highway irl record --driver keyboard --episodes 10 --dataset ms-highway/me-v0 \
        --density sparse
    """
    from ms_highway.irl.demonstrations import record

    counts = record(
        options.driver,
        options.episodes,
        options.dataset,
        options.density,
        options.seed,
        options.temperature,
    )
    already = next(counts)
    done = count_episodes(counts, already, options.episodes)
    say(
        f"{options.dataset}: {done} episodes of {options.driver}, {done - already} of"
        " them new"
    )
