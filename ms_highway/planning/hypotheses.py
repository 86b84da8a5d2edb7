"""Predict the next control of every human under each of `ms_highway.planning.ladders.PACKAGE_MODELS`.

`ms_highway.choice.belief` compares these with what humans do.
"""

from dataclasses import replace
from typing import Any

from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.game import Game, constant_velocity, each_human, pair, swap_players
from ms_highway.game.planning_settings import PlanningSettings, gradient_steps, longest_step
from ms_highway.planning.human_models import following_control
from ms_highway.planning.plans import Plan, plan_against
from ms_highway.runtime.arrays import Control, Controls, Index, State

LOOKAHEAD = 8  # steps of humans' plans at most; only the first one counts


def next_controls(game: Game, state: State, robot: Controls) -> Float[Any, "humans models 2"]:
    """Return the next control of every human under each model, unscaled.

    * naive keeps the velocity.
    * idm keeps the heading and follows the car ahead in its lane, such as the robot; its desired speed is the limit.
    * turn and tom plan for the human's reward, as the robot believes it. Under turn, the robot keeps its velocity,
      under tom, it follows its plan. All others keep their velocity. Humans plan by gradient steps over `LOOKAHEAD`
      steps at most: in Dense Merge this is closer to how they drive than shorter plans by Newton steps.

    Args:
        game: with the humans' rewards as the robot believes them.
        state: all cars.
        robot: scaled controls that the robot follows from this state on.
    """
    planner = replace(game.planner, solver="gradient")
    shortened = planner.horizon > LOOKAHEAD
    if shortened:
        iterations, usual = gradient_steps(PlanningSettings(LOOKAHEAD))
        length = jnp.minimum(usual, longest_step(LOOKAHEAD, game.dynamics.time_step))
        planner = replace(planner, horizon=LOOKAHEAD, iterations=iterations, step_size=length)
    game = replace(game, planner=planner)

    def predict(human: Index) -> Float[Any, "models 2"]:
        own, seen = swap_players(game, state, human)
        start = constant_velocity(own, seen[0]) if shortened else jnp.zeros((planner.horizon, 2))

        def answer(robot: Controls) -> Control:
            plan = plan_against(own, seen, robot[None], Plan(start, robot[None]))
            return plan.robot[0] * planner.control_scale

        answers = [answer(each) for each in (constant_velocity(own, seen[1]), robot[: planner.horizon])]
        following = following_control(*pair(game, state, human))
        return jnp.stack([keep_velocity(game.dynamics, seen[0]), following, *answers])

    return each_human(game, predict)
