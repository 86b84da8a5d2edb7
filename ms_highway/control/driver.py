"""Drive among humans, one or several, with the models that a rule chooses for them."""

from dataclasses import replace
from functools import partial
from time import perf_counter

import numpy as np

from ms_highway.control.controller import ControlStep
from ms_highway.control.fallback import STATUSES, Followed, brake, follow, follow_escape, no_rest
from ms_highway.game.game import Game, constant_velocity
from ms_highway.metareasoning.belief import CompiledBelief, counted_on, first_belief
from ms_highway.metareasoning.budget import Budget
from ms_highway.metareasoning.compiled_decision import CompiledDecision, Observation
from ms_highway.metareasoning.rule import Decision, Order, Rule, always, check_rule, first_memory
from ms_highway.planning.compiled_plans import CompiledPlans, checked_state
from ms_highway.planning.effort import starts_warm
from ms_highway.planning.human_models import HumanModel, Naive
from ms_highway.planning.plans import Plan, one_step_later
from ms_highway.runtime.arrays import Rungs, State
from ms_highway.runtime.forks import refuse_after_fork
from ms_highway.runtime.timing import timed

QUANTILE = 0.99  # of decisions' seconds, for budgets


def drivable(rule: Rule | Order, belief: bool) -> Rule | Order:
    """Return a rule as a `Driver` takes it: with a belief, an order gets a rung for humans who do not respond.

    Raises:
        ValueError: as `Driver` does.
    """
    check_rule(rule)
    if belief and isinstance(rule, Order) and not isinstance(rule.ladder[0], Naive):
        return replace(rule, rungs=np.asarray(rule.rungs) + 1, ladder=(Naive(), *rule.ladder))
    if belief and rule.ladder[0].responds:
        message = f"the ladder begins with {rule.ladder[0].name}, which counts on a response"
        raise ValueError(f"{message}; with a belief, begin it with a model that does not, such as naive")
    return rule


