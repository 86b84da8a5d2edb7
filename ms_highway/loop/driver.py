"""Drive among humans, one or several, with the models that a rule chooses for them."""

from functools import cache, partial
from time import perf_counter

import jax
import numpy as np

from ms_highway.choice.budget import deciding_in
from ms_highway.choice.rule import (
    NOT_ESTIMATED,
    Decision,
    GameEvidence,
    Rule,
    always,
    for_unresponsive,
    is_of_package,
    refuse_rungs,
)
from ms_highway.choice.rule import decide as chosen_by
from ms_highway.game.game import Game
from ms_highway.loop.controller import ControlStep
from ms_highway.loop.step import (
    STATUSES,
    Carry,
    Followed,
    advance,
    begin,
    continues_plan,
    decide,
    follow,
    follow_escape,
    no_rest,
    or_brake,
)
from ms_highway.planning.compiled_plans import REPEATS, CompiledPlans, checked_state
from ms_highway.planning.human_models import HumanModel, Naive
from ms_highway.planning.plans import Plan, one_step_later
from ms_highway.runtime.arrays import State
from ms_highway.runtime.compilation import Compiled, Placed, jit_quickly, single, timed, warm_up
from ms_highway.runtime.process import refuse_after_fork

QUANTILE = 0.99  # of decisions' seconds, for budgets


def drivable(rule: Rule[GameEvidence], belief: bool) -> tuple[Rule[GameEvidence], int | None]:
    """Return the rule for a `Driver`, and the rung that predicts unresponsive humans (None without a belief).

    Raises:
        ValueError: as `Driver` does.
    """
    rule.check()
    return for_unresponsive(rule) if belief else (rule, None)


