"""Drive with the human model that Algorithm 1 finds worth its time."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ms_highway.control.controller import ControlStep, control_step, rest_of, with_stranger
from ms_highway.game.game import Game
from ms_highway.metareasoning.compiled import CompiledDecision, Observation
from ms_highway.metareasoning.switching import Switching, check_costs, first_memory
from ms_highway.planning.compiled import CompiledPlans, checked_state
from ms_highway.runtime.forks import refuse_after_fork

__all__ = ["ModelSwitching"]


class ModelSwitching:
    """Plans every step with the human model that Algorithm 1 finds worth its time.

    Args:
        game: what is played; car 0 is driven.
        switching: ladder, costs, lambda and the numbers of the algorithm.
        warm_start: whether plans start from the last one rather than from zero controls.

    Raises:
        ValueError: if there is not one cost for each rung of the ladder.
    """

    def __init__(self, game: Game, switching: Switching, warm_start: bool = False) -> None:
        check_costs(switching)
        self.switching = switching
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
        self._plans, self._decision = CompiledPlans(game), CompiledDecision(self.switching, game)
        self._warm = False

    def reset(self) -> None:
        """Start again at the bottom of the ladder."""
        self._memory = first_memory(self.switching)
        self._last: ControlStep | None = None
        self._before: Float[np.ndarray, "cars 4"] | None = None

    def meet(self) -> None:
        """Start again at the bottom of the ladder; how the last step went tells nothing of another partner."""
        self._memory = first_memory(self.switching)
        self._last, self._before = with_stranger(self._last), None

    def step(
        self, state: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None = None
    ) -> ControlStep:
        """Control for the coming step, after choosing the model from how the last step went.

        Args:
            state: all cars now.
            before: all cars before the last step, in the coordinates of now, where these have changed since.

        Raises:
            ValueError: if a state is not a finite array [cars, 4] of two cars or more.
        """
        refuse_after_fork()
        now = checked_state(state)
        compiling, deciding, gains = self._warm_up(now), 0.0, dict[str, float]()
        if self._last is not None and self._before is not None:
            before = self._before if before is None else checked_state(before)
            deciding, gains = self._choose(before, self._last.control, now)
        model = self.switching.ladder[int(self._memory.rung)]
        plan, planning = self._plans.plan(model, now, rest_of(self.game, self._last) if self.warm_start else None)
        record = control_step(self.game, model, plan, state, self._last)
        self._before = now
        self._last = replace(
            record, planning_seconds=planning, decision_seconds=deciding, compile_seconds=compiling, gains=gains
        )
        return self._last

    def _warm_up(self, state: Float[np.ndarray, "cars 4"]) -> float:
        """Compile every rung and the decision before the first control of a game is due; seconds spent."""
        if self._warm:
            return 0.0
        self._warm = True
        return self._plans.warm_up(self.switching.ladder, state) + self._decision.warm_up(self._memory, state)

    def _choose(
        self, before: Float[np.ndarray, "cars 4"], executed: Float[np.ndarray, "2"], now: Float[np.ndarray, "cars 4"]
    ) -> tuple[float, dict[str, float]]:
        """Take the decision; seconds spent, and the gains estimated by name of the alternative."""
        rung, ladder = int(self._memory.rung), self.switching.ladder
        decision, seconds = self._decision.decide(self._memory, Observation(before, executed, now))
        self._memory = decision.memory
        estimates = {ladder[rung - 1].name: float(decision.gain_down)} if rung > 0 else {}
        if rung < len(ladder) - 1:
            estimates[ladder[-1].name] = float(decision.gain_up)
        return seconds, {name: gain for name, gain in estimates.items() if np.isfinite(gain)}
