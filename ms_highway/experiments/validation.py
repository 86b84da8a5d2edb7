"""Replay the reference episodes, to check that this implementation does what the
paper's released code did.

A reference file SCENARIO__KIND.npz holds the logged run of one controller in paper
units, with released semantics: ``states`` [episode, step, car, 4] before each step,
``robot_controls`` [episode, step, 2], ``human_controls`` [episode, step - 1, 2],
``rewards`` [episode, step] after each step, ``models`` [episode, step] as indices into
naive, turn, tom, and ``ladder`` [rungs], indices likewise.
"""

from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.choice.quadratic import Quadratic, Switching
from ms_highway.choice.rule import (
    PUBLISHED_COSTS,
    GameEvidence,
    Memory,
    Outcome,
    Rule,
    decide,
    first_memory,
)
from ms_highway.game.features import reward
from ms_highway.game.game import Game, swap_roles
from ms_highway.game.scenario import Scenario, build_game
from ms_highway.game.scenarios import GIVE_WAY, MERGER, STAY_BACK
from ms_highway.planning.compiled_plans import CompiledPlans
from ms_highway.planning.costs import Costs
from ms_highway.planning.human_models import HumanModel, Naive
from ms_highway.planning.ladders import MODELS, PAPER_MODELS, ladder
from ms_highway.planning.plans import Plan
from ms_highway.runtime.arrays import Array, State
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.files import read_arrays, reading

SCENARIOS = {scenario.name: scenario for scenario in (STAY_BACK, MERGER, GIVE_WAY)}
ARRAYS = "states", "robot_controls", "human_controls", "rewards", "models", "ladder"
QUANTILES = {"q50": 0.5, "q90": 0.9, "q99": 0.99, "max": 1.0}
SWITCHING = "switching_lambda_"
MAX_BYTES = 2**27  # of an unpacked file
LARGEST = 1e38  # bound of numbers in single precision


def validate(directory: Path) -> dict:
    """Return the errors of all reference files of a directory: ``{"files": {NAME:
    ...}}``, see `validate_file`.

    Raises:
        FileNotFoundError: if there is no ``*.npz`` there.
        ValueError: for a file that is no reference file.
    """
    files = sorted(directory.glob("*.npz"))
    if not files:
        raise FileNotFoundError(
            f"no reference episodes (*.npz) in {directory}; name the directory that"
            " holds them"
        )
    return {"files": {file.name: validate_file(file) for file in files}}


def validate_file(file: Path) -> dict:
    """Return the errors of one file, in the units of the logs, each as quantiles over
    all steps of all episodes.

    ``action_error`` is the largest component of the planned robot control, less the
    logged one, in a plan from the logged state with the logged model; ``human_error``
    is the same for the human, and ``reward_error`` for the reward. Runs with switching
    also have ``decisions``: how many choices of the model agree, and how many there
    are.

    Raises:
        ValueError: if the file is no reference file.
    """
    scenario, episodes = read_episodes(file)
    game = build_game(scenario, "released", unit=1.0)
    states = episodes["states"].astype(np.float32)
    models = episodes["models"]
    robot = episodes["robot_controls"]
    human = episodes["human_controls"]
    planned = np.empty(robot.shape)
    for index in np.unique(models):
        planned[models == index] = _first_controls(
            MODELS[PAPER_MODELS[index]], game, states[models == index]
        )
    swapped = np.concatenate([states[:, :-1, 1::-1], states[:, :-1, 2:]], axis=2)
    answered = _first_controls(
        Naive(), swap_roles(game), swapped.reshape(-1, *states.shape[2:])
    ).reshape(human.shape)
    rewards = np.asarray(_rewards(game.scene, game.robot, states[:, 1:]))
    errors = {
        "action_error": np.abs(planned - robot).max(axis=-1),
        "reward_error": np.abs(rewards - episodes["rewards"][:, :-1]),
        "human_error": np.abs(answered - human).max(axis=-1),
    }
    report: dict = {
        name: {
            place: float(np.quantile(error, share))
            for place, share in QUANTILES.items()
        }
        for name, error in errors.items()
    }
    kind = file.stem.partition("__")[2]
    if kind.startswith(SWITCHING):
        report["decisions"] = _decisions(
            game, episodes, float(kind.removeprefix(SWITCHING))
        )
    return report


def read_episodes(file: Path) -> tuple[Scenario, dict[str, np.ndarray]]:
    """Read and check a reference file; return its scenario and its arrays.

    Raises:
        ValueError: if the file cannot be read, or its name or numbers are not those of
            a reference file.
    """
    with reading(
        file,
        "name the logs that were released, SCENARIO__KIND.npz",
        " as a reference file",
    ):
        arrays = read_arrays(file, MAX_BYTES)
        episodes = {name: arrays[name] for name in ARRAYS}
        for name, array in episodes.items():
            if not (np.abs(array) < LARGEST).all():
                raise ValueError(f"{name} holds numbers that are not finite")
        if (
            len(
                {
                    episodes[name].shape[:2]
                    for name in ("states", "robot_controls", "rewards", "models")
                }
            )
            > 1
        ):
            raise ValueError("its arrays have different numbers of episodes or steps")
        if not np.isin(episodes["models"], episodes["ladder"]).all() or max(
            episodes["ladder"]
        ) >= len(PAPER_MODELS):
            raise ValueError(
                f"its models are not indices into {', '.join(PAPER_MODELS)}"
            )
        return SCENARIOS[file.stem.partition("__")[0]], episodes


_rewards = jit_quickly(reward)


def _first_controls(model: HumanModel, game: Game, states: State) -> Array:
    plans = CompiledPlans(game, (model,))
    return np.array([plans.plan(state, [0])[0].plan.robot[0] for state in states])


def _decisions(
    game: Game, episodes: dict[str, np.ndarray], price: float
) -> dict[str, int]:
    """Count the choices that agree with the logged ones; each is made after the logged
    step before it.
    """
    names = [PAPER_MODELS[index] for index in episodes["ladder"]]
    costs = Costs.of({name: PUBLISHED_COSTS[name] for name in names}, 1)
    switching = Switching(
        costs, price, ladder(names), trust_tolerance=Quadratic.released_tolerance
    )
    logged = np.argmax(
        episodes["models"][..., None] == episodes["ladder"], axis=-1
    ).astype(np.int32)
    happened = [
        episodes[name].astype(np.float32)
        for name in ("states", "robot_controls", "human_controls", "rewards")
    ]
    before = [numbers[:, : logged.shape[1] - 1] for numbers in (logged, *happened)]
    chosen = np.array(
        [_choices(switching, game, *run) for run in zip(*before, strict=True)]
    )
    return {"agree": int(np.sum(chosen == logged[:, 1:])), "all": chosen.size}


@jit_quickly
def _choices(
    switching: Rule[GameEvidence], game: Game, rungs: Any, *happened: Any
) -> Array:
    """Return the rung that is chosen after each step; each step was driven with the
    logged rung.
    """

    def choose(memory: Memory, step: tuple) -> tuple[Memory, Array]:
        rung, state, robot, human, earned = step
        plan = Plan(robot[None], human[None, None])  # not used
        outcome = Outcome(state, state, robot, human[None], earned, plan)
        memory = decide(
            switching, game, memory._replace(rungs=rung[None]), outcome
        ).memory
        return memory._replace(step=memory.step + 1), memory.rungs[0]

    first = first_memory(switching, 1)._replace(step=jnp.int32(1))
    return jax.lax.scan(choose, first, (rungs, *happened))[1]
