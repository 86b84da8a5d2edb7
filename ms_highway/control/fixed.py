"""Drive with human models that are chosen beforehand: one for all steps, or a schedule."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ms_highway.control.controller import ControlStep, PlanningController
from ms_highway.game.game import Game
from ms_highway.planning.compiled_plans import checked_state
from ms_highway.planning.human_models import HumanModel, Naive
from ms_highway.runtime.forks import refuse_after_fork

__all__ = ["FixedModel", "ScheduledModels"]


class FixedModel(PlanningController):
    """Plan every step with the same human model.

    Args:
        game: of which car 0 is driven.
        model: human model that plans; may be replaced between steps.
        ladder: models that may replace it, compiled before the first step.
        warm_start: whether plans start from the last one instead of from zero controls.
        belief: see `ms_highway.control.controller.PlanningController`.
    """

    def __init__(
        self,
        game: Game,
        model: HumanModel,
        ladder: Sequence[HumanModel] = (),
        warm_start: bool = False,
        belief: bool = False,
    ) -> None:
        self.model = model
        self.ladder = ladder
        super().__init__(game, warm_start, belief)

    def step(
        self, state: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None = None
    ) -> ControlStep:
        """Return the control of the coming step; ``before`` matters to the belief only.

        Raises:
            ValueError: if the state is not a finite array [cars, 4] of two cars or more.
        """
        refuse_after_fork()
        single = checked_state(state)
        compiling = self._plans.warm_up([self.model] if self._last else [*self.ladder, self.model], single)
        compiling += 0.0 if self._last else self._warm_up_belief(single)
        inferring = self._infer(single, before)
        planned = self._plan(Naive() if self._refuses(self.model) else self.model, state, single)
        self._last = replace(planned, decision_seconds=inferring, compile_seconds=compiling)
        return self._last


class ScheduledModels(FixedModel):
    """Plan with human models in a given order.

    Args:
        game: of which car 0 is driven.
        models: one per step of the episode; the last one stays.
        warm_start: whether plans start from the last one instead of from zero controls.
        belief: see `ms_highway.control.controller.PlanningController`.

    Raises:
        ValueError: without a model.
    """

    def __init__(
        self, game: Game, models: Sequence[HumanModel], warm_start: bool = False, belief: bool = False
    ) -> None:
        if not models:
            raise ValueError("a schedule needs one human model at least")
        self.models = tuple(models)
        super().__init__(game, self.models[0], tuple(dict.fromkeys(self.models)), warm_start, belief)

    def reset(self) -> None:
        """Start the schedule again."""
        super().reset()
        self._steps = 0

    def step(
        self, state: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None = None
    ) -> ControlStep:
        """Return the control of the coming step, planned with the model that is scheduled for it.

        Raises:
            ValueError: if the state is not a finite array [cars, 4] of two cars or more.
        """
        self.model = self.models[min(self._steps, len(self.models) - 1)]
        planned = super().step(state, before)
        self._steps += 1
        return planned
