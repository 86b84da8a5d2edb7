"""Replay of the reference episodes: does this implementation do what the paper's released code did?

A reference file SCENARIO__KIND.npz holds the logged run of one controller in paper units, with released semantics:
``states`` [episode, step, car, 4] before each step, ``robot_controls`` [episode, step, 2], ``human_controls`` [episode,
step - 1, 2], ``rewards`` [episode, step] after each step, ``models`` [episode, step] as indices into naive, turn, tom,
and ``ladder`` [rungs].
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.choice.quadratic import RELEASED_TRUST_TOLERANCE, Switching
from ms_highway.choice.rule import PUBLISHED_COSTS, Memory, Outcome, decide, first_memory
from ms_highway.game.features import reward
from ms_highway.game.game import Game, swap_roles
from ms_highway.game.scenario import build_game
from ms_highway.game.scenarios import GIVE_WAY, MERGER, STAY_BACK
from ms_highway.planning.compiled_plans import CompiledPlans, Costs
from ms_highway.planning.human_models import MODELS, PAPER_MODELS, HumanModel, Naive, ladder
from ms_highway.planning.plans import Plan
from ms_highway.runtime.arrays import Array, State
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.files import read_arrays, reading

SCENARIOS = {scenario.name: scenario for scenario in (STAY_BACK, MERGER, GIVE_WAY)}
QUANTILES = {"q50": 0.5, "q90": 0.9, "q99": 0.99, "max": 1.0}
SWITCHING = "switching_lambda_"
MOST_BYTES = 2**27  # of a file, unpacked
LARGEST = 1e38  # number, in single precision


def validate(directory: Path) -> dict[str, Any]:
    """Check every reference file of a directory: ``{"files": {NAME: ...}}``, see `validate_file`.

    Raises:
        FileNotFoundError: if there is no ``*.npz`` there.
        ValueError: for a file that is no reference file.
    """
    files = sorted(directory.glob("*.npz"))
    if not files:
        raise FileNotFoundError(f"no reference episodes (*.npz) in {directory}; name the directory that holds them")
    return {"files": {file.name: validate_file(file) for file in files}}


def validate_file(file: Path) -> dict[str, Any]:
    """Return the errors of one file, in the units of the logs, each as quantiles over all steps of all episodes.

    ``action_error``: largest component of planned minus logged robot control, planning from each logged state with the
    logged model; ``human_error``: the same of the human; ``reward_error``; and where the run was switching,
    ``decisions``: how many choices of the model agree, out of how many.

    Raises:
        ValueError: if the file is no reference file.
    """
    scenario, episodes = read_episodes(file)
    game = build_game(SCENARIOS[scenario], "released", unit=1.0)
    states, models = episodes["states"].astype(np.float32), episodes["models"]
    robot, human = episodes["robot_controls"], episodes["human_controls"]
    planned = np.empty(robot.shape)
    for index in np.unique(models):
        planned[models == index] = _first_controls(MODELS[PAPER_MODELS[index]], game, states[models == index])
    swapped = np.concatenate([states[:, :-1, 1::-1], states[:, :-1, 2:]], axis=2)
    answered = _first_controls(Naive(), swap_roles(game), swapped.reshape(-1, *states.shape[2:])).reshape(human.shape)
    rewards = np.asarray(_rewards(game.scene, game.robot, states[:, 1:]))
    report: dict[str, Any] = {
        "action_error": _quantiles(np.abs(planned - robot).max(axis=-1)),
        "reward_error": _quantiles(np.abs(rewards - episodes["rewards"][:, :-1])),
        "human_error": _quantiles(np.abs(answered - human).max(axis=-1)),
    }
    kind = file.stem.partition("__")[2]
    if kind.startswith(SWITCHING):
        report["decisions"] = _decisions(game, episodes, float(kind.removeprefix(SWITCHING)))
    return report


def read_episodes(file: Path) -> tuple[str, dict[str, Array]]:
    """Return scenario and arrays of a reference file, checked.

    Raises:
        ValueError: if the name, the arrays or their shapes are not those of a reference file.
    """
    scenario, _, kind = file.stem.partition("__")
    if scenario not in SCENARIOS or not re.fullmatch(rf"{'|'.join(PAPER_MODELS)}|{SWITCHING}\d+(\.\d+)?", kind):
        raise ValueError(
            f"{file}: the name should be SCENARIO__KIND.npz with a scenario of {', '.join(SCENARIOS)} "
            f"and a kind of {', '.join(PAPER_MODELS)} or {SWITCHING}NUMBER"
        )
    with reading(file, "name the logs that were released", " as a reference file"):
        arrays = read_arrays(file, MOST_BYTES)
        count, steps = np.maximum(arrays["rewards"].shape, (1, 2))
        cars, rungs = len(SCENARIOS[scenario].cars), arrays["ladder"]
        shapes = {
            "states": (count, steps, cars, 4),
            "robot_controls": (count, steps, 2),
            "human_controls": (count, steps - 1, 2),
            "rewards": (count, steps),
            "models": (count, steps),
            "ladder": (rungs.size,),
        }
        for name, shape in shapes.items():
            array = arrays[name]
            if array.dtype.kind not in "fiu" or array.shape != shape or not (np.abs(array) < LARGEST).all():
                found = f"{name} holds {array.dtype} of shape {array.shape}"
                raise ValueError(f"{found}; it must hold finite numbers of shape {tuple(map(int, shape))}")
        if not np.isin(rungs, range(len(PAPER_MODELS))).all() or not np.isin(arrays["models"], rungs).all():
            raise ValueError(f"its ladder {rungs.tolist()} or models are no places in {', '.join(PAPER_MODELS)}")
        return scenario, {name: arrays[name] for name in shapes}


_rewards = jit_quickly(reward)


def _first_controls(model: HumanModel, game: Game, states: State) -> Array:
    plans = CompiledPlans(game, (model,))
    return np.array([plans.plan(state, [0])[0].robot[0] for state in states])


def _decisions(game: Game, episodes: Mapping[str, Array], price: float) -> dict[str, int]:
    """Count the choices that agree with the logged ones, each taken from the logged step before it."""
    names = [PAPER_MODELS[index] for index in episodes["ladder"]]
    costs = Costs.of([PUBLISHED_COSTS[name] for name in names], 1)
    switching = Switching(costs, price, ladder(names), trust_tolerance=RELEASED_TRUST_TOLERANCE)
    logged = np.argmax(episodes["models"][..., None] == episodes["ladder"], axis=-1).astype(np.int32)
    happened = [episodes[name].astype(np.float32) for name in ("states", "robot_controls", "human_controls", "rewards")]
    before = [numbers[:, : logged.shape[1] - 1] for numbers in (logged, *happened)]
    chosen = np.array([_choices(switching, game, *run) for run in zip(*before, strict=True)])
    return {"agree": int(np.sum(chosen == logged[:, 1:])), "all": chosen.size}


@jit_quickly
def _choices(switching: Switching, game: Game, rungs: Any, *happened: Any) -> Array:
    """Return the rung that is chosen after each step, each of which was driven with the logged one."""

    def choose(memory: Memory, step: tuple[Array, ...]) -> tuple[Memory, Array]:
        rung, state, robot, human, earned = step
        plan = Plan(robot[None], human[None, None])  # not looked at
        outcome = Outcome(state, state, robot, human[None], earned, plan)
        memory = decide(switching, game, memory._replace(rungs=rung[None]), outcome).memory
        return memory._replace(step=memory.step + 1), memory.rungs[0]

    first = first_memory(switching, 1)._replace(step=jnp.int32(1))
    return jax.lax.scan(choose, first, (rungs, *happened))[1]


def _quantiles(errors: Array) -> dict[str, float]:
    return {name: float(np.quantile(errors, share)) for name, share in QUANTILES.items()}
