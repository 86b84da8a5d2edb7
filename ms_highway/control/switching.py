"""Drive with the human model that Algorithm 1 chooses."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ms_highway.control.controller import ControlStep, PlanningController
from ms_highway.game.game import Game
from ms_highway.metareasoning.compiled_decision import CompiledDecision, Observation
from ms_highway.metareasoning.switching import Switching, check_costs, first_memory
from ms_highway.planning.compiled_plans import checked_state
from ms_highway.runtime.forks import refuse_after_fork

__all__ = ["ModelSwitching"]


class ModelSwitching(PlanningController):
    """Plan every step with the human model that Algorithm 1 chooses.

    Args:
        game: of which car 0 is driven.
        switching: ladder, costs, lambda and the numbers of the algorithm.
        warm_start: whether plans start from the last one instead of from zero controls.

    Raises:
        ValueError: if there is not one cost for each rung of the ladder.
    """

    def __init__(self, game: Game, switching: Switching, warm_start: bool = False) -> None:
        check_costs(switching)
        strange = [model for model in switching.ladder if not hasattr(model, "plan")]
        if strange:
            raise ValueError(f"the ladder has {strange[0]!r}, which is no human model; make one of names with `ladder`")
        if not (np.asarray(switching.price) >= 0).all() or (np.asarray(switching.costs) < 0).any():
            told = f"the price is {switching.price} and the costs are {np.asarray(switching.costs).tolist()}"
            raise ValueError(f"{told}; neither may be negative, nor the price NaN")
        self.switching = switching
        super().__init__(game, warm_start)

    def _prepare(self, game: Game) -> None:
        super()._prepare(game)
        self._decision = CompiledDecision(self.switching, game)
        self._warm = False

    def reset(self) -> None:
        """Start again at the bottom of the ladder."""
        super().reset()
        self._start_again()

    def reset_partner(self) -> None:
        """Start again at the bottom of the ladder: the last step says nothing about another partner."""
        super().reset_partner()
        self._start_again()

    def _start_again(self) -> None:
        self._memory = first_memory(self.switching)
        self._before: Float[np.ndarray, "cars 4"] | None = None

    def step(
        self, state: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None = None
    ) -> ControlStep:
        """Return the control of the coming step, after choosing the model from the outcome of the last step.

        Args:
            state: all cars now.
            before: all cars before the last step, in the present coordinates; needed where these have changed since.

        Raises:
            ValueError: if a state is not a finite array [cars, 4] of two cars or more.
        """
        refuse_after_fork()
        now = checked_state(state)
        compiling, deciding, gains = self._warm_up(now), 0.0, dict[str, float]()
        if self._last is not None and self._before is not None:
            before = self._before if before is None else checked_state(before)
            deciding, gains = self._choose(before, self._last.control, now)
        planned = self._plan(self.switching.ladder[int(self._memory.rung)], state, now)
        self._before = now
        self._last = replace(planned, decision_seconds=deciding, compile_seconds=compiling, gains=gains)
        return self._last

    def _warm_up(self, state: Float[np.ndarray, "cars 4"]) -> float:
        """Compile every rung and the decision before the first control of a game; return the seconds spent."""
        if self._warm:
            return 0.0
        self._warm = True
        return self._plans.warm_up(self.switching.ladder, state) + self._decision.warm_up(self._memory, state)

    def _choose(
        self, before: Float[np.ndarray, "cars 4"], executed: Float[np.ndarray, "2"], now: Float[np.ndarray, "cars 4"]
    ) -> tuple[float, dict[str, float]]:
        """Decide; return the seconds spent and the estimated gains by name of the alternative."""
        rung, ladder = int(self._memory.rung), self.switching.ladder
        decision, seconds = self._decision.decide(self._memory, Observation(before, executed, now))
        self._memory = decision.memory
        estimates = {ladder[rung - 1].name: float(decision.gain_down)} if rung > 0 else {}
        if rung < len(ladder) - 1:
            estimates[ladder[-1].name] = float(decision.gain_up)
        return seconds, {name: gain for name, gain in estimates.items() if np.isfinite(gain)}
