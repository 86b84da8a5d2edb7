"""Define the commands that report, film, validate, search for orders, learn values."""

import argparse
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ms_highway.cli.console import (
    command,
    number,
    option,
    output,
    print_tables,
    record_run,
    save_figures,
    say,
    tell,
    telling_often,
    warn,
)
from ms_highway.cli.options import (
    CONTROLLER_NAMES,
    DEFAULT_CONTROLLER,
    DEVICES,
    MAX_FIRST_SEED,
    SCENARIO_ARGUMENT,
    SET,
    comparison_options,
    configuration,
    read_comparison,
)
from ms_highway.runtime.names import SCENARIO_NAMES

if TYPE_CHECKING:
    from pandas import DataFrame

    from ms_highway.experiments.batch import Batch
    from ms_highway.experiments.comparison import Comparison
    from ms_highway.experiments.frontier import Outcomes


@command(
    "report",
    "make a page of a comparison",
    option("directory", "of `ms-highway compare`", type=Path, metavar="DIR"),
    output(
        "--out",
        "an .html file (default: report.html in DIR), or a .tex file for the tables"
        " only",
        ".html",
        ".tex",
    ),
    option(
        "--videos",
        "film the best fixed model and a controller that chooses online (default);"
        ' needs the extra "video"',
        action=argparse.BooleanOptionalAction,
        default=True,
    ),
    option(
        "--film-own",
        "film also controllers that are not of this package: agents in files that DIR"
        " names, which can run any code when they are opened, and what --import adds",
        action="store_true",
    ),
)
def report(options: argparse.Namespace) -> None:
    """Make an HTML page of a directory of `ms-highway compare`.

    The page is a single file that needs no network. It begins with the answers in
    sentences. For each scenario, it has a table, a film of two controllers and figures;
    at its end are the settings, versions, machine and commands that made the results.

    Results of others are safe to open: without --film-own, no code runs that they name.
    With --out FILE.tex, only the tables are written, as LaTeX with booktabs.

    Examples:
      ms-highway report results/compare
      ms-highway report results/compare --out results.tex
      ms-highway report results/merger --no-videos --out merger.html
    """
    from ms_highway.envs.registry import of_package
    from ms_highway.experiments.summary import read_results
    from ms_highway.runtime.files import check_writable, replacing
    from ms_highway.visualization.html_page import latex_tables, page
    from ms_highway.visualization.video import check_format

    directory = options.directory
    out = options.out or directory / "report.html"
    check_writable(out)
    results = read_results(directory)
    if results.missing:
        remedy = "start the same `ms-highway compare` again, and it resumes"
        warn(f"{directory} lacks {results.missing} episodes; {remedy}")
    if out.suffix == ".tex":
        with replacing(out) as path:
            path.write_text(latex_tables(results), encoding="utf-8")
        say(f"the tables are in {out}")
        return
    if options.videos:
        try:
            check_format(Path("film.mp4"))
        except ImportError as error:
            raise ImportError(f"{error}, or add --no-videos") from error
    if options.videos and not options.film_own:
        controllers = dict.fromkeys(results.summaries["controller"])
        unseen = [name for name in controllers if not of_package(name)]
        if unseen:
            names = ", ".join(unseen)
            warn(
                f"films do not show {names}, which would run other code; add --film-own"
                " if you trust it"
            )
    text = page(results, options.videos, tell, options.film_own)
    with replacing(out) as path:
        path.write_text(text, encoding="utf-8")
    say(f"the page is {out}, {len(text) / 1e6:.1f} MB")