class Driver:
    """Plan every step with the models that a rule chooses.

    Where a plan is not finite, the robot follows the rest of the last finite one, then brakes. With a budget, a plan
    that is late is not followed in its own step, in which the robot drives on with what it has, but from the next step
    on. What a rule learns from a step is about the plan that was followed in it, and the models of that plan.

    Args:
        game: of which car 0 is driven, with the humans' rewards as the robot believes them.
        rule: chooses the models.
        budget: time of a cycle, decision and plan [s]; None for no limit.
        way_out: whether a control that leaves no way out is replaced, see `ms_highway.planning.way_out`.
        belief: whether to infer which model predicts every human, and to predict those who show that they do not
            respond by the first rung, or naive under an order, instead of by a model that responds.

    Raises:
        ValueError: for impossible costs, a price or a ladder that do not fit, or if with a belief the first rung
            responds.
    """

    def __init__(
        self,
        game: Game,
        rule: Rule | Order,
        *,
        budget: float | None = None,
        way_out: bool = False,
        belief: bool = False,
    ) -> None:
        self.budget, self.way_out, self.infers = budget, way_out, belief
        self._rule = drivable(rule, belief)
        self.game = game
        self.reset()

    @property
    def rule(self) -> Rule | Order:
        """Rule that chooses the models; may be replaced between steps by one of the same ladder."""
        return self._rule

    @rule.setter
    def rule(self, rule: Rule | Order) -> None:
        orders = isinstance(self._rule, Order) and isinstance(rule, Order)
        self._rule = drivable(rule, self.infers)
        if not orders:
            self.game = self._game  # compiles the decision by the new one

    @property
    def game(self) -> Game:
        """Game that is played; may be replaced between steps, and a game of the same shapes compiles nothing."""
        return self._game

    @game.setter
    def game(self, game: Game) -> None:
        self._game = game
        self._plans = CompiledPlans(game, self.rule.ladder)
        self._decision = None if isinstance(self.rule, Order) else CompiledDecision(self.rule, game)
        self._inference = CompiledBelief(game) if self.infers else None
        self._warm = False

    @property
    def looks_back(self) -> bool:
        """Whether choices depend on the last step."""
        return self._decision is not None or self._inference is not None

    def reset(self) -> None:
        """Forget the past, before a new episode."""
        self._memory = first_memory(self.rule, self.game.number)
        self._steps = 0  # of the episode, for orders
        self._rest = no_rest(self.game.planner.horizon, self.game.number)
        self._checking = 0.0  # seconds of the last look for a way out, which comes after the plan
        self._forget_humans()

    def reset_partner(self) -> None:
        """Forget the humans, and what the last plan expected of them: the last step says nothing about others."""
        self._memory = first_memory(self.rule, self.game.number)
        unknown = np.zeros_like(self._rest.plan.humans)
        plan, start = (own._replace(humans=unknown) for own in (self._rest.plan, self._rest.start))
        self._rest = self._rest._replace(plan=plan, start=start)
        self._forget_humans()

    def _forget_humans(self) -> None:
        self._last: Observation | None = None  # the last step, not yet its outcome
        self._belief = first_belief(self.game.number) if self.infers else None

    def step(self, state: State, before: State | None = None) -> ControlStep:
        """Return the control of the coming step, after choosing the models from the outcome of the last one.

        Args:
            state: the robot, all humans and the scripted cars now.
            before: all cars before the last step, in the present coordinates; needed where these have changed since.

        Raises:
            ValueError: if a state is not a finite array [cars, 4] of two cars or more.
        """
        refuse_after_fork()
        now = checked_state(state)
        compiling = self._warm_up(now)
        start = perf_counter()
        happened = self._observed(now, before)
        inferring = self._infer(happened)
        decision, deciding = self._decide(happened, now)
        rungs = self._counted(np.asarray(decision.memory.rungs))
        plan, planning = self._plans.plan(now, rungs, self._start(rungs))
        elapsed = perf_counter() - start + self._checking
        late = self.budget is not None and elapsed > self.budget
        (rest, self._rest, status), self._checking = self._follow(follow(plan, rungs, self._rest, late), now)
        self._memory = decision.memory._replace(rungs=rest.rungs)
        self._steps += 1
        scale = np.asarray(self.game.planner.control_scale, dtype=float)
        followed = Plan(rest.plan.robot * scale, rest.plan.humans * scale)
        self._last = Observation(now, now, followed.robot[0], followed)
        names = tuple(model.name for model in self.rule.ladder)
        left = int(rest.steps) or None
        return ControlStep(
            followed.robot[0],
            followed.robot[:left],
            followed.humans[:, :left],
            tuple(names[rung] for rung in rest.rungs),
            planning + self._checking,
            inferring + deciding,
            compiling,
            names,
            np.asarray(decision.gains),
            bool(decision.failed),
            STATUSES[status],
            self._belief,
            tuple(names[rung] for rung in rungs),
        )

    def _warm_up(self, state: State) -> float:
        """Compile before the first control of a game; return the seconds spent.

        A budget without the time of a decision gets it measured.
        """
        if self._warm:
            return 0.0
        self._warm = True
        seconds = self._plans.warm_up(state)
        if self.way_out:
            seconds += self._plans.warm_up_way_out(state)
        if self._inference is not None:
            still = np.zeros((self.game.planner.horizon, 2))
            seconds += self._inference.warm_up(state, still, self.game.number)
        if self._decision is None:
            return seconds
        seconds += self._decision.warm_up(state)
        if isinstance(self.rule, Budget) and not self.rule.deciding:
            measured, measuring = timed(partial(self._decision.measure, state, quantile=QUANTILE))
            self._rule, seconds = replace(self.rule, deciding=measured), seconds + measuring
            self._decision = CompiledDecision(self.rule, self.game)
        return seconds

    def _observed(self, now: State, before: State | None) -> Observation | None:
        """Return the last step, None before the first one."""
        if self._last is None:
            return None
        return self._last._replace(before=self._last.before if before is None else checked_state(before), after=now)

    def _infer(self, happened: Observation | None) -> float:
        """Update the belief by the last step; return the seconds spent."""
        if self._inference is None or self._belief is None or happened is None:
            return 0.0
        robot = np.concatenate([happened.control[None], happened.plan.robot[1:]])
        robot = robot / np.asarray(self.game.planner.control_scale)
        self._belief, seconds = self._inference.update(self._belief, happened.before, happened.after, robot)
        return seconds

    def _decide(self, happened: Observation | None, now: State) -> tuple[Decision, float]:
        """Choose the rungs; return the decision, and the seconds that it took."""
        if isinstance(self.rule, Order):
            rungs = self.rule.at(self._steps, self.game.number)
            unknown = np.full((len(rungs), len(self.rule.ladder)), np.nan)
            return Decision(self._memory._replace(rungs=rungs), unknown, np.bool_(False)), 0.0
        assert self._decision is not None
        decision, seconds = self._decision.decide(self._memory, happened or self._decision.still(now))
        if self.game.number == 1:  # what it gains to switch: nothing for the model in use
            decision.gains[0, self._memory.rungs[0]] = np.nan
        return decision, seconds

    def _counted(self, rungs: Rungs) -> Rungs:
        """Return the rungs, the first one instead of one that responds for humans who show that they do not."""
        if self._belief is None:
            return rungs
        responds = np.array([model.responds for model in self.rule.ladder])
        return np.where(responds[rungs] & ~counted_on(self._belief), 0, rungs).astype(np.int32)

    def _start(self, rungs: Rungs) -> Plan | None:
        """Return the scaled plan to start from, the rest of what was followed; None to start anew."""
        persistent = self.game.planner.persistent or any(starts_warm(self.rule.ladder[rung]) for rung in rungs)
        return one_step_later(self._rest.start) if persistent and self._rest.steps > 0 else None

    def _follow(self, followed: Followed, state: State) -> tuple[Followed, float]:
        """Brake where no plan is left, and keep a way out; return what drives, and the seconds of looking for it."""
        if followed.now.steps == 0:
            followed = followed.instead(self._braking(state))
        if not self.way_out:
            return followed, 0.0
        escape, seconds = self._plans.keep_way_out(state, followed.now.plan.robot[0])
        return follow_escape(followed, escape), seconds

    def _braking(self, state: State) -> Plan:
        """Return the scaled controls that stop the robot, among humans who keep their velocity."""
        robot = brake(self.game, state[0]) / np.asarray(self.game.planner.control_scale)
        return Plan(robot, constant_velocity(self.game, state[1 : 1 + self.game.number]))


def fixed(game: Game, model: HumanModel | None = None) -> Driver:
    """Return a driver that always predicts by the same model, naive by default: so humans drive, too.

    Args:
        game: of which car 0 is driven; for a human, `ms_highway.game.game.swap_roles`.
        model: of all humans.
    """
    return Driver(game, always(model or Naive()))
