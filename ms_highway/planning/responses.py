"""Compute what the robot earns through the response of a human to its plan.

The symbols are those of `ms_highway.planning.joint`.
"""

from dataclasses import replace

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.game import Game, others_of
from ms_highway.game.payoff import HessianBlocks
from ms_highway.runtime.arrays import Index, Trajectories, Trajectory, Vector


def trajectories_around(
    human: Index,
    robot: Trajectory,
    others: Trajectories,
) -> Trajectories:
    """Return the trajectories of all others from a human's side, the robot's first.

    Args:
        human: its number.
        robot: trajectory of the robot.
        others: trajectories of all cars around the robot.
    """
    if isinstance(human, int):
        rest = jnp.delete(others, human, axis=0)
    else:
        rest = others[jnp.asarray(others_of(len(others)))[human]]
    return jnp.concatenate([robot[None], rest])


def slope_change(coupling: HessianBlocks, change: Trajectory) -> Trajectory:
    """Return how the slope in one trajectory changes if another one moves.

    Args:
        coupling: mixed second derivatives at each step, first in the fields of the
            trajectory that moves, then in those of the other one.
        change: of the trajectory that moves.
    """
    return jnp.sum(coupling * change[:, None], axis=0)


def in_controls(
    slope: Trajectory,
    jacobian: Float[jax.Array, "fields steps n"],
) -> Float[jax.Array, "n"]:
    """Return the slope in n ravelled controls, ``S^T slope``, by the chain rule.

    Args:
        slope: in a trajectory.
        jacobian: S, of this trajectory in the controls.
    """
    return slope.ravel() @ jacobian.reshape(slope.size, -1)


def slope_through(
    jacobian: Float[jax.Array, "fields steps n"],
    answer: Vector,
    coupling: HessianBlocks,
) -> Trajectory:
    """Return the slope of R_R in s_R through a human: ``B_i^T S_i (-H_i^-1 g_i)``.

    Args:
        jacobian: S_i of the human.
        answer: ``-H_i^-1 g_i``, the human's response to the robot's wish.
        coupling: B_i.
    """
    return slope_change(coupling, jacobian @ answer)


def mixed_bends(game: Game, own: Trajectory, others: Trajectories) -> HessianBlocks:
    """Return B_i, the mixed second derivatives of a human's reward.

    The package's features are sums over the other cars, so that all but the robot are
    left out; user-defined features need not be such sums.

    Args:
        game: from the human's side.
        own: trajectory of the human.
        others: trajectories of all others, the robot's first.

    Returns:
        At each step, derivatives in the human's fields, then in the robot's.
    """
    if not game.robot.user_features:
        leader = 1 if game.scene.leader == 1 else None
        scene = replace(game.scene, obstacles=game.scene.obstacles[:0], leader=leader)
        game = replace(game, scene=scene)
        others = others[:1]
    return game.payoff.second_order(own, others).mixed_hessian
