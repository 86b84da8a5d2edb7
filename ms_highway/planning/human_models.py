"""Plan under each human model of the ladder: naive, turn and theory of mind.

Anything with the attributes of `HumanModel` is a model. All controls are scaled, see `ms_highway.game.game`.
"""

from dataclasses import dataclass
from functools import partial
from typing import ClassVar, NamedTuple, Protocol

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.game import Game, bounded, constant_velocity, discomfort, move, swap_players, trajectory_reward
from ms_highway.optimization.second_derivatives import response, second_order_expansion
from ms_highway.optimization.solvers import optimize_controls, projected_ascent

__all__ = [
    "MODELS",
    "PAPER_MODELS",
    "HumanModel",
    "JointPlan",
    "Naive",
    "TheoryOfMind",
    "Turn",
    "cold_start",
    "ladder",
    "plan_within_limits",
    "register",
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

    name: ClassVar[str]
    responds: ClassVar[bool]

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
    if type(model) in (Naive, Turn, TheoryOfMind):
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
    if not isinstance(model.name, str) or not model.name.isidentifier() or model.name in PAPER_MODELS:
        raise ValueError(
            f"a model cannot be called {model.name!r}; choose one word other than {', '.join(PAPER_MODELS)}"
        )
    others = {name: other for name, other in MODELS.items() if name != model.name}
    if before is not None and before not in others:
        raise ValueError(f"unknown human model {before!r} to come before; the models are {', '.join(others)}")
    place = len(others) if before is None else list(others).index(before)
    known = list(others.items())
    MODELS.clear()  # and not replaced: others hold it
    MODELS.update([*known[:place], (model.name, model), *known[place:]])


def ladder(names: tuple[str, ...] | list[str]) -> tuple[HumanModel, ...]:
    """Return the models of these names.

    Raises:
        ValueError: unless all are known, and each is named once, cheapest first; if there is none.
    """
    for name in names:
        if not isinstance(name, str) or name not in MODELS:
            raise ValueError(f"unknown human model {name!r}; the models are {', '.join(MODELS)}")
    order = list(MODELS)
    ranks = [order.index(name) for name in names]
    if not ranks or ranks != sorted(set(ranks)):
        raise ValueError(f"impossible ladder {list(names)}: name each model once, cheapest first, out of {order}")
    return tuple(MODELS[name] for name in names)
