"""Drive with human models that were chosen beforehand: one for all steps, or a schedule."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ms_highway.control.controller import ControlStep, control_step, rest_of, with_stranger
from ms_highway.game.game import Game
from ms_highway.planning.compiled import CompiledPlans, checked_state
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.forks import refuse_after_fork

__all__ = ["FixedModel", "ScheduledModels"]


class FixedModel:
    """Plans every step with the same human model.

    Args:
        game: what is played; car 0 is driven.
        model: the human model that plans; it may be replaced between steps.
        ladder: the models that it may be replaced by, to be compiled before the first step.
        warm_start: whether plans start from the last one rather than from zero controls.
    """

    def __init__(
        self, game: Game, model: HumanModel, ladder: Sequence[HumanModel] = (), warm_start: bool = False
    ) -> None:
        self.model = model
        self.ladder = ladder
        self.warm_start = warm_start
        self.game = game
        self.reset()

    @property
    def game(self) -> Game:
        """What is played; it may change between steps, and one of the same shapes compiles nothing."""
        return self._game

    @game.setter
    def game(self, game: Game) -> None:
        self._game = game
        self._plans = CompiledPlans(game)

    def reset(self) -> None:
        """Forget the last plan."""
        self._last: ControlStep | None = None

    def meet(self) -> None:
        """Forget what the last plan expected of the partner."""
        self._last = with_stranger(self._last)

    def step(
        self, state: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None = None
    ) -> ControlStep:
        """Control for the coming step, whatever was before.

        Raises:
            ValueError: if the state is not a finite array [cars, 4] of two cars or more.
        """
        refuse_after_fork()
        now = checked_state(state)
        compiling = self._plans.warm_up([self.model] if self._last else [*self.ladder, self.model], now)
        start = rest_of(self.game, self._last) if self.warm_start else None
        plan, seconds = self._plans.plan(self.model, now, start)
        planned = control_step(self.game, self.model, plan, state, self._last)
        self._last = replace(planned, planning_seconds=seconds, compile_seconds=compiling)
        return self._last


class ScheduledModels:
    """Plans with human models in an order that was fixed beforehand, whatever happens.

    Args:
        game: what is played; car 0 is driven.
        models: one per step of the episode; the last one goes on.
        warm_start: whether plans start from the last one rather than from zero controls.

    Raises:
        ValueError: without a model.
    """

    def __init__(self, game: Game, models: Sequence[HumanModel], warm_start: bool = False) -> None:
        if not models:
            raise ValueError("a schedule needs one human model at least")
        self.models = tuple(models)
        self._driver = FixedModel(game, self.models[0], tuple(dict.fromkeys(self.models)), warm_start)
        self.reset()

    @property
    def game(self) -> Game:
        """What is played; it may change between steps, and one of the same shapes compiles nothing."""
        return self._driver.game

    @game.setter
    def game(self, game: Game) -> None:
        self._driver.game = game

    def reset(self) -> None:
        """Start the schedule again."""
        self._driver.reset()
        self._steps = 0

    def meet(self) -> None:
        """Forget what the last plan expected of the partner; the schedule goes on."""
        self._driver.meet()

    def step(
        self, state: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None = None
    ) -> ControlStep:
        """Control for the coming step, by the model whose turn it is.

        Raises:
            ValueError: if the state is not a finite array [cars, 4] of two cars or more.
        """
        self._driver.model = self.models[min(self._steps, len(self.models) - 1)]
        planned = self._driver.step(state)
        self._steps += 1
        return planned
