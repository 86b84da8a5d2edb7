"""Define controllers, which drive a car one step at a time, and the records of their steps.

Controllers take and return float64 NumPy states and controls in SI units. They drive car 0; the next cars are its
partners.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ms_highway.choice.rule import highest_gains
from ms_highway.game.game import Game
from ms_highway.loop.fallback import Status
from ms_highway.planning.ladders import cheapest_first
from ms_highway.runtime.arrays import Belief, Control, Controls, Gains, HumansControls, State


@dataclass(frozen=True)
class ControlStep:
    """Record of one step of a controller.

    Attributes:
        control: to execute now, ``(omega, acceleration)``.
        plan: controls over the horizon; fewer where only part of the last plan is left.
        humans: controls that the plan expects of every human.
        models: for every human, the name of the model that predicted it in this plan.
        planning_seconds: wall time of the plan and of the check of its way out, without compilation.
        decision_seconds: wall time of choosing the models, with the belief, without compilation; 0 if nothing is chosen
            or inferred.
        compile_seconds: wall time of compiling and warming up in this step.
        ladder: names of the models to choose from.
        gains: estimated gain of each of them for every human, NaN where none was estimated, see
            `ms_highway.choice.rule.Decision`; with one human, NaN for the model in use.
        choice_failed: whether the rule failed to choose, see there.
        status: where the control comes from, see `ms_highway.loop.fallback.Status`.
        belief: for every human, the probability that each of `ms_highway.planning.ladders.PACKAGE_MODELS` predicts it;
            None where it is not inferred.
        planned: for every human, the name of its model in the plan of this step, which is not ``plan`` if it is late or
            failed.
    """

    control: Control
    plan: Controls
    humans: HumansControls
    models: tuple[str, ...]
    planning_seconds: float = 0.0
    decision_seconds: float = 0.0
    compile_seconds: float = 0.0
    ladder: tuple[str, ...] = ()
    gains: Gains | None = None
    choice_failed: bool = False
    status: Status = "planned"
    belief: Belief | None = None
    planned: tuple[str, ...] = ()

    @property
    def model(self) -> str:
        """Name of the most expensive model in use."""
        return ("", *cheapest_first(self.models))[-1] if self.models[1:] else self.models[0]

    @property
    def thought(self) -> tuple[str, ...]:
        """Names of the models in the plan of this step, whose time is counted."""
        return self.planned or self.models

    def highest_gains(self) -> dict[str, float]:
        """Return the highest estimated gain of each model over all humans, by name."""
        if self.gains is None:
            return {}
        gains = zip(self.ladder, highest_gains(self.gains).tolist(), strict=True)
        return {name: gain for name, gain in gains if np.isfinite(gain)}


class Controller(Protocol):
    """Drive car 0 of a game, one step at a time.

    Attributes:
        game: may be replaced between steps; a game of the same shapes compiles nothing.
    """

    game: Game

    def reset(self) -> None:
        """Forget the past, before a new episode."""

    def step(self, state: State) -> ControlStep:
        """Return the control of the coming step, from the states of all cars now."""