@command(
    "video",
    "film an episode",
    option("scenario", ", ".join(SCENARIO_NAMES), metavar="SCENARIO"),
    option("--controller", CONTROLLER_NAMES, DEFAULT_CONTROLLER, metavar="CONTROLLER"),
    option(
        "--against",
        "a second controller, filmed from the same start",
        metavar="CONTROLLER",
    ),
    number("--seed", 0, "of the episode", 0, MAX_FIRST_SEED),
    number("--speed", 1.0, "1 is true speed, 0.5 slow motion", 0.01, 100),
    number(
        "--width", None, "scale the video to this width", 160, 1280, metavar="PIXELS"
    ),
    output("--out", "an .mp4 or .gif file", ".mp4", ".gif", required=True),
    SET,
)
def video(options: argparse.Namespace) -> None:
    r"""Film one episode from above.

    The film shows the road, the robot's plan, the predicted path of the human, and a
    panel with the model in use, planning time and reward. The film plays at true speed.
    Among several humans, each has the colour of the model that predicts it, and the
    panel shows the number of humans per model, and the time and budget of the step.

    With --against, a second controller drives from the same start. The film shows both,
    one above the other, with name, mean reward per step and the time spent on planning
    and deciding so far.

    Examples:
      ms-highway video merger --seed 0 --out merger.mp4
      ms-highway video merger --controller tom --against learned:1 --width 640 \
        --out merger.gif
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
    option(
        "directory",
        "directory of reference files, SCENARIO__KIND.npz",
        type=Path,
        metavar="DIR",
    ),
    option("--json", "print JSON instead of a table", action="store_true"),
)
def validate(options: argparse.Namespace) -> None:
    """Replay logged episodes of the paper's released code.

    Plan from every logged state, and compare controls, rewards, human controls and
    switching decisions with the logs. The table has quantiles of the errors over all
    steps, in the units of the logs.

    Examples:
      ms-highway validate reference/episodes --json
    """
    from ms_highway.experiments.validation import validate
    from ms_highway.visualization.tables import grid

    result = validate(options.directory)
    if options.json:
        say(json.dumps(result, indent=2))
        return
    columns = {
        "robot's control": "action_error",
        "reward": "reward_error",
        "human's control": "human_error",
    }
    rows = []
    for name, errors in result["files"].items():
        row = {"file": name}
        for heading, kind in columns.items():
            row[heading] = " ".join(f"{value:.0e}" for value in errors[kind].values())
        # Only runs with switching have decisions.
        row["decisions"] = ""
        if "decisions" in errors:
            row["decisions"] = "{agree} of {all}".format(**errors["decisions"])
        rows.append(row)
    print_tables(grid("errors against the logs: median, 90 %, 99 %, largest", rows))


# Search and learning

FRONTIER_LAMBDAS = (
    *(0.0, 0.0001, 0.0003, 0.001, 0.003, 0.01, 0.02, 0.03, 0.05),
    *(0.1, 0.2, 0.3, 0.6, 1.0, 3.0, 10.0),
)
"""Lambdas with which ``ms-highway frontier`` compares controllers, by default."""


@command(
    "frontier",
    "search for the best orders of models",
    *comparison_options(
        30,
        "results/frontier",
        "(learned: at each of --prices), beside the ladder's models and switching",
        " ".join(map("{:g}".format, FRONTIER_LAMBDAS)),
    ),
    number(
        "--prices",
        [0.1, 1.0, 10.0],
        "lambdas of the meta-reward of orders and controllers: reward for a second of"
        " planning",
        0.0,
        1e6,
        nargs="+",
        metavar="PRICE",
    ),
    number("--population", 32, "orders per start, price and round"),
    number("--rounds", 8, "of the search, before starts try each other's best orders"),
    DEVICES,
    simulates=True,
)
def frontier(options: argparse.Namespace) -> None:
    r"""Search from each start for the order of models with the highest meta-reward.

    The meta-reward is the reward less PRICE times the seconds T(M) of planning. The
    best possible choice of models earns at least as much. The regret of a controller is
    this meta-reward minus its own. The search also tries the orders that switching and
    other --controllers chose.

    The tables show the regrets of the fixed models, of the best order for all starts,
    of other --controllers, and of switching and other controllers with a lambda at
    their best lambda. --prices are the lambdas of the meta-reward; --lambdas are those
    that switching decides with, and need not be a price. The best order and lambda are
    chosen on the same starts as they are judged by. Everything is simulated, and
    nothing is timed.

    Results go to --out: regrets.csv (a row per scenario, price and controller) and
    orders.csv (the best order of every start), both of the last run; the figure
    SCENARIO_frontier (reward against computation); SCENARIO_episodes.csv (all
    episodes); settings.json and provenance.json, which say how they were made. Episodes
    are kept after every round: the same command with the same --out resumes a search
    that was stopped or killed, and one with more seeds, prices, lambdas or rounds uses
    the episodes that are there. Results do not depend on the number of devices.

    Examples:
      ms-highway frontier
      ms-highway frontier merger --seeds 10 --prices 0.3 3 --out results/merger_frontier
      ms-highway frontier --prices 0.001 0.003 0.01 0.03 0.1 0.3 1 3 10 --rounds 16 \
        --out results/wide
      ms-highway frontier merger \
        --controllers schedule:tom=6,naive random:naive=0.7,tom=0.3 --out results/blind
    """
    import pandas as pd

    from ms_highway.experiments.batch import make_batch
    from ms_highway.experiments.directory import ResultsDirectory, write_table
    from ms_highway.experiments.frontier import Outcomes
    from ms_highway.runtime.compilation import use_devices
    from ms_highway.runtime.sources import late_sources
    from ms_highway.visualization.tables import regret_tables
    from ms_highway.visualization.tradeoff import frontier

    # Check the options before any computation and any file.
    options.lambdas = options.lambdas or [FRONTIER_LAMBDAS]
    comparison = read_comparison(options, ["switching"], options.prices)
    devices = use_devices(options.devices)
    out = options.out
    batches = {name: make_batch(comparison, name) for name in comparison.controllers}
    for batch in batches.values():
        _check_costs(batch)

    orders = pd.DataFrame()
    behind = pd.DataFrame()
    with ResultsDirectory(out).owned() as directory:
        settings = directory.take_up(comparison.common_config(), comparison.sources())
        every = {
            name: Outcomes(batch, out / f"{name}_episodes.csv", devices)
            for name, batch in batches.items()
        }
        directory.write_settings(settings)
        record_run(directory, options)

        def progress() -> str:
            """Say how many episodes are done in every scenario."""
            return ", ".join(
                f"{name}: {len(outcomes.table)} episodes"
                for name, outcomes in every.items()
            )

        with telling_often(progress):
            for scenario, outcomes in every.items():
                tell(f"{scenario}: compiling, and driving fixed models and controllers")
                outcomes.of(outcomes.batch.keys())
                directory.add_late_sources(settings, late_sources())
                _search(options, scenario, outcomes, comparison.seed_range)

                found, regrets = _judged(options.prices, comparison, scenario, outcomes)
                orders = pd.concat([orders, found])
                behind = pd.concat([behind, regrets])
                write_table(orders, out / "orders.csv")
                write_table(behind, out / "regrets.csv")
                draw = partial(frontier, behind, scenario, options.seeds)
                save_figures({f"{scenario}_frontier": draw}, out, options.format)
    for scenario in comparison.controllers:
        print_tables(*regret_tables(behind, scenario))
    say(f"results are in {out}")


def _search(
    options: argparse.Namespace,
    scenario: str,
    outcomes: "Outcomes",
    seeds: range,
) -> None:
    """Search for the best orders of a scenario, and tell of every round."""
    from ms_highway.experiments.frontier import search

    rounds = search(
        outcomes,
        seeds,
        options.prices,
        options.population,
        options.rounds,
    )
    for count in rounds:
        tell(
            f"{scenario}: round {count} of {options.rounds + 1} done,"
            f" {len(outcomes.table)} episodes"
        )


def _judged(
    prices: Sequence[float],
    comparison: "Comparison",
    scenario: str,
    outcomes: "Outcomes",
) -> "tuple[DataFrame, DataFrame]":
    """Return the best orders that were found at every price, and the regrets."""
    import pandas as pd

    from ms_highway.experiments.frontier import best, regrets

    orders = []
    behind = []
    for price in dict.fromkeys(prices):
        labels = {"scenario": scenario, "price": price}
        seeds = comparison.seed_range
        found = best(outcomes.table, seeds, price).reset_index()
        orders.append(found.assign(**labels))
        controllers = comparison.controllers[scenario]
        regret_rows = regrets(outcomes.table, controllers, seeds, price)
        behind.append(regret_rows.assign(**labels))
    return pd.concat(orders), pd.concat(behind)


def _check_costs(batch: "Batch") -> None:
    """Refuse to compute regrets without T(M) of a model.

    Raises:
        ValueError: naming a model whose seconds are not known.
    """
    for model in batch.models:
        if model not in batch.costs.seconds:
            scenario = batch.environment.scenario.name
            raise ValueError(
                f"T(M) of {model!r} in {scenario} is not known, but regrets need it;"
                " give its seconds by --set costs=MODEL=SECONDS,..., or leave it out"
            )


@command(
    "values learn",
    "learn values of computation: when it pays to think",
    SCENARIO_ARGUMENT,
    output("--out", "of the values, such as values.npz", ".npz", required=True),
    number(
        "--states",
        None,
        "states from which rollouts start in round 1 in each scenario; later rounds"
        " have 5 for every 8 (default: 400; among several humans 100 in every round)",
    ),
    number(
        "--rounds",
        None,
        "of rollouts and fits (default: 4; among several humans 2)",
        most=100,
    ),
    number(
        "--horizon-steps",
        None,
        "of a rollout (default: 20; among several humans 25)",
        most=100,
        metavar="STEPS",
        dest="horizon",
    ),
    number("--seed", 0, "of everything that is drawn", 0),
    SET,
    DEVICES,
    simulates=True,
)
def learn(options: argparse.Namespace) -> None:
    r"""Learn the value of computation in some scenarios.

    It serves the controller learned:LAMBDA:FILE. Rollouts start from states of
    episodes: for some steps, one model of the ladder predicts the human, and then the
    rule that was learned so far chooses. Networks are fitted to the reward that each
    model earns beyond the cheapest one, in several rounds. One file serves all lambdas
    and costs.

    Among several humans (dense-merge-v1, crossing-crowd-v1, dense_merge,
    crossing_crowd), each model predicts the nearest one, two, three and four humans;
    the value of a human is the reward that it adds. Such a file serves scenes with
    several humans.

    Starts are drawn anew, not by the numbered seeds of environments, so that
    `ms-highway frontier` can measure the regret of learned:LAMBDA:FILE on held-out
    starts. The same --seed gives the same values. Rollouts are kept beside the file
    until it is written: the same command continues a run that was stopped or killed.

    Examples:
      ms-highway values learn merger give_way --out values.npz
      ms-highway compare merger --controllers tom learned:1:values.npz
      ms-highway values learn dense-merge-v1 crossing-crowd-v1 --states 300 \
        --out crowd.npz
      ms-highway --import zipper values learn zipper --out zipper.npz
    """
    from shutil import rmtree

    from ms_highway.choice.learned_value import save_values
    from ms_highway.envs import PAPER_SCENARIOS
    from ms_highway.experiments.comparison import Comparison
    from ms_highway.experiments.learning import learn, prepare
    from ms_highway.runtime.compilation import use_devices

    # A controller that needs T(M) of all models, which learning needs, too.
    scenarios = options.scenarios or PAPER_SCENARIOS
    controllers = {name: ["switching:1"] for name in scenarios}
    comparison = Comparison(controllers, config=configuration(options))
    learning, batches = prepare(
        comparison, options.rounds, options.states, options.horizon, options.seed
    )
    values = None
    kept = options.out.with_name(f"{options.out.name}.rollouts")
    tell(f"{next(iter(comparison.controllers))}: compiling")
    for done, fitted in learn(learning, batches, kept, use_devices(options.devices)):
        tell(done)
        values = fitted or values
    if values is not None:
        save_values(values, options.out)
    rmtree(kept, ignore_errors=True)
    say(f"values are in {options.out}")
