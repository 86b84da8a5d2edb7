"""Plan under each human model of the ladder: naive, turn and theory of mind.

Anything with the attributes of `HumanModel` is a model. All controls are scaled, see `ms_highway.game.game`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from math import inf
from typing import ClassVar, NamedTuple, Protocol

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.game import Game, bounded, constant_velocity, discomfort, move, swap_players, trajectory_reward
from ms_highway.game.planning_settings import MOST_ITERATIONS
from ms_highway.optimization.second_derivatives import response, second_order_expansion
from ms_highway.optimization.solvers import optimize_controls, projected_ascent
from ms_highway.planning.effort import BEST, BEST_LADDER, Effort, base_of, parse

__all__ = [
    "MODELS",
    "PAPER_MODELS",
    "HumanModel",
    "JointPlan",
    "Naive",
    "TheoryOfMind",
    "Turn",
    "cold_start",
    "human_model",
    "is_model",
    "known_models",
    "ladder",
    "model_names",
    "plan_within_limits",
    "register",
    "rung_names",
]

State = Float[jax.Array, "cars 4"]
Controls = Float[jax.Array, "steps 2"]


class JointPlan(NamedTuple):
    """The robot's controls and the human controls that they expect.

    Scaled in models and starts: times ``game.planner.control_scale``, they are curvatures [1/m] and accelerations
    before friction [m/s^2], as `ms_highway.planning.compiled_plans.plan` returns them.
    """

    robot: Controls
    human: Controls


class HumanModel(Protocol):
    """A rung of the ladder.

    Attributes:
        name: in configurations and reports.
        responds: whether the human responds to the robot's plan.

    Models are hashable: a plan is compiled once per model.
    """

    @property
    def name(self) -> str:
        """Name in configurations and reports."""

    @property
    def responds(self) -> bool:
        """Whether the human responds to the robot's plan."""

    def __hash__(self) -> int: ...

    def predict(self, game: Game, state: State, start: JointPlan | None = None) -> Controls:
        """Predict the human's controls, scaled, see `JointPlan`."""

    def plan(self, game: Game, state: State, start: JointPlan | None = None) -> JointPlan:
        """Plan against this model of the human, improving ``start``, by default zero controls.

        Whoever executes the plan limits it, see `plan_within_limits`.
        """


@dataclass(frozen=True)
class Naive:
    """The human keeps its velocity."""

    name: ClassVar[str] = "naive"
    responds: ClassVar[bool] = False

    def predict(self, game: Game, state: State, start: JointPlan | None = None) -> Controls:
        """Return the controls that keep the human's speed and heading."""
        return constant_velocity(game, state[1])

    def plan(self, game: Game, state: State, start: JointPlan | None = None) -> JointPlan:
        """Optimise the robot's controls against that prediction."""
        return _plan_against(game, state, self.predict(game, state), start)


@dataclass(frozen=True)
class Turn:
    """The human optimises its own reward against a robot that keeps its velocity, whatever the robot plans."""

    name: ClassVar[str] = "turn"
    responds: ClassVar[bool] = False

    def predict(self, game: Game, state: State, start: JointPlan | None = None) -> Controls:
        """Return the human's plan against a robot that keeps its velocity."""
        return Naive().plan(*swap_players(game, state), start and JointPlan(start.human, start.robot)).robot

    def plan(self, game: Game, state: State, start: JointPlan | None = None) -> JointPlan:
        """Optimise the robot's controls against that prediction."""
        return _plan_against(game, state, self.predict(game, state, start), start)


@dataclass(frozen=True)
class TheoryOfMind:
    """The human responds optimally to the robot's plan, and the robot anticipates it.

    Both plans are improved together. With J = -(d2R_H/du_H2)^-1 d2R_H/du_H du_R at the current controls, the robot
    steps along ``dR_R/du_R + J^T dR_R/du_H`` and the human along ``dR_H/du_H``. J is never formed (adjoint method): one
    response of the human to ``dR_R/du_H`` and one derivative of ``dR_H/du_H`` along it give J^T dR_R/du_H. Always uses
    gradient steps, whatever the planner's solver: a joint ascent has no single objective for a line search.
    """

    name: ClassVar[str] = "tom"
    responds: ClassVar[bool] = True

    def predict(self, game: Game, state: State, start: JointPlan | None = None) -> Controls:
        """Return the human's side of the joint plan."""
        return self.plan(game, state, start).human

    def plan(self, game: Game, state: State, start: JointPlan | None = None) -> JointPlan:
        """Improve the robot's and the human's controls by a joint ascent."""
        mirrored, mirrored_state = swap_players(game, state)

        def direction(plan: JointPlan) -> JointPlan:
            robot, pull_robot = jax.vjp(partial(move, game, state[0]), plan.robot)
            human, pull_human = jax.vjp(partial(move, game, state[1]), plan.human)
            along_robot, along_human = jax.grad(trajectory_reward, argnums=(2, 3))(game, state, robot, human)
            earned = second_order_expansion(
                partial(move, game, state[1]),
                lambda human: trajectory_reward(mirrored, mirrored_state, human, robot),
                plan.human,
                partial(discomfort, mirrored, state[1]),
            )
            pushed = response(game.influence, earned.hessian, pull_human(along_human)[0].ravel())
            _, pull_back = jax.vjp(
                lambda robot: jax.grad(trajectory_reward, argnums=2)(mirrored, mirrored_state, human, robot), robot
            )
            through_human = pull_back(jnp.sum(earned.jacobian * pushed, axis=-1))[0]
            eased = pull_robot(along_robot + through_human)[0] - jax.grad(partial(discomfort, game, state[0]))(
                plan.robot
            )
            return JointPlan(eased, earned.gradient.reshape(plan.human.shape))

        def within_limits(plan: JointPlan) -> JointPlan:
            return JointPlan(bounded(game, state[0], plan.robot), bounded(game, state[1], plan.human))

        return projected_ascent(game.planner, direction, start or cold_start(game), within_limits)


