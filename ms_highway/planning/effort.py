"""Give a human model an effort: the number of its ascent steps, and the plan that they start from.

Names are ``tom@8``, theory of mind in 8 ascent steps, ``tom+warm``, from the rest of the last plan, and ``tom@8+warm``.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from jax import numpy as jnp

from ms_highway.game.game import Game
from ms_highway.game.planning_settings import MOST_ITERATIONS, SHARE, longest_traced_step
from ms_highway.planning.plans import Plan
from ms_highway.runtime.arrays import Controls, State

if TYPE_CHECKING:
    from ms_highway.planning.human_models import HumanModel

NAME = re.compile(r"(?P<model>[^@+]+)(@(?P<steps>[1-9][0-9]{0,8}))?(?P<warm>\+warm)?")
LENGTH = 0.1  # of a step; at the paper's horizon, some plans overshoot and collide from 0.15 on

BEST = "best"
"""Name of `BEST_LADDER` in configurations and commands."""

BEST_LADDER = ("naive@4+warm", "tom@6+warm", "tom@12+warm")
"""Ladder of the rungs that earn most for their time.

Reward per step of each rung alone in Merger and Give Way, measured with 30 starts, the learned human and paper
semantics: 4.67 and -0.04 at 5 % of tom's T, 6.40 and 5.27 at 30 %, 6.52 and 5.77 at 60 %; tom earns 6.25 and 5.02,
turn 1.51 and 0.09 at 46 %, naive 1.50 and 0.03 at 24 %. In Stay Back, where outcomes are chaotic, the upper two are not
worth their time: 0.98, 0.14 and -2.99, where naive earns 0.60, turn 1.50, tom 1.65, and naive@10 most, 1.90.
"""


@dataclass(frozen=True)
class Effort:
    """A human model whose plans take another number of ascent steps than the planner's, or start from the last plan.

    Steps that are counted are gradient steps, whatever the planner's solver and step size, and as long as is safe: 0.1,
    or `ms_highway.game.planning_settings.SHARE` of the longest where that is shorter, as it is from K = 6 on at 0.1 s.
    What a plan earns depends on the length of all its steps together: 6 of them earn what the paper's 20 of 0.03 earn,
    and more of them earn more. Under the solver ``convex_newton``, its own steps are counted. Among several humans, see
    `ms_highway.planning.several.most_steps`.

    Attributes:
        model: human model that plans.
        steps: number of gradient steps of each ascent; None for what the planner does.
        warm: whether plans start from the rest of the last plan, by whichever model, rather than from zero controls.
    """

    model: "HumanModel"
    steps: int | None = None
    warm: bool = False

    @property
    def name(self) -> str:
        """Name in configurations and reports, such as ``tom@8+warm``."""
        return self.model.name + (f"@{self.steps}" if self.steps else "") + "+warm" * self.warm

    @property
    def responds(self) -> bool:
        """Whether the human responds to the robot's plan."""
        return self.model.responds

    def predict(self, game: Game, state: State, start: Plan | None = None) -> Controls:
        """See `ms_highway.planning.human_models.HumanModel`."""
        return self.model.predict(self._game(game), state, start)

    def plan(self, game: Game, state: State, start: Plan | None = None) -> Plan:
        """See `ms_highway.planning.human_models.HumanModel`."""
        return self.model.plan(self._game(game), state, start)

    def _game(self, game: Game) -> Game:
        if self.steps is None:
            return game
        if game.planner.for_seconds:
            return replace(game, planner=replace(game.planner, newton_steps=self.steps, answered_steps=self.steps))
        longest = longest_traced_step(game.planner.horizon, game.dynamics.time_step)
        length = jnp.minimum(LENGTH, SHARE * longest)
        return replace(game, planner=replace(game.planner, iterations=self.steps, step_size=length, solver="gradient"))


def base_of(model: "HumanModel") -> "HumanModel":
    """Return the model without its effort."""
    return model.model if isinstance(model, Effort) else model


def starts_warm(model: "HumanModel") -> bool:
    """Return whether a model's plans start from the rest of the last plan, whatever the configuration says."""
    return isinstance(model, Effort) and model.warm


def parse(name: object, models: Mapping[str, "HumanModel"]) -> "HumanModel | None":
    """Return the model of a name, with its effort if the name has one; None if it is no model's name.

    Args:
        name: such as ``tom``, ``tom@8``, ``tom+warm`` or ``tom@8+warm``.
        models: known models by name.
    """
    parts = NAME.fullmatch(name) if isinstance(name, str) else None
    if parts is None or parts["model"] not in models:
        return None
    model, steps, warm = models[parts["model"]], int(parts["steps"] or 0), parts["warm"] is not None
    if steps > MOST_ITERATIONS:
        return None
    return Effort(model, steps or None, warm) if steps or warm else model


def seconds_of(model: "HumanModel", costs: Mapping[str, float], usual: int) -> float | None:
    """Return T(M) of a model [s]; None where it does not follow from the costs.

    It is what the costs say for the model's name, or else for its name without ``+warm``, as a start costs nothing; or
    else it is proportional to the number of steps.

    Args:
        model: human model, with or without an effort.
        costs: T(M) by name [s].
        usual: number of steps of the model without an effort.
    """
    if model.name in costs or not isinstance(model, Effort):
        return costs.get(model.name)
    cold = replace(model, warm=False).name
    if cold in costs:
        return costs[cold]
    base = costs.get(model.model.name)
    return None if base is None or model.steps is None else base * model.steps / usual
