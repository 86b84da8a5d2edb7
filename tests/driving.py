"""Drive among one human or several, live and in batches, without environments; share a
ladder, a model and a game.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.choice.rule import PUBLISHED_COSTS
from ms_highway.game.dynamics import keep_velocity, step, within_grip
from ms_highway.game.game import swap_roles
from ms_highway.game.scenario import build_game
from ms_highway.game.scenarios import DENSE_MERGE
from ms_highway.loop.batch import simulate
from ms_highway.loop.driver import fixed
from ms_highway.loop.records import DECIDES, HUMAN_PLANS, Episodes
from ms_highway.numerics.solvers import Newton
from ms_highway.planning.costs import Costs
from ms_highway.planning.human_models import PredictedHuman, TheoryOfMind
from ms_highway.planning.ladders import ladder
from ms_highway.planning.plans import Plan

LADDER = ladder(("naive", "turn", "tom"))
COSTS = Costs.of(PUBLISHED_COSTS, 1)


@dataclass(frozen=True)
class Brakes(PredictedHuman):
    """A user-defined model: the human brakes by a constant deceleration [m/s^2]."""

    name: ClassVar[str] = "brakes"
    deceleration: float

    def predict(self, game, state, start=None):
        return [
            keep_velocity(game.dynamics, state[1]) - jnp.array([0.0, self.deceleration])
        ] * game.planner.horizon


@dataclass(frozen=True)
class Brief(TheoryOfMind):
    """Theory of mind in fewer steps, which are longer under `Ascent`."""

    name: ClassVar[str] = "brief"

    def solver(self, game):
        usual = game.planner.solver
        if isinstance(usual, Newton):
            return replace(usual, joint_steps=2)
        return replace(usual, iterations=8, step_size=2 * usual.step_size)


@dataclass(frozen=True)
class Eager(TheoryOfMind):
    """Theory of mind that begins with a robot and a human who brake."""

    name: ClassVar[str] = "eager"

    def start(self, game, state, last):
        braking = np.float32([0.0, -0.2])
        return Plan(last.robot + braking, last.humans + braking)


def dense_merge(humans):
    """Build the game of Dense Merge with its limits."""
    return build_game(
        DENSE_MERGE,
        control_limit=DENSE_MERGE.control_limit,
        grip=DENSE_MERGE.grip,
        humans=humans,
    )


def move(game, state, controls):
    """Return the state after the controls of robot and humans, within the grip as
    vehicles are.
    """
    world = jax.tree.map(float, game.world)
    if game.planner.grip is not None:
        controls = within_grip(
            world,
            float(game.planner.grip),
            state[: len(controls), 3],
            np.array(controls),
        )
    return step(
        world,
        state,
        np.concatenate([controls, keep_velocity(world, state[len(controls) :])]),
    )


def drive(driver, start, steps, humans=None):
    """Return the states and the robot's steps. Humans drive as given or, by default,
    plan for their rewards.
    """
    game = driver.game
    humans = humans or [fixed(swap_roles(game, human)) for human in range(game.number)]
    states = [np.asarray(start, float)]
    driven = []
    for _ in range(steps):
        now = states[-1]
        driven.append(driver.step(now))
        views = [
            np.concatenate([now[[car, 0]], np.delete(now, [0, car], 0)])
            for car in range(1, 1 + len(humans))
        ]
        others = [
            human.step(view).control for human, view in zip(humans, views, strict=True)
        ]
        states.append(move(game, now, [driven[-1].control, *others]))
    return np.array(states), driven


def episodes_of(loop, starts, steps=5, schedule=DECIDES, drivers=HUMAN_PLANS):
    """Return episodes of a game; arguments for one episode serve all of them."""
    number = len(starts)
    humans = loop.game.number
    robot = loop.game.robot.weights
    others = loop.game.humans.weights
    return Episodes(
        np.asarray(starts, np.float32),
        np.full(number, 0.1, np.float32),
        np.broadcast_to(np.asarray(schedule, np.int32), (number, steps, humans)),
        np.broadcast_to(robot, (number, *robot.shape)),
        np.broadcast_to(others, (number, *others.shape)),
        np.broadcast_to(np.asarray(drivers, np.int32), (number, humans)),
    )


def simulated(loop, *arguments):
    """Simulate episodes of a game and return their records, see `episodes_of`."""
    return simulate(loop, episodes_of(loop, *arguments))