class Driver:
    """Plan every step with the models that a rule chooses.

    Where a plan is not finite, the robot follows the rest of the last finite plan, then brakes. With a budget, a late
    plan is followed from the next step on; in its own step, the robot goes on with the rest of the last one. A rule is
    told of the plan that was followed in a step, and of the models of that plan.

    Args:
        game: of which car 0 is driven, with the humans' rewards as the robot believes them.
        rule: chooses the models.
        budget: time of a cycle, decision and plan [s]; None for no limit.
        way_out: whether a control that leaves no way out is replaced, see `ms_highway.planning.way_out`.
        belief: whether to infer which model predicts every human. Humans who show that they do not respond are then
            predicted by the first rung, or by naive under an order, instead of by a model that responds.

    Raises:
        ValueError: for impossible costs, prices or ladders, or if with a belief the first rung responds.
    """

    def __init__(
        self, game: Game, rule: Rule, *, budget: float | None = None, way_out: bool = False, belief: bool = False
    ) -> None:
        self.budget, self.way_out, self.infers = budget, way_out, belief
        self._game = game
        self._rule, self._unresponsive = drivable(rule, belief)
        self._prepare()
        self.reset()

    @property
    def rule(self) -> Rule:
        """Rule that chooses the models; between steps, it may be replaced by one of the same ladder."""
        return self._rule

    @rule.setter
    def rule(self, rule: Rule) -> None:
        last, (rule, unresponsive) = self._rule, drivable(rule, self.infers)
        if rule.ladder != last.ladder:
            new, old = (" ".join(model.name for model in each.ladder) for each in (rule, last))
            raise ValueError(f"the rule is on the ladder {new}, and the driver on {old}; make a new driver")
        self._rule, self._unresponsive = rule, unresponsive
        self._place()
        if last.estimates or rule.estimates:
            self._warm = False

    @property
    def game(self) -> Game:
        """Game that is played; it may be replaced between steps, and a game of the same shapes compiles nothing."""
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
        """Hold the numbers of rule and game that decisions take."""
        self._placed = Placed((self.rule, single(self.game)))

    @property
    def looks_back(self) -> bool:
        """Whether choices depend on the last step."""
        return self.rule.estimates or self.infers

    def reset(self) -> None:
        """Forget the past, before a new episode."""
        self._carry: Carry | None = None  # before the first step
        self._rest = no_rest(self.game.planner.horizon, self.game.number)
        self._checking = 0.0  # seconds of the last search for a way out, which comes after the plan

    def step(self, state: State) -> ControlStep:
        """Choose the models from the outcome of the last step, plan, and return the control of the coming step.

        Args:
            state: the robot, all humans and the scripted cars now.

        Raises:
            ValueError: if it is not a finite array [cars, 4] of two cars or more.
        """
        refuse_after_fork()
        now = checked_state(state)
        compiling = self._warm_up(now)
        start = perf_counter()
        carry, decision, deciding = self._decide(now)
        rungs = decision.memory.rungs
        continues = continues_plan(self.rule.ladder, self.game, rungs, self._rest)
        solution, planning = self._plans.plan(now, rungs, one_step_later(self._rest.start) if continues else None)
        plan = solution.plan
        late = self.budget is not None and perf_counter() - start + self._checking > self.budget
        followed, self._checking = self._follow(follow(plan, rungs, self._rest, late), now)
        self._carry, (rest, self._rest, status) = advance(carry, decision, followed, now), followed
        scale = np.asarray(self.game.planner.control_scale, dtype=float)
        driven, left = Plan(rest.plan.robot * scale, rest.plan.humans * scale), int(rest.steps) or None
        names = tuple(model.name for model in self.rule.ladder)
        return ControlStep(
            driven.robot[0],
            driven.robot[:left],
            driven.humans[:, :left],
            tuple(names[rung] for rung in rest.rungs),
            planning + self._checking,
            deciding,
            compiling,
            names,
            decision.gains,
            bool(decision.failed),
            STATUSES[status],
            carry.belief if self.infers else None,
            tuple(names[rung] for rung in rungs),
        )

    def _warm_up(self, state: State) -> float:
        """Compile before the first control of a game; return the seconds spent, timing of decisions included."""
        if self._warm:
            return 0.0
        self._warm = True
        seconds = self._plans.warm_up(state, self.way_out)
        if self.looks_back:
            seconds += warm_up(*self._choice(begin(self.rule, self.game, state), state))
            rule, measuring = timed(deciding_in, self.rule, lambda: self._deciding_seconds(state))
            if rule is not self._rule:
                self._rule, seconds = rule, seconds + measuring
                self._place()
        return seconds

    def _deciding_seconds(self, state: State) -> float:
        """Measure the seconds of a warm decision."""
        carry = begin(self.rule, self.game, state)
        carry = carry._replace(memory=carry.memory._replace(step=np.ones((), np.int32)))  # step 0 may take less
        times = [timed(*self._choice(carry, state))[1] for _ in range(REPEATS)]
        return float(np.quantile(times, QUANTILE))

    def _choice(self, carry: Carry, now: State) -> tuple:
        """Return the compiled function of a choice, and its arguments."""
        function = decision_function(self._unresponsive)
        arguments = *self._placed.take(), carry, now
        return function.of(*arguments), *arguments

    def _decide(self, now: State) -> tuple[Carry, Decision, float]:
        """Choose the rungs; return the carry with the belief, the decision, and its seconds."""
        carry, seconds = self._carry or begin(self.rule, self.game, now), 0.0
        if self.looks_back:
            found, seconds = timed(*self._choice(carry, now))
            belief, decision = jax.tree.map(np.asarray, found)
            carry = carry._replace(belief=belief)
            if not is_of_package(self.rule):  # which a compiled decision cannot refuse
                refuse_rungs(self.rule, decision.memory.rungs)
        else:
            decision = jax.tree.map(np.asarray, chosen_by(self.rule, self.game, carry.memory, carry.outcome))
        gains = np.where(decision.gains == NOT_ESTIMATED, np.nan, decision.gains)
        return carry, decision._replace(gains=gains), seconds

    def _follow(self, followed: Followed, state: State) -> tuple[Followed, float]:
        """Brake where no plan is left, and keep a way out; return what drives, and the seconds of the latter."""
        if followed.now.steps == 0:
            with np.errstate(over="ignore", invalid="ignore"):
                followed = jax.tree.map(np.asarray, or_brake(self.game, state[0], followed))
        if not self.way_out:
            return followed, 0.0
        escape, seconds = self._plans.keep_way_out(state, followed.now.plan.robot[0])
        return follow_escape(followed, escape), seconds


@cache
def decision_function(unresponsive: int | None) -> Compiled:
    """Compile `ms_highway.loop.step.decide`, given the rung that predicts unresponsive humans."""
    return jit_quickly(partial(decide, unresponsive=unresponsive))


def fixed(game: Game, model: HumanModel | None = None) -> Driver:
    """Return a driver that always predicts by the same model, by default naive, as humans in environments do.

    Args:
        game: of which car 0 is driven; for a human, `ms_highway.game.game.swap_roles`.
        model: of all humans.
    """
    return Driver(game, always(model or Naive()))
