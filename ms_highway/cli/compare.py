"""The command ``ms-highway compare``."""

import argparse
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

from ms_highway.cli.command import command
from ms_highway.cli.console import count_episodes, print_tables, say, warn
from ms_highway.cli.options import FORMATS, LEARNED, compared, comparison

if TYPE_CHECKING:
    from ms_highway.experiments.comparison import Comparison


@command(
    "compare",
    "compare controllers over many episodes",
    *compared(30, "results/compare", f"(default: all models of the ladder, {LEARNED}, and switching)"),
)
def compare(options: argparse.Namespace) -> None:
    """Run the same seeded episodes with several controllers and compare reward and computation.

    A controller is a human model that plans every step (naive, turn, tom); or learned:LAMBDA, which chooses the model
    at every step by a learned value of computation, at a price of LAMBDA reward for a second of planning
    (learned:LAMBDA:FILE with values of `ms-highway values learn`); or switching:LAMBDA, which chooses by the paper's
    Algorithm 1, or horizon:LAMBDA, by gains that are estimated over the whole plan instead of one step; or
    schedule:MODEL=STEPS,...,MODEL, an order that is fixed beforehand, such as schedule:tom=6,naive; or
    period:MODEL=STEPS,..., an order that is repeated, such as period:tom=1,naive=3; or random:MODEL=SHARE,..., a model
    drawn for every step, such as random:naive=0.7,tom=0.3: a choice that looks at nothing, which others have to beat.
    Without scenarios and controllers, the paper's comparison runs: its three scenarios, each with its ladder and the
    paper's two lambdas, and learned:1 beside them. stay-back-v1, merger-v1 and give-way-v1 are the same scenes within
    what tyres hold.

    In dense-merge-v1, dense_merge and crossing_crowd, a controller chooses a model for each of several humans. A
    model's name stands for all humans; nearest:K predicts the K nearest humans by tom, and the others naively;
    budget:MILLISECONDS chooses what is worth most within this time of planning and deciding per step.

    Any controller with +belief at the end, such as tom+belief, infers from what each human does whether it is predicted
    by naive, idm, turn or tom, and plans naively where a model would count on a response that the human does not show.

    Episodes run on two cores where there are two. Results go to --out: steps.csv (a row per step; until all episodes
    have ended, each is a file in parts), summary.csv, and per scenario the figures SCENARIO_bars (of three lambdas or
    more _curve, reward against computation), _timeline and _decisions; settings.json and provenance.json say what they
    were made with. If stopped and started again with the same --out, it resumes; with
    more controllers or scenarios, it adds them. `ms-highway report` makes a page of them.

    Examples:
      ms-highway compare
      ms-highway compare merger-v1 give-way-v1 stay-back-v1 --out results/physical
      ms-highway compare merger --controllers naive tom learned:1 switching:0.1 --seeds 10 --out results/merger
      ms-highway compare merger --controllers tom switching schedule:tom={4,6,8},naive --lambdas 0.01:1:9 --out out
      ms-highway compare merger --set ladder=naive,tom --controllers switching:0.1 --out results/two_rungs
      ms-highway compare give_way --set semantics=released --set costs=measured --out results/measured
      ms-highway compare stay_back --controllers naive turn --set solver=newton --seeds 100 --out results/newton
      ms-highway compare --seeds 300 --set control_limit=0.2,9 --out results/what_tyres_hold
      ms-highway compare dense_merge --controllers naive tom nearest:1 budget:20 --out results/dense_merge
      ms-highway compare merger --set yielding=never --controllers tom tom+belief --out results/never
    """
    from ms_highway.cli.results_directory import own_results, save_figure, write_table
    from ms_highway.experiments.analysis.summary import summary
    from ms_highway.experiments.results import read_results
    from ms_highway.experiments.runner import only, run
    from ms_highway.visualization.comparison import table
    from ms_highway.visualization.figures import CAPTIONS, figures

    asked = comparison(options)
    if not options.controllers:
        asked = _with_learned(asked)
    with own_results(options) as record:
        counts, wanted = run(asked, options.out, 2, options.modules), len(list(asked.episodes()))
        already = next(counts)
        if already < wanted:
            record()
        count_episodes(counts, already, wanted)
        results = read_results(options.out)  # of this command and of those before
        own = summary(only(asked, results.records))
        print_tables(*(table(own, scenario) for scenario in asked.controllers))
        write_table(results.summaries, options.out / "summary.csv")
        for scenario in asked.controllers:
            found = figures(results.records, results.summaries, scenario)
            for name, kind in product(CAPTIONS, FORMATS):
                file = options.out / f"{scenario}_{name}.{kind}"
                if name not in found or not results.is_current(file):
                    file.unlink(missing_ok=True)
            for name, draw in found.items():
                save_figure(draw(), options.out / f"{scenario}_{name}.{options.format}")
    say(f"results are in {options.out}")


def _with_learned(asked: "Comparison") -> "Comparison":
    """Return a comparison with learned values, before switching, where they suit the ladder."""
    controllers = {}
    for scenario, names in asked.controllers.items():
        place = next((place for place, name in enumerate(names) if name.startswith("switching")), len(names))
        controllers[scenario] = [*names[:place], LEARNED, *names[place:]]
        try:
            asked.environment_config(scenario, LEARNED)
        except ValueError as error:
            reason = str(error).partition("; ")[0]
            warn(f"{scenario} is compared without {LEARNED}: {reason}")
            controllers[scenario] = list(names)
    return replace(asked, controllers=controllers)
