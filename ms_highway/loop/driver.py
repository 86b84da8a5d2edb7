"""Drive among humans, one or several, with the models that a rule chooses for them."""

from dataclasses import dataclass
from functools import cache, partial
from time import perf_counter
from typing import ClassVar, TypeAlias

import jax
import numpy as np

from ms_highway.choice.budget import deciding_in
from ms_highway.choice.checks import shown
from ms_highway.choice.rule import (
    NOT_ESTIMATED,
    GameEvidence,
    Rule,
    always,
    for_unresponsive,
    is_of_package,
    refuse_rungs,
)
from ms_highway.choice.rule import decide as decide_by
from ms_highway.game.game import Game
from ms_highway.loop.braking import brake
from ms_highway.loop.controller import ControlStep
from ms_highway.loop.game_parts import choose, plan_start
from ms_highway.loop.step import (
    STATUSES,
    Choice,
    GameCarry,
    GameChoice,
    GamePlan,
    GameResult,
    NewPlan,
    Parts,
    RemainingPlan,
    begin,
    step,
)
from ms_highway.planning.compiled_plans import CompiledPlans, checked_state
from ms_highway.planning.human_models import HumanModel, Naive
from ms_highway.planning.plans import Plan
from ms_highway.planning.way_out import Escape
from ms_highway.runtime.arrays import Control, RungIndex, State
from ms_highway.runtime.compilation import (
    Compiled,
    ReusedArguments,
    jit_quickly,
    single,
    timed,
    warm_up,
)
from ms_highway.runtime.process import refuse_after_fork

GameRule: TypeAlias = Rule[GameEvidence]


def prepared_rule(rule: GameRule, belief: bool) -> tuple[GameRule, RungIndex | None]:
    """Return the rule for a `Driver`, and the rung that predicts unresponsive humans.

    Without a belief, no human counts as unresponsive, and the rung is None.

    Raises:
        ValueError: as `Driver` does.
    """
    if not isinstance(rule, Rule):
        remedy = (
            "make one with ms_highway.in_order(rungs, ladder) or"
            " ms_highway.always(model)"
        )
        raise ValueError(f"a driver is given {shown(rule)}, which is no Rule; {remedy}")
    rule.check()
    return for_unresponsive(rule) if belief else (rule, None)


@dataclass
class StepSeconds:
    """Seconds that the parts of a step took, without compilation.

    Attributes:
        choosing: seconds of choosing the models, and of inferring which models humans
            follow; 0 if nothing is chosen or inferred.
        planning: seconds of the plan alone.
        checking: seconds of the way-out check; before this step's check, those of the
            last one, by which `Driver` forecasts whether a plan is late.
    """

    choosing: float = 0.0
    planning: float = 0.0
    checking: float = 0.0


