"""Drive among several humans, with the models that a rule chooses for them; drive as one of the humans."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np
from jaxtyping import Float, Int

from ms_highway.control.controller import ControlStep
from ms_highway.control.fallback import Status, brake
from ms_highway.control.fixed import FixedModel
from ms_highway.game.crowd import Crowd, human_game
from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.game import Game
from ms_highway.metareasoning.compiled_belief import CompiledBelief, counted_on
from ms_highway.metareasoning.crowd.budget import Budget
from ms_highway.metareasoning.crowd.compiled_decision import CompiledCrowdDecision, CrowdObservation
from ms_highway.metareasoning.crowd.rule import CrowdRule, first_crowd_memory, highest_gains
from ms_highway.planning.compiled_crowd import CompiledCrowdPlans, first_crowd_plan
from ms_highway.planning.compiled_plans import CompiledPlans, checked_state
from ms_highway.planning.crowd import NAIVE, RUNGS, TOM, CrowdPlan
from ms_highway.planning.human_models import HumanModel, JointPlan, Naive
from ms_highway.runtime.forks import refuse_after_fork

__all__ = ["CrowdDriver", "CrowdStep", "HumanDriver"]

QUANTILE = 0.99  # of decisions' seconds, for budgets


@dataclass(frozen=True)
class CrowdStep(ControlStep):
    """Record of one step among several humans.

    What a `ControlStep` tells of one human is here of the first (``human``), of the dearest rung in use (``model``),
    and of the highest gain of each rung over all humans (``gains``).

    Attributes:
        humans: controls that the plan expects of every human.
        rungs: name of the model that predicted every human.
        human_gains: estimated gain of each rung for every human, NaN where none was estimated; see
            `ms_highway.metareasoning.crowd.rule.CrowdDecision`.
    """

    humans: Float[np.ndarray, "humans steps 2"] = field(kw_only=True)
    rungs: tuple[str, ...] = field(kw_only=True)
    human_gains: Float[np.ndarray, "humans rungs"] = field(kw_only=True)


class CrowdDriver:
    """Plan every step among several humans, with the models that a rule chooses.

    Plans start from the rest of the last one. Where a plan is not finite, the robot follows the rest of the last finite
    one, then brakes. With a budget, a plan that is late is not followed in its own step, in which the robot drives on
    with what it has, but from the next step on.

    Args:
        crowd: of which car 0 is driven, with the humans' rewards as the robot believes them.
        rule: chooses the models; pure.
        budget: time of a cycle, decision and plan [s]; None for no limit.
        way_out: whether a control that leaves no way out is replaced, see `ms_highway.planning.way_out`.
        seed: of the episode, for rules that draw; may be replaced before a `reset`.
        belief: whether to infer which model predicts every human, and to predict naively, instead of by theory of mind,
            those who show that they do not respond.
    """

    def __init__(
        self,
        crowd: Crowd,
        rule: CrowdRule,
        budget: float | None = None,
        seed: int = 0,
        way_out: bool = True,
        belief: bool = False,
    ) -> None:
        self.rule, self.budget, self.seed, self.way_out, self.infers = rule, budget, seed, way_out, belief
        self.crowd = crowd
        self.reset()

    @property
    def crowd(self) -> Crowd:
        """Game that is played; may be replaced between steps, and one of the same shapes compiles nothing."""
        return self._plans.crowd

    @crowd.setter
    def crowd(self, crowd: Crowd) -> None:
        self._plans = CompiledCrowdPlans(crowd)
        self._decision = CompiledCrowdDecision(self.rule, crowd)
        self._inference = CompiledBelief(crowd) if self.infers else None
        self._warm = False

    @property
    def game(self) -> Game:
        """Game of the robot with any one of the humans, see `ms_highway.control.controller.Controller`."""
        return self.crowd.game

    @game.setter
    def game(self, game: Game) -> None:
        self.crowd = replace(self.crowd, game=game)

    def reset(self) -> None:
        """Forget the past, before a new episode."""
        self._memory = first_crowd_memory(self.crowd.humans, self.seed)
        self._belief = self._inference.first if self._inference else None
        self._checking = 0.0  # seconds of the last look for a way out, which comes after the plan
        self._rest: CrowdPlan | None = None  # scaled controls of the coming steps, as last planned
        self._seen: CrowdObservation | None = None  # the last step, not yet its outcome

    def reset_partner(self) -> None:
        """Forget all humans: the cars are others from now on."""
        self.reset()

    def step(self, state: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None = None) -> CrowdStep:
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
        outcome = self._outcome(now, before)
        inferring = self._infer(outcome)
        decision, deciding = self._decision.decide(self._memory, outcome)
        rungs = [int(rung) for rung in self._counted(np.asarray(decision.memory.rungs))]
        plan, planning = self._plans.plan(now, rungs, self._rest and self._whole(self._rest))
        elapsed = perf_counter() - start + self._checking
        late = self.budget is not None and elapsed > self.budget
        self._memory = decision.memory._replace(rungs=np.asarray(rungs, np.int32))
        gains = np.asarray(decision.gains)
        followed, status = self._follow(plan, late, state)
        control, status, checking = self._executed(followed, status, now)
        self._checking = checking
        self._seen = CrowdObservation(now, now, control, self._whole(followed))
        scale = np.asarray(self.game.planner.control_scale, dtype=float)
        robot, humans = (np.asarray(side) * scale for side in followed)
        return CrowdStep(
            control * scale,
            robot,
            humans[0],
            RUNGS[max(rungs)],
            planning + checking,
            inferring + deciding,
            compiling,
            {name: float(gain) for name, gain in zip(RUNGS, highest_gains(gains), strict=True) if np.isfinite(gain)},
            bool(decision.failed),
            status,
            self._belief,
            humans=humans,
            rungs=tuple(RUNGS[rung] for rung in rungs),
            human_gains=gains,
        )

    def _warm_up(self, state: Float[np.ndarray, "cars 4"]) -> float:
        """Compile plans and decision before the first control of a crowd; return the seconds spent.

        A budget without the time of a decision gets it measured.
        """
        if self._warm:
            return 0.0
        self._warm = True
        seconds = self._plans.warm_up(state) + self._decision.warm_up(state)
        if self._inference is not None:
            seconds += self._inference.warm_up(state, np.zeros((self.game.planner.horizon, 2)))
        if isinstance(self.rule, Budget) and not self.rule.deciding:
            self.rule = replace(self.rule, deciding=self._decision.measure(state, quantile=QUANTILE))
            self._decision = CompiledCrowdDecision(self.rule, self.crowd)
        return seconds

    def _infer(self, seen: CrowdObservation) -> float:
        """Update the belief by the last step, once there was one; return the seconds spent."""
        if self._inference is None or self._belief is None or self._seen is None:
            return 0.0
        robot = np.concatenate([seen.control[None], seen.plan.robot[1:]])
        self._belief, seconds = self._inference.update(self._belief, seen.before, seen.after, robot)
        return seconds

    def _counted(self, rungs: Int[np.ndarray, "humans"]) -> Int[np.ndarray, "humans"]:
        """Return the rungs, naive instead of theory of mind for humans who show that they do not respond."""
        if self._belief is None:
            return rungs
        return np.where((rungs == TOM) & ~counted_on(self._belief), NAIVE, rungs)

    def _outcome(
        self, now: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None
    ) -> CrowdObservation:
        """Return the outcome of the last step; before the first one, of a step in which no car moved."""
        if self._seen is None:
            return self._decision.nothing_happened(now)
        return self._seen._replace(before=self._seen.before if before is None else checked_state(before), after=now)

    def _follow(self, plan: CrowdPlan, late: bool, state: Float[np.ndarray, "cars 4"]) -> tuple[CrowdPlan, Status]:
        """Return the scaled plan to follow in this step, and its status; keep what is left for the coming steps."""
        finite, goes_on = all(np.isfinite(side).all() for side in plan), self._rest is not None
        status: Status = "planned" if finite else "previous plan" if goes_on else "braking"
        if finite and late:
            status = "late"
        followed = plan if status == "planned" else self._rest or self._braking(state)
        left = plan if finite else self._rest
        self._rest = left and _after_first(left)
        return followed, status

    def _braking(self, state: Float[np.ndarray, "cars 4"]) -> CrowdPlan:
        """Return the scaled controls that stop the robot, among humans who keep their velocity."""
        scale = np.asarray(self.game.planner.control_scale, dtype=float)
        return CrowdPlan(*(brake(self.game, state[0]) / scale, first_crowd_plan(self.crowd, state).humans))

    def _executed(
        self, followed: CrowdPlan, status: Status, state: Float[np.ndarray, "cars 4"]
    ) -> tuple[Float[np.ndarray, "2"], Status, float]:
        """Return the scaled control to execute, its status, and the seconds of looking for a way out.

        Late and failed plans keep their status, also where their control is replaced.
        """
        control = np.asarray(followed.robot[0])
        if not self.way_out:
            return control, status, 0.0
        kept, replaced, seconds = self._plans.keep_way_out(state, control)
        return kept, "way out" if replaced and status == "planned" else status, seconds

    def _whole(self, plan: CrowdPlan) -> CrowdPlan:
        """Return a plan over the whole horizon, its last controls repeated."""
        places = np.minimum(np.arange(self.game.planner.horizon), len(plan.robot) - 1)
        return CrowdPlan(plan.robot[places], plan.humans[:, places])


def _after_first(plan: CrowdPlan) -> CrowdPlan | None:
    """Return what is left of a plan after its first step; None where nothing is."""
    return CrowdPlan(plan.robot[1:], plan.humans[:, 1:]) if len(plan.robot) > 1 else None


class HumanDriver(FixedModel):
    """Drive as one of the humans: plan for its own reward among all others, who keep their velocity.

    States hold this human first, then all other cars in the order of the crowd: the robot, the other humans, scripted
    cars. So a vehicle drives with all other cars as companions, in the robot's order.

    Args:
        crowd: with the true rewards.
        human: its number.
    """

    def __init__(self, crowd: Crowd, human: int) -> None:
        self._crowd, self._human = crowd, human
        super().__init__(human_game(crowd, human), Naive())

    def _prepare(self, game: Game) -> None:
        weights = np.array(self._crowd.weights, dtype=np.float32)
        weights[self._human] = game.robot.weights
        self._crowd = Crowd(replace(game, robot=game.human, human=game.robot), weights)
        self._plans = _HumanPlans(game, self._crowd, self._human)


class _HumanPlans(CompiledPlans):
    """The plans of one human of a crowd, in the order of cars of a `HumanDriver`."""

    def __init__(self, game: Game, crowd: Crowd, human: int) -> None:
        super().__init__(game)
        self._all, self._human = CompiledCrowdPlans(crowd), human

    def plan(
        self, model: HumanModel, state: Float[np.ndarray, "cars 4"], start: JointPlan | None = None
    ) -> tuple[JointPlan, float]:
        own, seconds = self._all.predict(self._in_crowd(state), self._human)
        game = self._all.crowd.game
        kept = keep_velocity(game.dynamics, state[1]) / np.asarray(game.planner.control_scale)
        return JointPlan(*np.stack([own, np.tile(kept, (len(own), 1))])), seconds

    def warm_up(self, models: Sequence[HumanModel], state: Float[np.ndarray, "cars 4"]) -> float:
        return self._all.warm_up_humans(self._in_crowd(state))

    def _in_crowd(self, state: Float[np.ndarray, "cars 4"]) -> Float[np.ndarray, "cars 4"]:
        return np.insert(state[1:], 1 + self._human, state[0], axis=0)
