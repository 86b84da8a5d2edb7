"""Define controllers, which drive a car one step at a time, and the records of their steps.

Controllers take and return float64 NumPy states and controls in SI units; car 0 is driven, the next ones are its
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
        models: name of the model that predicted every human in this plan.
        planning_seconds: wall time of the plan and of the check of its way out, without compilation.
        decision_seconds: wall time of choosing the models, the belief included, without compilation; 0 without both.
        compile_seconds: wall time of compiling and warming up in this step.
        ladder: names of the models that the choice is from.
        gains: estimated gain of each of them for every human, NaN where none was estimated, see
            `ms_highway.choice.rule.Decision`; with one human, none of the model that was in use.
        choice_failed: whether the models could not be chosen, see there.
        status: where the control comes from, see `ms_highway.loop.fallback.Status`.
        belief: probability that each of `ms_highway.planning.ladders.PACKAGE_MODELS` predicts a human, for every
            human; None where it is not inferred.
        planned: name of the model that predicted every human in the plan made in this step: not the same where that is
            late or failed.
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
        """Names of the models of the plan made in this step, which is paid for."""
        return self.planned or self.models

    def highest_gains(self) -> dict[str, float]:
        """Return the highest gain of each model over all humans, by name, as far as they were estimated."""
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

    def reset_partner(self) -> None:
        """Forget the partners: from now on, they are other cars."""

    def step(self, state: State, before: State | None = None) -> ControlStep:
        """Return the control of the coming step.

        Args:
            state: all cars now.
            before: all cars before the last step, in the present coordinates; needed where these have changed since.
        """
