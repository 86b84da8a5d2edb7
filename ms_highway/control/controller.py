"""Define controllers, the records of their steps, and what all controllers that plan have in common.

Controllers take and return float64 NumPy states and controls in SI units; car 0 is driven, car 1 is its partner. They
are the only stateful objects of the core.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from jaxtyping import Float

from ms_highway.control.fallback import PLANNED, STATUSES, Status, brake, fallback_status
from ms_highway.game.crowd import Crowd
from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.game import Game
from ms_highway.metareasoning.compiled_belief import CompiledBelief, counted_on
from ms_highway.planning.compiled_plans import CompiledPlans, checked_state
from ms_highway.planning.effort import starts_warm
from ms_highway.planning.human_models import HumanModel, JointPlan, Naive

__all__ = ["ControlStep", "Controller", "PlanningController"]


@dataclass(frozen=True)
class ControlStep:
    """Record of one step of a controller.

    Attributes:
        control: to execute now, ``(omega, acceleration)``.
        plan: controls over the horizon; fewer where only part of the last plan is left.
        human: the partner's controls that the plan expects.
        model: name of the human model that planned.
        planning_seconds: wall time of the plan, without compilation.
        decision_seconds: wall time of choosing the model, the belief included, without compilation; 0 without both.
        compile_seconds: wall time of compiling and warming up in this step.
        gains: estimated gain of switching to each model considered, by name.
        choice_failed: whether the model could not be chosen, so that the top of the ladder planned.
        status: whether the control is planned, see `ms_highway.control.fallback.Status`.
        belief: probability that each model of `ms_highway.planning.road.settings.RUNGS` predicts a human, for every
            human; None where it is not inferred.
    """

    control: Float[np.ndarray, "2"]
    plan: Float[np.ndarray, "steps 2"]
    human: Float[np.ndarray, "steps 2"]
    model: str
    planning_seconds: float
    decision_seconds: float = 0.0
    compile_seconds: float = 0.0
    gains: Mapping[str, float] = field(default_factory=dict)
    choice_failed: bool = False
    status: Status = "planned"
    belief: Float[np.ndarray, "humans models"] | None = None


class Controller(Protocol):
    """Drive car 0 of a game, one step at a time.

    Attributes:
        game: may be replaced between steps; a game of the same shapes compiles nothing.
    """

    game: Game

    def reset(self) -> None:
        """Forget the past, before a new episode."""

    def reset_partner(self) -> None:
        """Forget the partner: from now on, car 1 is another car."""

    def step(
        self, state: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None = None
    ) -> ControlStep:
        """Return the control of the coming step.

        Args:
            state: all cars now.
            before: all cars before the last step, in the present coordinates; needed where these have changed since.
        """


class PlanningController:
    """Plan with a human model; fall back where the plan is not finite; remember the last step.

    Args:
        game: of which car 0 is driven.
        warm_start: whether all plans start from the last one instead of from zero controls; those of rungs such as
            ``tom+warm`` always do.
        belief: whether to infer which model predicts the human, and to plan naively, instead of with a model that
            responds, while the human shows that it does not.
    """

    def __init__(self, game: Game, warm_start: bool, belief: bool = False) -> None:
        self.warm_start, self.infers = warm_start, belief
        self.game = game
        self.reset()

    @property
    def game(self) -> Game:
        """Game that is played; may be replaced between steps, and a game of the same shapes compiles nothing."""
        return self._game

    @game.setter
    def game(self, game: Game) -> None:
        self._game = game
        self._prepare(game)

    def _prepare(self, game: Game) -> None:
        """Prepare what is compiled for a game."""
        self._plans = CompiledPlans(game)
        if self.infers:
            self._inference = CompiledBelief(Crowd(game, np.asarray(game.human.weights)[None]))

    def reset(self) -> None:
        """Forget the last plan, and the human."""
        self._last: ControlStep | None = None
        self._before: Float[np.ndarray, "cars 4"] | None = None
        self._belief: Float[np.ndarray, "1 models"] | None = self._inference.first if self.infers else None

    def reset_partner(self) -> None:
        """Forget the partner and what the last plan expected of it."""
        self._last = self._last and replace(self._last, human=np.zeros_like(self._last.human))
        self._before = None
        self._belief = self._inference.first if self.infers else None

    def _infer(self, now: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None) -> float:
        """Update the belief by the last step; return the seconds spent."""
        last = self._before if before is None else checked_state(before)
        if self._belief is None or self._last is None or last is None:
            return 0.0
        steps = np.minimum(np.arange(self.game.planner.horizon), len(self._last.plan) - 1)
        robot = self._last.plan[steps] / np.asarray(self.game.planner.control_scale)
        self._belief, seconds = self._inference.update(self._belief, last, now, robot)
        return seconds

    def _warm_up_belief(self, now: Float[np.ndarray, "cars 4"]) -> float:
        """Compile what infers the belief; return the seconds spent."""
        still = np.zeros((self.game.planner.horizon, 2))
        return self._inference.warm_up(now, still) + self._plans.warm_up([Naive()], now) if self.infers else 0.0

    def _refuses(self, model: HumanModel) -> bool:
        """Return whether a model counts on a response that the human does not show."""
        return self._belief is not None and model.responds and not counted_on(self._belief)[0]

    def _plan(
        self, model: HumanModel, state: Float[np.ndarray, "cars 4"], single: Float[np.ndarray, "cars 4"]
    ) -> ControlStep:
        """Plan with a model in a state, also given as `ms_highway.planning.compiled_plans.checked_state`."""
        self._before = single
        start = self._warm_plan() if self.warm_start or starts_warm(model) else None
        plan, seconds = self._plans.plan(model, single, start)
        scale = np.asarray(self.game.planner.control_scale, dtype=float)
        robot, human = (np.asarray(side) * scale for side in plan)
        left = len(self._last.plan) if self._last is not None and self._last.status != "braking" else 0
        status, _ = fallback_status(bool(np.isfinite(robot).all() and np.isfinite(human).all()), left, len(robot))
        if self._last is not None and STATUSES[status] == "previous plan":
            robot, human = self._last.plan[1:], self._last.human[1:]
        elif status != PLANNED:
            robot = brake(self.game, state[0])
            human = np.tile(keep_velocity(self.game.dynamics, np.asarray(state, dtype=float)[1]), (len(robot), 1))
        return ControlStep(robot[0], robot, human, model.name, seconds, status=STATUSES[status], belief=self._belief)

    def _warm_plan(self) -> JointPlan | None:
        """Return the rest of the last finite plan, scaled, its last control repeated; None where nothing is left."""
        if self._last is None or self._last.status == "braking":
            return None
        rest = np.minimum(np.arange(1, self.game.planner.horizon + 1), len(self._last.plan) - 1)
        scale = np.asarray(self.game.planner.control_scale)
        return JointPlan(self._last.plan[rest] / scale, self._last.human[rest] / scale)
