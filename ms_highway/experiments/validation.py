"""Replay the reference episodes, which the paper's released code drove.

They check that this implementation does the same. A reference file SCENARIO__KIND.npz
holds the logged run of one controller in paper units, with released semantics:
``states`` [episode, step, car, 4] before each step, ``robot_controls`` [episode, step,
2], ``human_controls`` [episode, step - 1, 2], ``rewards`` [episode, step] after each
step, ``models`` [episode, step] as indices into naive, turn, tom, and ``ladder``
[rungs], indices likewise.
"""

from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

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
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.files import read_arrays, reading


@dataclass(frozen=True)
class ReferenceFormat:
    """Describe reference files."""

    per_step: tuple[str, ...] = ("states", "robot_controls", "rewards", "models")
    """Arrays with the axes episode and step."""
    others: tuple[str, ...] = ("human_controls", "ladder")
    """The other arrays."""
    switching: str = "switching_lambda_"
    """How the kind of a run with switching begins, before its lambda."""
    max_bytes: int = 2**27
    """Largest size of an unpacked file."""
    bound: float = 1e38
    """Bound of all numbers, which fit into single precision."""


REFERENCE = ReferenceFormat()


def validate(directory: Path) -> dict:
    """Return the errors of all reference files of a directory.

    They are ``{"files": {NAME: ...}}``, see `validate_file`.

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
    """Return the errors of one file, in the units of the logs.

    Each error is given by quantiles over all steps of all episodes.

    ``action_error`` is the largest component of the planned robot control, less the
    logged one, in a plan from the logged state with the logged model; ``human_error``
    is the same for the human, and ``reward_error`` for the reward. Runs with switching
    also have ``decisions``: how many choices of the model agree, and how many there
    are.

    Raises:
        ValueError: if the file is no reference file.
    """
    scenario, episodes = read_reference(file)
    game = build_game(scenario, "released", unit=1.0)
    states = episodes["states"].astype(np.float32)  # [episodes, steps, cars, 4]

    # Controls of the robot and of the human, planned less logged: [..., 2].
    robot_plans = _robot_plans(game, states, episodes["models"])
    robot_differences = robot_plans - episodes["robot_controls"]
    human_plans = _human_plans(game, states[:, :-1])
    human_differences = human_plans - episodes["human_controls"]

    # Rewards are logged after each step; the last state after a step is not logged.
    rewards = np.asarray(_rewards(game.scene, game.robot, states[:, 1:]))
    reward_differences = rewards - episodes["rewards"][:, :-1]

    errors = {
        "action_error": np.abs(robot_differences).max(axis=-1),
        "reward_error": np.abs(reward_differences),
        "human_error": np.abs(human_differences).max(axis=-1),
    }
    report: dict = {name: _quantiles(error) for name, error in errors.items()}
    kind = file.stem.partition("__")[2]
    if kind.startswith(REFERENCE.switching):
        price = float(kind.removeprefix(REFERENCE.switching))
        report["decisions"] = _decisions(game, episodes, price)
    return report


def _robot_plans(
    game: Game,
    states: Float[np.ndarray, "episodes steps cars 4"],
    models: Int[np.ndarray, "episodes steps"],
) -> Float[np.ndarray, "episodes steps 2"]:
    """Return the first controls of the robot's plans with the logged models."""
    planned = np.empty((*models.shape, 2))
    for index in np.unique(models):
        model = MODELS[PAPER_MODELS[index]]
        chosen = models == index
        planned[chosen] = _first_controls(model, game, states[chosen])
    return planned


def _human_plans(
    game: Game,
    states: Float[np.ndarray, "episodes steps cars 4"],
) -> Float[np.ndarray, "episodes steps 2"]:
    """Return the first controls of the human's plans.

    The human plans as a robot that predicts the other car naively.
    """
    human_first = states[:, :, 1::-1]
    others = states[:, :, 2:]
    swapped = np.concatenate([human_first, others], axis=2)
    in_a_row = swapped.reshape(-1, *states.shape[2:])
    planned = _first_controls(Naive(), swap_roles(game), in_a_row)
    return planned.reshape(*states.shape[:2], 2)


def _quantiles(errors: Float[np.ndarray, "*steps"]) -> dict[str, float]:
    """Return quantiles of errors by name."""
    probabilities = {"q50": 0.5, "q90": 0.9, "q99": 0.99, "max": 1.0}
    return {
        name: float(np.quantile(errors, probability))
        for name, probability in probabilities.items()
    }


