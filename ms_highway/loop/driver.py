"""Drive among humans, one or several, with the models that a rule chooses for them."""

from dataclasses import dataclass
from functools import cache, partial
from time import perf_counter

import jax
import numpy as np

from ms_highway.choice.budget import deciding_in
from ms_highway.choice.rule import (
    NOT_ESTIMATED,
    GameEvidence,
    Rule,
    always,
    for_unresponsive,
    is_of_package,
    refuse_rungs,
    shown,
)
from ms_highway.choice.rule import decide as chosen_by
from ms_highway.game.game import Game
from ms_highway.loop.controller import ControlStep
from ms_highway.loop.step import (
    STATUSES,
    Carry,
    Choice,
    NewPlan,
    Parts,
    RemainingPlan,
    StepResult,
    begin,
    brake,
    choose,
    plan_start,
    step,
)
from ms_highway.planning.compiled_plans import REPEATS, CompiledPlans, checked_state
from ms_highway.planning.human_models import HumanModel, Naive
from ms_highway.planning.way_out import Escape
from ms_highway.runtime.arrays import Control, State
from ms_highway.runtime.compilation import (
    Compiled,
    Placed,
    jit_quickly,
    single,
    timed,
    warm_up,
)
from ms_highway.runtime.process import refuse_after_fork

QUANTILE = 0.99  # of decisions' seconds, for budgets


def drivable(
    rule: Rule[GameEvidence], belief: bool
) -> tuple[Rule[GameEvidence], int | None]:
    """Return the rule for a `Driver`, and the rung that predicts unresponsive humans
    (None without a belief).

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
        choosing: of choosing the models, with the belief; 0 if nothing is chosen or
            inferred.
        planning: of the plan.
        checking: of the search for a way out; until this step has searched, the last
            step's, by which a plan counts as late.
    """

    choosing: float = 0.0
    planning: float = 0.0
    checking: float = 0.0


