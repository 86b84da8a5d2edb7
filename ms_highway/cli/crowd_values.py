"""``ms-highway values learn`` in scenarios with several humans: values per human."""

import argparse
from typing import TYPE_CHECKING

from ms_highway.cli.console import telling
from ms_highway.cli.options import configuration

if TYPE_CHECKING:
    from ms_highway.experiments.values.crowd import CrowdCourse, CrowdLearning

DECIDED = 0.4  # of an episode, in which it is decided whether the robot merges; states are drawn from it
COSTS = {"naive": 0.002, "turn": 0.003, "tom": 0.0036}  # s, of a plan with this model for one human, on one core


def learn_crowd_values(options: argparse.Namespace) -> None:
    """Learn values per human with the options of ``ms-highway values learn``.

    Raises:
        ValueError: naming what cannot be learned.
    """
    from ms_highway.experiments.values.crowd import learn_crowd
    from ms_highway.experiments.values.learning import rollouts_file
    from ms_highway.metareasoning.crowd.values import save_crowd_values
    from ms_highway.simulation.devices import use_devices

    learning, courses = _courses(options)
    kept = rollouts_file(options.out)
    with telling() as tell:
        tell(f"{courses[0].name}: compiling")
        for done in learn_crowd(learning, courses, kept, use_devices(options.devices)):
            tell(f"round {done.round} of {learning.rounds}: {done.course or 'fitted'}")
            if done.values is not None:
                values = done.values
    save_crowd_values(values, options.out)
    kept.unlink(missing_ok=True)
    print(f"values per human are in {options.out}")


def _courses(options: argparse.Namespace) -> tuple["CrowdLearning", list["CrowdCourse"]]:
    """Return what is to be learned, and where."""
    from functools import partial
    from typing import cast

    import numpy as np

    from ms_highway.envs import ENVIRONMENTS, is_crowd
    from ms_highway.envs.crowd.settings import CrowdEnvSettings
    from ms_highway.experiments.comparison import episode_steps
    from ms_highway.experiments.provenance import this_run
    from ms_highway.experiments.values.crowd import CrowdCourse, CrowdLearning
    from ms_highway.game.crowd_scenario import CrowdScenario, draw_crowd
    from ms_highway.metareasoning.crowd.rule import CrowdCosts
    from ms_highway.planning.crowd import RUNGS

    names = list(dict.fromkeys(options.scenarios))
    if one := [name for name in names if not is_crowd(name)]:
        raise ValueError(f"{one[0]} has one human, other scenarios several; learn them in a file each")
    if options.generated or options.without or options.solvers:
        raise ValueError("--generated, --without and --solvers are for scenarios with one human")
    config = configuration(options)
    given = config.pop("costs", None)
    seconds = COSTS if isinstance(given, str) else {**COSTS, **(given or {})}
    courses = []
    for name in names:
        settings = CrowdEnvSettings.read(ENVIRONMENTS[name].checked_config(config))
        scenario = cast(CrowdScenario, ENVIRONMENTS[name].scenario)
        crowd = settings.crowd(scenario)
        draw = partial(draw_crowd, scenario, settings.humans, driver=crowd.game.human)
        courses.append(CrowdCourse(name, crowd, draw, round(DECIDED * episode_steps(name, config))))
    whole = seconds["naive"]
    given = {"rounds": options.rounds, "states": options.states, "horizon": options.horizon_steps}
    learning = CrowdLearning(
        CrowdCosts(whole, np.array([seconds[name] - whole for name in RUNGS], np.float32)),
        seed=options.seed,
        settings={**config, "scenarios": names, "seed": options.seed, "versions": this_run("")["versions"]},
        **{name: number for name, number in given.items() if number is not None},
    )
    return learning, courses
