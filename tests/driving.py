"""Drive among one human or several, live and in batches, without environments."""

import jax
import numpy as np

from ms_highway.game.dynamics import keep_velocity, step, within_grip
from ms_highway.game.game import swap_roles
from ms_highway.loop.batch import simulate
from ms_highway.loop.driver import fixed
from ms_highway.loop.records import DECIDES, USUAL, Episodes

SCENES = {1: "merger", 2: "dense_merge"}
"""Scenarios by number of humans."""


def move(game, state, controls):
    """Return the state after the controls of robot and humans, within the grip as vehicles are."""
    world = jax.tree.map(float, game.world)
    if game.planner.grip is not None:
        controls = within_grip(world, float(game.planner.grip), state[: len(controls), 3], np.array(controls))
    return step(world, state, np.concatenate([controls, keep_velocity(world, state[len(controls) :])]))


def drive(driver, start, steps, truth=None, humans=None, errors=None):
    """Return the states and the robot's steps among humans who plan for their rewards in the game, or given ones.

    With errors, the robot sees its and the humans' states so far off in each step.
    """
    truth = truth or driver.game
    humans = humans or [fixed(swap_roles(truth, human)) for human in range(truth.number)]
    states, driven = [np.asarray(start, float)], []
    for number in range(steps):
        now = states[-1]
        seen = now.copy()
        seen[: 1 + truth.number] += 0.0 if errors is None else errors[number]
        driven.append(driver.step(seen))
        views = [np.concatenate([now[[car, 0]], np.delete(now, [0, car], 0)]) for car in range(1, 1 + len(humans))]
        others = [human.step(view).control for human, view in zip(humans, views, strict=True)]
        states.append(move(truth, now, [driven[-1].control, *others]))
    return np.array(states), driven


def episodes(game, starts, steps=5, schedule=DECIDES, price=0.1, weights=None, yielding=USUAL, errors=None):
    """Return episodes of a game from some starts; what is given for all of them is repeated."""
    number, humans = len(starts), game.number
    weights = game.humans.weights if weights is None else weights
    return Episodes(
        np.asarray(starts, np.float32),
        np.broadcast_to(np.float32(price), number),
        np.broadcast_to(np.asarray(schedule, np.int32), (number, steps, humans)),
        np.broadcast_to(game.robot.weights, (number, *game.robot.weights.shape)),
        np.broadcast_to(weights, (number, *game.humans.weights.shape)),
        np.broadcast_to(np.asarray(yielding, np.int32), (number, humans)),
        errors,
    )


def simulated(loop, starts, *options, **more):
    """Return the records of such episodes."""
    return simulate(loop, episodes(loop.game, starts, *options, **more))
