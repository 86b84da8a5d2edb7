"""Compute the influence of a human on the robot: what the robot earns through it.

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
        human: index of the human.
        robot: trajectory of the robot.
        others: trajectories of all cars around the robot.
    """
    if isinstance(human, int):
        rest = jnp.delete(others, human, axis=0)
    else:
        indices = jnp.asarray(others_of(len(others)))  # [cars, cars - 1]
        rest = others[indices[human]]
    return jnp.concatenate([robot[None], rest])


def slope_change(mixed_hessian: HessianBlocks, change: Trajectory) -> Trajectory:
    """Return how the slope in one trajectory changes if another one moves.

    It is ``einsum("fgt,ft->gt", mixed_hessian, change)``.

    Args:
        mixed_hessian: mixed second derivatives at each step, first in the fields of the
            trajectory that moves, then in those of the other one.
        change: of the trajectory that moves.
    """
    return jnp.sum(mixed_hessian * change[:, None], axis=0)


def pulled_back(
    slope: Trajectory,
    jacobian: Float[jax.Array, "fields steps n"],
) -> Float[jax.Array, "n"]:
    """Return the slope in n ravelled controls, ``S^T slope``, by the chain rule.

    Args:
        slope: in a trajectory.
        jacobian: S, of this trajectory in the controls.
    """
    flat = slope.ravel()  # [fields * steps]
    rows = jacobian.reshape(slope.size, -1)  # [fields * steps, n]
    return flat @ rows


def influence_of(
    jacobian: Float[jax.Array, "fields steps n"],
    adjoint: Vector,
    mixed_hessian: HessianBlocks,
) -> Trajectory:
    """Return the slope of R_R in s_R through a human: ``B_i^T S_i adjoint``.

    Args:
        jacobian: S_i of the human.
        adjoint: ``-H_i^-1 g_i`` or, in Newton steps, ``C_i^-1 g_i``.
        mixed_hessian: B_i.
    """
    path_change = jacobian @ adjoint
    return slope_change(mixed_hessian, path_change)


def mixed_hessian(game: Game, own: Trajectory, others: Trajectories) -> HessianBlocks:
    """Return B_i, the mixed second derivatives of a human's reward.

    The package's features are sums over the other cars. A mixed derivative in human and
    robot holds only the robot's term, so that all others are left out to save time.
    User-defined features need not be such sums.

    Args:
        game: from the human's side.
        own: trajectory of the human.
        others: trajectories of all others, the robot's first.

    Returns:
        At each step, derivatives in the human's fields, then in the robot's.
    """
    if not game.robot.user_features:
        # From the human's side, car 1 is the robot; no other leader is left.
        leader = 1 if game.scene.leader == 1 else None
        no_obstacles = game.scene.obstacles[:0]
        scene = replace(game.scene, obstacles=no_obstacles, leader=leader)
        game = replace(game, scene=scene)
        others = others[:1]
    return game.payoff.second_order(own, others).mixed_hessian