def read_reference(file: Path) -> tuple[Scenario, dict[str, np.ndarray]]:
    """Read and check a reference file; return its scenario and its arrays.

    Raises:
        ValueError: if the file cannot be read, or its name or numbers are not those of
            a reference file.
    """
    scenarios = {scenario.name: scenario for scenario in (STAY_BACK, MERGER, GIVE_WAY)}
    remedy = "name the logs that were released, SCENARIO__KIND.npz"
    with reading(file, remedy, " as a reference file"):
        arrays = read_arrays(file, REFERENCE.max_bytes)
        names = (*REFERENCE.per_step, *REFERENCE.others)
        episodes = {name: arrays[name] for name in names}
        _check_episodes(episodes)
        scenario, _, _ = file.stem.partition("__")
        return scenarios[scenario], episodes


def _check_episodes(episodes: dict[str, np.ndarray]) -> None:
    """Check the arrays of a reference file.

    Raises:
        ValueError: naming what is wrong.
    """
    for name, array in episodes.items():
        if not (np.abs(array) < REFERENCE.bound).all():
            raise ValueError(f"{name} holds numbers that are not finite")
    lengths = {episodes[name].shape[:2] for name in REFERENCE.per_step}
    if len(lengths) > 1:
        raise ValueError("its arrays have different numbers of episodes or steps")
    ladder = episodes["ladder"]
    on_ladder = np.isin(episodes["models"], ladder).all()
    if not on_ladder or max(ladder) >= len(PAPER_MODELS):
        raise ValueError(f"its models are not indices into {', '.join(PAPER_MODELS)}")


_rewards = jit_quickly(reward)


def _first_controls(
    model: HumanModel,
    game: Game,
    states: Float[np.ndarray, "states cars 4"],
) -> Float[np.ndarray, "states 2"]:
    """Return the first control of the robot's plan from each state."""
    plans = CompiledPlans(game, (model,))
    controls = []
    for state in states:
        result, _ = plans.plan(state, [0])
        controls.append(result.plan.robot[0])
    return np.array(controls)


def _decisions(
    game: Game,
    episodes: dict[str, np.ndarray],
    price: float,
) -> dict[str, int]:
    """Count the choices that agree with the logged ones.

    Each choice is made after the logged step before it.
    """
    names = [PAPER_MODELS[index] for index in episodes["ladder"]]
    seconds = {name: PUBLISHED_COSTS[name] for name in names}
    switching = Switching(
        Costs.of(seconds, humans=1),
        price,
        ladder(names),
        trust_tolerance=Quadratic.released_tolerance,
    )

    # The rung of each logged model, and what happened in each step.
    on_rung = episodes["models"][..., None] == episodes["ladder"]
    logged = np.argmax(on_rung, axis=-1).astype(np.int32)  # [episodes, steps]
    columns = [logged]
    for name in ("states", "robot_controls", "human_controls", "rewards"):
        columns.append(episodes[name].astype(np.float32))

    # No choice follows the last step.
    choices = logged.shape[1] - 1
    before_choices = [column[:, :choices] for column in columns]
    chosen = []
    for run in zip(*before_choices, strict=True):
        chosen.append(_choices(switching, game, *run))
    agree = np.array(chosen) == logged[:, 1:]
    return {"agree": int(np.sum(agree)), "all": agree.size}


@jit_quickly
def _choices(
    switching: Rule[GameEvidence],
    game: Game,
    rungs: Int[Array, "steps"],
    *happened: Float[Array, "steps ..."],
) -> Int[Array, "steps"]:
    """Return the rung that is chosen after each step.

    Each step was driven with the logged rung.
    """

    def choose(memory: Memory, step: tuple) -> tuple[Memory, Array]:
        rung, state, robot, human, earned = step
        # Switching does not use the plan.
        plan = Plan(robot[None], human[None, None])
        outcome = Outcome(state, state, robot, human[None], earned, plan)
        logged = memory._replace(rungs=rung[None])
        memory = decide(switching, game, logged, outcome).memory
        return memory._replace(step=memory.step + 1), memory.rungs[0]

    first = first_memory(switching, 1)._replace(step=jnp.int32(1))
    _, chosen = jax.lax.scan(choose, first, (rungs, *happened))
    return chosen
