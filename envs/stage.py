"""What the environments share: the road that is drawn, and a driver's reward by feature."""

import jax
import numpy as np
from highway_env.road.lane import LineType, StraightLane
from highway_env.road.road import RoadNetwork
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game import Game
from ms_highway.reward import Reward, features
from ms_highway.scene import Scene

__all__ = ["evaluate", "straight_road"]

ROAD_BEHIND, ROAD_AHEAD = -100.0, 300.0  # m, ends of the drawn road


@jax.jit
def evaluate(scene: Scene, driver: Reward, states: Float[jax.Array, "cars 4"]) -> Float[jax.Array, "2 features"]:
    """The features phi of car 0's state, and what each of them adds to its reward, in one transfer."""
    phi = features(scene, driver, states)
    return jnp.stack([phi, phi * driver.weights])


def straight_road(game: Game) -> RoadNetwork:
    """The lanes of a game's scene as highway-env's road network, with the robot's speed limit."""
    scene = game.scene
    network, lanes = RoadNetwork(), np.asarray(scene.lanes, dtype=float)
    for place, y in enumerate(lanes):
        right = LineType.CONTINUOUS_LINE if place == len(lanes) - 1 else LineType.STRIPED
        apart = place > 0 and y - lanes[place - 1] > 1.01 * float(scene.lane_width)
        left = LineType.CONTINUOUS_LINE if place == 0 else LineType.STRIPED if apart else LineType.NONE
        ends = [ROAD_BEHIND, y], [ROAD_AHEAD, y]
        limit = float(game.robot.speed_limit)
        lane = StraightLane(*ends, width=float(scene.lane_width), line_types=[left, right], speed_limit=limit)
        network.add_lane("start", "end", lane)
    return network
