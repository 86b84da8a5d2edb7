"""Drive among several humans (stand-in)."""

from dataclasses import dataclass
from time import perf_counter
from typing import Any

import jax
import numpy as np

from ms_highway.control.controller import ControlStep
from ms_highway.game.crowd import Crowd
from ms_highway.planning.crowd import RUNGS, plan_crowd, predict_human

_plan, _predict = jax.jit(plan_crowd), jax.jit(predict_human)


@dataclass(frozen=True)
class CrowdStep(ControlStep):
    """A step among several humans."""

    humans: Any = ()
    rungs: tuple[str, ...] = ()


class CrowdDriver:
    """Drive the robot."""

    def __init__(self, crowd: Crowd, rule: Any, budget: float | None = None, seed: int = 0) -> None:
        self.crowd, self.rule, self.budget = crowd, rule, budget
        self.game = crowd.game

    def reset(self) -> None:
        pass

    def reset_partner(self) -> None:
        pass

    def step(self, state: Any, before: Any = None) -> CrowdStep:
        begun = perf_counter()
        rungs = np.array(self.rule(state))
        plan = jax.block_until_ready(_plan(self.crowd, np.asarray(state, np.float32), rungs))
        scale = np.asarray(self.game.planner.control_scale, float)
        robot, humans = (np.asarray(side, float) * scale for side in plan)
        return CrowdStep(
            robot[0],
            robot,
            humans[0],
            RUNGS[rungs.max()],
            perf_counter() - begun,
            humans=humans,
            rungs=tuple(RUNGS[rung] for rung in rungs),
        )


class HumanDriver:
    """Drive a human."""

    def __init__(self, crowd: Crowd, human: int) -> None:
        self.crowd, self.human = crowd, human
        self.game = crowd.game

    def reset(self) -> None:
        pass

    def reset_partner(self) -> None:
        pass

    def step(self, state: Any, before: Any = None) -> ControlStep:
        plan = _predict(self.crowd, np.asarray(state, np.float32), self.human)
        controls = np.asarray(plan, float) * np.asarray(self.game.planner.control_scale, float)
        return ControlStep(controls[0], controls, controls, RUNGS[0], 0.0)
