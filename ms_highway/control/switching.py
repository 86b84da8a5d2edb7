"""Drive with the human model that a rule chooses, such as Algorithm 1."""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ms_highway.control.controller import ControlStep, PlanningController
from ms_highway.game.game import Game
from ms_highway.metareasoning.compiled_decision import CompiledDecision, Observation
from ms_highway.metareasoning.rule import Rule, check_costs, first_memory
from ms_highway.planning.compiled_plans import checked_state
from ms_highway.runtime.forks import refuse_after_fork

__all__ = ["ModelSwitching"]


class ModelSwitching(PlanningController):
    """Plan every step with the human model that a rule chooses.

    Args:
        game: of which car 0 is driven.
        rule: chooses the models, see `ms_highway.metareasoning.rule.Rule`.
        warm_start: whether plans start from the last one instead of from zero controls.
        belief: see `ms_highway.control.controller.PlanningController`; the cheapest rung then takes the place of one
            that responds.

    Raises:
        ValueError: if there is not one cost for each rung of the ladder, or if with a belief the first one responds.
    """

    def __init__(self, game: Game, rule: Rule, warm_start: bool = False, belief: bool = False) -> None:
        check_costs(rule)
        strange = [model for model in rule.ladder if not hasattr(model, "plan")]
        if strange:
            raise ValueError(f"the ladder has {strange[0]!r}, which is no human model; make one of names with `ladder`")
        if belief and rule.ladder[0].responds:
            told = f"the ladder begins with {rule.ladder[0].name}, which counts on a response"
            raise ValueError(f"{told}; with a belief, begin it with a model that does not, such as naive")
        if not (np.asarray(rule.price) >= 0).all() or (np.asarray(rule.costs) < 0).any():
            told = f"the price is {rule.price} and the costs are {np.asarray(rule.costs).tolist()}"
            raise ValueError(f"{told}; neither may be negative, nor the price NaN")
        self.rule = rule
        super().__init__(game, warm_start, belief)

    def _prepare(self, game: Game) -> None:
        super()._prepare(game)
        self._decision = CompiledDecision(self.rule, game)
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
        self._memory = first_memory(self.rule)

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
        compiling = self._warm_up(now)
        inferring = self._infer(now, before)
        happened = self._observed(now, before)
        chosen = {} if happened is None else self._choose(happened)
        if self._refuses(self.rule.ladder[int(self._memory.rung)]):
            self._memory = self._memory._replace(rung=np.zeros((), np.int32))
        planned = self._plan(self.rule.ladder[int(self._memory.rung)], state, now)
        deciding = inferring + chosen.pop("decision_seconds", 0.0)
        self._last = replace(planned, compile_seconds=compiling, decision_seconds=deciding, **chosen)
        return self._last

    def _observed(
        self, now: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None
    ) -> Observation | None:
        """Return the last step; before the first one, a step in which nothing happened, or None if nobody decides."""
        if self._last is None or self._before is None:
            return self._decision.nothing_happened(now) if self.rule.chooses_first else None
        rest = np.minimum(np.arange(self.game.planner.horizon), len(self._last.plan) - 1)
        before = self._before if before is None else checked_state(before)
        return Observation(before, now, self._last.control, (self._last.plan[rest], self._last.human[rest]))

    def _warm_up(self, state: Float[np.ndarray, "cars 4"]) -> float:
        """Compile every rung and the decision before the first control of a game; return the seconds spent."""
        if self._warm:
            return 0.0
        self._warm = True
        compiling = self._plans.warm_up(self.rule.ladder, state) + self._decision.warm_up(self._memory, state)
        return compiling + self._warm_up_belief(state)

    def _choose(self, happened: Observation) -> dict[str, Any]:
        """Decide; return what the step's record says of it."""
        rung, names = int(self._memory.rung), [model.name for model in self.rule.ladder]
        decision, seconds = self._decision.decide(self._memory, happened)
        self._memory = decision.memory
        gains = {
            name: float(gain)
            for place, (name, gain) in enumerate(zip(names, decision.gains, strict=True))
            if place != rung and np.isfinite(gain)
        }
        return {"decision_seconds": seconds, "gains": gains, "choice_failed": bool(decision.failed)}
