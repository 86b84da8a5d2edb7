"""Define the game of a robot with several humans, each of whom has a reward of its own.

States are arrays [cars, 4]: the robot, then all humans, then the scripted cars. Controls are scaled, see
`ms_highway.game.game`. With one human, it is the game of two players.
"""

from dataclasses import dataclass, replace

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.dynamics import Motion, coast
from ms_highway.game.features import motion_reward
from ms_highway.game.game import Game
from ms_highway.game.reward import Reward
from ms_highway.game.scene import Scene
from ms_highway.optimization.second_derivatives import Trajectory
from ms_highway.runtime.arrays import Array, unrolled_sum

__all__ = ["Crowd", "along_others", "coasting", "human_game", "others_of", "pair"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Crowd:
    """The game of a robot with several humans.

    Attributes:
        game: of the robot with any one of the humans: scene, the robot's reward, dynamics and planner.
        weights: of every human's reward, in the order of the features of ``game.human``.
    """

    game: Game
    weights: Float[Array, "humans features"]

    @property
    def humans(self) -> int:
        """Number of humans."""
        return int(np.shape(self.weights)[0])


def human_game(crowd: Crowd, human: int | Int[jax.Array, ""]) -> Game:
    """Return the game in which a human plans, and the robot is its partner."""
    game = crowd.game
    weights = jnp.asarray(crowd.weights)[human]
    return replace(game, robot=replace(game.human, weights=weights), human=game.robot)


def pair(
    crowd: Crowd, state: Float[jax.Array, "cars 4"], human: int | Int[jax.Array, ""]
) -> tuple[Game, Float[jax.Array, "cars 4"]]:
    """Return the game of the robot with one of the humans, and its state: robot, this human, all others.

    The others count as scripted: they keep their velocity.
    """
    game = replace(crowd.game, human=replace(crowd.game.human, weights=jnp.asarray(crowd.weights)[human]))
    others = jnp.asarray(others_of(len(state) - 1))[human]
    return game, jnp.concatenate([state[:1], state[1:][human][None], state[1:][others]])


def others_of(cars: int) -> Int[np.ndarray, "cars others"]:
    """Return for each of some cars the numbers of all others, in ascending order."""
    return np.array([[other for other in range(cars) if other != car] for car in range(cars)], int).reshape(cars, -1)


def coasting(game: Game, states: Float[jax.Array, "cars 4"]) -> Float[jax.Array, "cars fields steps"]:
    """Return the trajectories of cars that keep their velocity."""
    return jnp.stack(coast(game.dynamics, states, game.planner.horizon), axis=1)


def along_others(
    scene: Scene, driver: Reward, own: Trajectory, others: Float[jax.Array, "others fields steps"]
) -> Float[jax.Array, ""]:
    """Sum a driver's reward over the steps of its trajectory among those of all others, its partner first."""
    return unrolled_sum(motion_reward(scene, driver, Motion(*own), Motion(*jnp.moveaxis(others, 1, 0))))