class Driver:
    """Plan every step with the models that a rule chooses, for car 0 of a game.

    Where a plan is not finite, the robot follows the rest of the last finite plan, then
    brakes. With a budget, a plan may be late. In its own step, the robot then goes on
    with the rest of the last plan; the late one becomes the fallback of the next step,
    unless an escape replaces it. A rule is told of the plan that was followed in a
    step, and of the models of that plan.

    A step is `ms_highway.loop.step.step`; its parts are compiled and timed here.

    Args:
        game: game whose car 0 is driven, with the humans' rewards as the robot believes
            them.
        rule: chooses the models.
        budget: time of a cycle [s]: the decision, the plan and the way-out check; None
            for no limit.
        way_out: whether an escape that is better than every way out after the control
            replaces it, see `ms_highway.planning.way_out`.
        belief: whether to infer which model predicts every human. Humans who show that
            they do not respond are then predicted by the first rung, or by naive under
            an `ms_highway.choice.rule.Order`, instead of by a model that responds.

    Attributes:
        decision_quantile: quantile of the measured seconds of decisions that budgets
            count.

    Raises:
        ValueError: for impossible costs, prices or ladders, or if with a belief the
            first rung responds.
    """

    decision_quantile: ClassVar[float] = 0.99

    def __init__(
        self,
        game: Game,
        rule: GameRule,
        *,
        budget: float | None = None,
        way_out: bool = False,
        belief: bool = False,
    ) -> None:
        self.budget = budget
        self.way_out = way_out
        self.infers_models = belief
        self._game = game
        self._rule, self._unresponsive = prepared_rule(rule, belief)
        self._prepare()
        self.reset()

    @property
    def rule(self) -> GameRule:
        """Rule that chooses the models.

        Between steps, it may be replaced by one of the same ladder.
        """
        return self._rule

    @rule.setter
    def rule(self, rule: GameRule) -> None:
        last = self._rule
        rule, unresponsive = prepared_rule(rule, self.infers_models)
        if rule.ladder != last.ladder:
            new = " ".join(rule.names.models)
            old = " ".join(last.names.models)
            raise ValueError(
                f"the rule is on the ladder {new}, and the driver on {old}; make a new"
                " driver"
            )
        self._rule = rule
        self._unresponsive = unresponsive
        self._place()
        if last.computes or rule.computes:
            self._warm = False

    @property
    def game(self) -> Game:
        """Game that is played.

        It may be replaced between steps; a game of the same shapes compiles nothing.
        """
        return self._game

    @game.setter
    def game(self, game: Game) -> None:
        self._game = game
        self._prepare()

    def _prepare(self) -> None:
        """Prepare the compiled plans of a new game."""
        self._plans = CompiledPlans(self.game, self.rule.ladder)
        self._place()
        self._warm = False

    def _place(self) -> None:
        """Put rule and game on the device, and note whether decisions are compiled."""
        self._arguments = ReusedArguments((self.rule, single(self.game)))
        self._choice_computes = self._rule.computes or self.infers_models

    def reset(self) -> None:
        """Forget the past, before a new episode."""
        self._carry: GameCarry | None = None  # before the first step
        self._seconds = StepSeconds()

    def step(self, state: State) -> ControlStep:
        """Choose the models, plan, and return the control of the coming step.

        The models are chosen from the outcome of the last step.

        Args:
            state: the robot, all humans and the scripted cars now.

        Raises:
            ValueError: if it is not a finite array [cars, 4] of two cars or more.
        """
        now = checked_state(state)
        compile_seconds = self._warm_up(now)

        # The clock starts once everything is compiled.
        last_checking = self._seconds.checking if self.way_out else 0.0
        self._seconds = StepSeconds(checking=last_checking)
        self._started = perf_counter()

        parts = Parts(
            choose=self._choose,
            plan=self._plan,
            brake=partial(brake, self._game),
            is_late=None if self.budget is None else self._is_late,
            escape=self._escape if self.way_out else None,
        )
        carry = self._carry or begin(self._rule, self._game, now)
        self._carry, result = step(carry, now, parts)
        return self._record(result, compile_seconds)

    def _record(self, result: GameResult, compile_seconds: float) -> ControlStep:
        """Return the record of a step in SI units, given the seconds of compilation."""
        executed = result.executed
        choice = result.choice
        names = self._rule.names.models
        scale = np.asarray(self._game.planner.control_scale, dtype=float)
        plan = executed.plan.robot * scale
        humans = executed.plan.humans * scale

        # Where the robot brakes, no control of a plan is left: show all of the braking.
        left = int(executed.controls_left) or None

        # Gains that were not estimated are NaN in records.

        gains = choice.decision.gains
        gains = np.where(gains == NOT_ESTIMATED, np.nan, gains)
        return ControlStep(
            control=plan[0],
            plan=plan[:left],
            humans=humans[:, :left],
            models=tuple(names[rung] for rung in executed.rungs),
            planning_seconds=self._seconds.planning + self._seconds.checking,
            decision_seconds=self._seconds.choosing,
            compile_seconds=compile_seconds,
            ladder=names,
            gains=gains,
            choice_failed=bool(choice.decision.failed),
            status=STATUSES[result.status],
            belief=choice.model_probabilities if self.infers_models else None,
            planned=tuple(names[rung] for rung in choice.rungs),
            plan_steps=int(result.new_plan.iterations),
            converged=bool(result.new_plan.converged),
        )

    # Parts of a step, which are compiled and timed

    def _choose(self, carry: GameCarry, now: State) -> GameChoice:
        """Choose the models; see `ms_highway.loop.step.Parts`."""
        # Rules that compute nothing, such as an order, need no complete outcome.
        if not self._choice_computes:
            decision = decide_by(self._rule, self._game, carry.memory, carry.outcome)
            decision = jax.tree.map(np.asarray, decision)
            rungs = decision.memory.rungs
            return Choice(carry.model_probabilities, decision, rungs, observation=None)

        found, self._seconds.choosing = timed(*self._choice_call(carry, now))
        choice = jax.tree.map(np.asarray, found)

        # A compiled decision cannot refuse what a user's rule chose.
        if not is_of_package(self._rule):
            refuse_rungs(self._rule, choice.decision.memory.rungs)
        return choice

    def _plan(
        self,
        now: State,
        choice: GameChoice,
        last: RemainingPlan[Plan],
    ) -> GamePlan:
        """Plan with the models of a choice; see `ms_highway.loop.step.Parts`."""
        start = plan_start(self._rule.ladder, self._game, now, choice.rungs, last)
        solution, self._seconds.planning = self._plans.plan(now, choice.rungs, start)
        plan = solution.plan
        return NewPlan(plan, plan, solution.steps, solution.converged, details=None)

    def _is_late(self) -> bool:
        """Return whether the step, way-out check included, will exceed the budget.

        The check is expected to take as long as the last one.
        """
        assert self.budget is not None
        elapsed = perf_counter() - self._started
        return elapsed + self._seconds.checking > self.budget

    def _escape(self, now: State, control: Control) -> Escape:
        """Search for a way out; see `ms_highway.loop.step.Parts`."""
        escape, self._seconds.checking = self._plans.keep_way_out(now, control)
        return escape

    # Compilation

    def _warm_up(self, state: State) -> float:
        """Compile before the first control of a game; return the seconds spent.

        With a budget, the seconds include those of timing decisions.
        """
        if self._warm:
            return 0.0
        refuse_after_fork()  # later, every compiled function refuses
        self._warm = True
        seconds = self._plans.warm_up(state, self.way_out)
        if not self._choice_computes:
            return seconds

        carry = begin(self.rule, self.game, state)
        seconds += warm_up(*self._choice_call(carry, state))
        rule, measuring = timed(
            deciding_in, self.rule, lambda: self._deciding_seconds(state)
        )
        if rule is self._rule:  # its chooser counts no decisions
            return seconds

        # The rule now knows how long a decision takes.
        self._rule = rule
        self._place()
        return seconds + measuring

    def _deciding_seconds(self, state: State) -> float:
        """Measure the seconds of a warm decision."""
        carry = begin(self.rule, self.game, state)
        after_first = np.ones((), np.int32)  # in the first, rules may compute less
        carry = carry._replace(memory=carry.memory._replace(step=after_first))
        times = []
        for _ in range(CompiledPlans.repeats):
            _, seconds = timed(*self._choice_call(carry, state))
            times.append(seconds)
        return float(np.quantile(times, self.decision_quantile))

    def _choice_call(self, carry: GameCarry, now: State) -> tuple:
        """Return the compiled function of a choice, and its arguments."""
        function = choice_function(self._unresponsive)
        # A choice does not need the last plan.
        past = carry._replace(fallback=None)  # type: ignore[arg-type]
        arguments = *self._arguments.take(), past, now
        return function.of(*arguments), *arguments


@cache
def choice_function(unresponsive: RungIndex | None) -> Compiled:
    """Compile `ms_highway.loop.game_parts.choose` by a rule.

    Args:
        unresponsive: rung that predicts unresponsive humans; None to infer nothing.
    """

    def chosen(rule: GameRule, game: Game, carry: GameCarry, now: State) -> GameChoice:
        decide = partial(decide_by, rule, game)
        return choose(game, rule.ladder, unresponsive, decide, carry, now)

    return jit_quickly(chosen)


def fixed(game: Game, model: HumanModel | None = None) -> Driver:
    """Return a driver that always predicts by the same model, by default naive.

    Humans in environments drive in this way.

    Args:
        game: game whose car 0 is driven; for a human, see
            `ms_highway.game.game.swap_roles`.
        model: model of all humans.
    """
    return Driver(game, always(model or Naive()))