class Driver:
    """Plan every step with the models that a rule chooses.

    Where a plan is not finite, the robot follows the rest of the last finite plan, then
    brakes. With a budget, a late plan is followed from the next step on; in its own
    step, the robot goes on with the rest of the last one. A rule is told of the plan
    that was followed in a step, and of the models of that plan.

    Args:
        game: of which car 0 is driven, with the humans' rewards as the robot believes
            them.
        rule: chooses the models.
        budget: time of a cycle, decision and plan [s]; None for no limit.
        way_out: whether a control that leaves no way out is replaced, see
            `ms_highway.planning.way_out`.
        belief: whether to infer which model predicts every human. Humans who show that
            they do not respond are then predicted by the first rung, or by naive under
            an order, instead of by a model that responds.

    Raises:
        ValueError: for impossible costs, prices or ladders, or if with a belief the
            first rung responds.
    """

    def __init__(
        self,
        game: Game,
        rule: Rule,
        *,
        budget: float | None = None,
        way_out: bool = False,
        belief: bool = False,
    ) -> None:
        self.budget = budget
        self.way_out = way_out
        self.infers = belief
        self._game = game
        self._rule, self._unresponsive = drivable(rule, belief)
        self._prepare()
        self.reset()

    @property
    def rule(self) -> Rule:
        """Rule that chooses the models; between steps, it may be replaced by one of the
        same ladder.
        """
        return self._rule

    @rule.setter
    def rule(self, rule: Rule) -> None:
        last = self._rule
        rule, unresponsive = drivable(rule, self.infers)
        if rule.ladder != last.ladder:
            new = " ".join(model.name for model in rule.ladder)
            old = " ".join(model.name for model in last.ladder)
            raise ValueError(
                f"the rule is on the ladder {new}, and the driver on {old}; make a new"
                " driver"
            )
        self._rule = rule
        self._unresponsive = unresponsive
        self._place()
        if last.estimates or rule.estimates:
            self._warm = False

    @property
    def game(self) -> Game:
        """Game that is played; it may be replaced between steps, and a game of the same
        shapes compiles nothing.
        """
        return self._game

    @game.setter
    def game(self, game: Game) -> None:
        self._game = game
        self._prepare()

    def _prepare(self) -> None:
        self._plans = CompiledPlans(self.game, self.rule.ladder)
        self._place()
        self._warm = False

    def _place(self) -> None:
        """Hold what decisions take: the numbers of rule and game, and whether they
        depend on the last step.
        """
        self._placed = Placed((self.rule, single(self.game)))
        self._looks_back = self._rule.estimates or self.infers

    def reset(self) -> None:
        """Forget the past, before a new episode."""
        self._carry: Carry | None = None  # before the first step
        self._seconds = StepSeconds()

    def step(self, state: State) -> ControlStep:
        """Choose the models from the outcome of the last step, plan, and return the
        control of the coming step.

        Args:
            state: the robot, all humans and the scripted cars now.

        Raises:
            ValueError: if it is not a finite array [cars, 4] of two cars or more.
        """
        now = checked_state(state)
        compiling = self._warm_up(now)
        self._seconds = StepSeconds(
            checking=self._seconds.checking if self.way_out else 0.0
        )
        self._started = perf_counter()
        parts = Parts(
            self._choose,
            self._plan,
            partial(brake, self._game),
            None if self.budget is None else self._is_late,
            self._escape if self.way_out else None,
        )
        carry = self._carry or begin(self._rule, self._game, now)
        self._carry, result = step(carry, now, parts)
        return self._record(result, compiling)

    def _record(self, result: StepResult, compiling: float) -> ControlStep:
        """Return the record of a step in SI units, given the seconds of compilation."""
        driven = result.driven
        choice = result.choice
        names = tuple(model.name for model in self._rule.ladder)
        scale = np.asarray(self._game.planner.control_scale, dtype=float)
        left = int(driven.steps) or None
        plan = driven.plan.robot * scale
        humans = driven.plan.humans * scale

        gains = choice.decision.gains
        return ControlStep(
            control=plan[0],
            plan=plan[:left],
            humans=humans[:, :left],
            models=tuple(names[rung] for rung in driven.rungs),
            planning_seconds=self._seconds.planning + self._seconds.checking,
            decision_seconds=self._seconds.choosing,
            compile_seconds=compiling,
            ladder=names,
            gains=np.where(gains == NOT_ESTIMATED, np.nan, gains),
            choice_failed=bool(choice.decision.failed),
            status=STATUSES[result.status],
            belief=choice.belief if self.infers else None,
            planned=tuple(names[rung] for rung in choice.rungs),
            plan_steps=int(result.planned.steps),
            converged=bool(result.planned.converged),
        )

    # Parts of a step, which are compiled and timed

    def _choose(self, carry: Carry, now: State) -> Choice:
        """Choose the models; see `ms_highway.loop.step.Parts`."""
        if not self._looks_back:
            decision = chosen_by(self._rule, self._game, carry.memory, carry.outcome)
            decision = jax.tree.map(np.asarray, decision)
            return Choice(carry.belief, decision, decision.memory.rungs)
        found, self._seconds.choosing = timed(*self._choice(carry, now))
        choice = jax.tree.map(np.asarray, found)
        if not is_of_package(self._rule):  # which a compiled decision cannot refuse
            refuse_rungs(self._rule, choice.decision.memory.rungs)
        return choice

    def _plan(self, now: State, choice: Choice, last: RemainingPlan) -> NewPlan:
        """Plan with the models of a choice; see `ms_highway.loop.step.Parts`."""
        start = plan_start(self._rule.ladder, self._game, now, choice.rungs, last)
        solution, self._seconds.planning = self._plans.plan(now, choice.rungs, start)
        plan = solution.plan
        return NewPlan(plan, plan, solution.steps, solution.converged)

    def _is_late(self) -> bool:
        """Return whether the budget will be spent after a search for a way out that
        takes as long as the last one.
        """
        assert self.budget is not None
        return perf_counter() - self._started + self._seconds.checking > self.budget

    def _escape(self, now: State, control: Control) -> Escape:
        """Search for a way out; see `ms_highway.loop.step.Parts`."""
        escape, self._seconds.checking = self._plans.keep_way_out(now, control)
        return escape

    # Compilation

    def _warm_up(self, state: State) -> float:
        """Compile before the first control of a game; return the seconds spent, timing
        of decisions included.
        """
        if self._warm:
            return 0.0
        refuse_after_fork()  # later, every compiled function refuses
        self._warm = True
        seconds = self._plans.warm_up(state, self.way_out)
        if self._looks_back:
            seconds += warm_up(*self._choice(begin(self.rule, self.game, state), state))
            rule, measuring = timed(
                deciding_in, self.rule, lambda: self._deciding_seconds(state)
            )
            if rule is not self._rule:
                self._rule = rule
                self._place()
                seconds += measuring
        return seconds

    def _deciding_seconds(self, state: State) -> float:
        """Measure the seconds of a warm decision."""
        carry = begin(self.rule, self.game, state)
        carry = carry._replace(
            memory=carry.memory._replace(step=np.ones((), np.int32))
        )  # step 0 may take less
        times = [timed(*self._choice(carry, state))[1] for _ in range(REPEATS)]
        return float(np.quantile(times, QUANTILE))

    def _choice(self, carry: Carry, now: State) -> tuple:
        """Return the compiled function of a choice, and its arguments."""
        function = choice_function(self._unresponsive)
        past = carry._replace(fallback=None)  # type: ignore[arg-type]  # a choice does not need the last plan
        arguments = *self._placed.take(), past, now
        return function.of(*arguments), *arguments


@cache
def choice_function(unresponsive: int | None) -> Compiled:
    """Compile `ms_highway.loop.step.choose` by a rule, given the rung that predicts
    unresponsive humans.
    """

    def chosen(rule: Rule, game: Game, carry: Carry, now: State) -> Choice:
        return choose(
            game, rule.ladder, unresponsive, partial(chosen_by, rule, game), carry, now
        )

    return jit_quickly(chosen)


def fixed(game: Game, model: HumanModel | None = None) -> Driver:
    """Return a driver that always predicts by the same model, by default naive, as
    humans in environments do.

    Args:
        game: of which car 0 is driven; for a human, `ms_highway.game.game.swap_roles`.
        model: of all humans.
    """
    return Driver(game, always(model or Naive()))