def cold_start(game: Game) -> JointPlan:
    """Return the paper's initial plan: zero controls for both."""
    still = jnp.zeros((game.planner.horizon, 2))
    return JointPlan(still, still)


@jax.jit  # traced once for the human and the robot, naive and turn
def _plan_against(game: Game, state: State, human: Controls, start: JointPlan | None) -> JointPlan:
    """Optimise the robot's controls against fixed human controls."""
    expected = move(game, state[1], human)
    robot = optimize_controls(
        game.planner,
        partial(move, game, state[0]),
        lambda robot: trajectory_reward(game, state, robot, expected),
        partial(discomfort, game, state[0]),
        (start or cold_start(game)).robot,
        partial(bounded, game, state[0]),
    )
    return JointPlan(robot, human)


def plan_within_limits(model: HumanModel, game: Game, state: State, start: JointPlan | None = None) -> JointPlan:
    """Plan as may be executed: limit all finite controls, see `ms_highway.game.game.bounded`.

    The paper's models keep to the limits by themselves, and their plans are left as they are.
    """
    plan = JointPlan(*model.plan(game, state, start))
    if type(base_of(model)) in (Naive, Turn, TheoryOfMind):
        return plan
    sides = zip(plan, state[:2], strict=True)
    return JointPlan(*(jnp.where(jnp.isfinite(side), bounded(game, car, side), side) for side, car in sides))


MODELS: dict[str, HumanModel] = {model.name: model for model in (Naive(), Turn(), TheoryOfMind())}
"""Known models by name, cheapest first."""

PAPER_MODELS = ("naive", "turn", "tom")
"""Names of the paper's models, cheapest first."""


def register(model: HumanModel, before: str | None = None) -> None:
    """Register a human model by its name, for configurations and commands of this process.

    Args:
        model: hashable, with all attributes of a `HumanModel`; replaces a model of the same name.
        before: name of the next more expensive model on ladders; by default, the new model is the most expensive.

    Raises:
        ValueError: if the name is one of the paper's models or no word, or ``before`` names no other model; if the
            model lacks an attribute or is not hashable.
    """
    lacks = [part for part in ("name", "responds", "predict", "plan") if not hasattr(model, part)]
    if lacks:
        raise ValueError(f"{model!r} lacks {', '.join(lacks)}; see ms_highway.planning.human_models.HumanModel")
    try:
        hash(model)
    except TypeError as error:
        raise ValueError(f"{model!r} cannot be compiled for: {error}; make it a frozen dataclass") from None
    if not isinstance(model.name, str) or not model.name.isidentifier() or model.name in (*PAPER_MODELS, BEST):
        raise ValueError(
            f"a model cannot be called {model.name!r}; choose one word other than {', '.join((*PAPER_MODELS, BEST))}"
        )
    others = {name: other for name, other in MODELS.items() if name != model.name}
    if before is not None and before not in others:
        raise ValueError(f"unknown human model {before!r} to come before; the models are {', '.join(others)}")
    place = len(others) if before is None else list(others).index(before)
    known = list(others.items())
    MODELS.clear()  # and not replaced: others hold it
    MODELS.update([*known[:place], (model.name, model), *known[place:]])


def human_model(name: str) -> HumanModel:
    """Return the model of a name, with its effort if the name has one, such as ``tom@8+warm``.

    Raises:
        ValueError: if it is no model's name.
    """
    model = parse(name, MODELS)
    if model is None:
        raise ValueError(f"unknown human model {name!r}; the models are {model_names()}")
    return model


def is_model(name: object) -> bool:
    """Return whether a value is the name of a human model, with or without an effort."""
    return parse(name, MODELS) is not None


def model_names() -> str:
    """Return the names of all models, for messages."""
    return f"{', '.join(MODELS)}, also in 1 to {MOST_ITERATIONS} steps (tom@8) or from the last plan (tom@8+warm)"


def known_models(used: Iterable[str] = ()) -> list[str]:
    """Return the names of all known models and of the models in use, whose names may have an effort, cheapest first."""
    return sorted({*MODELS, *filter(is_model, used)}, key=lambda name: _rank(human_model(name)))


def _rank(model: HumanModel) -> tuple[int, float, bool]:
    """Return the place of a model among all: of its base, then of its number of steps, the planner's own last."""
    base, steps, warm = base_of(model), inf, False
    if isinstance(model, Effort):
        steps, warm = model.steps or inf, model.warm
    return list(MODELS).index(base.name), steps, warm


def rung_names(names: Sequence[str]) -> list[str]:
    """Return the names of a ladder's rungs, which ``best`` stands for as well."""
    return list(BEST_LADDER if names == BEST or list(names) == [BEST] else names)


def ladder(names: Sequence[str]) -> tuple[HumanModel, ...]:
    """Return the models of these names, or of `ms_highway.planning.effort.BEST_LADDER` by its name, ``best``.

    The order is that of the models, whatever their efforts, and of the numbers of steps of the same model, the
    planner's own last: costs, which differ between machines, do not matter.

    Raises:
        ValueError: unless all are known, and each is named once, cheapest first; if there is none.
    """
    rungs = tuple(human_model(name) for name in rung_names(names))
    ranks = [_rank(rung) for rung in rungs]
    if not ranks or ranks != sorted(set(ranks)):
        order = f"out of {list(MODELS)}, and of the same model fewer steps first"
        raise ValueError(f"impossible ladder {list(names)}: name each model once, cheapest first, {order}")
    return rungs
