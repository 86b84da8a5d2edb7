"""Drive as humans who yield never, or always, whatever it earns them."""

import numpy as np
from jaxtyping import Float

from ms_highway.control.controller import ControlStep
from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.game import Game

__all__ = ["Unmoved"]

ROOM = 8.0  # m between bumpers, that is made for the robot
MAKING_ROOM = 3.0  # m/s^2, of braking for it
HARDEST = 8.0  # m/s^2
CLOSEST = 0.5  # m, gap from which on braking grows no more
BESIDE = 1.5  # lanes to the side, up to which room is made


class Unmoved:
    """Keep the velocity, and brake in time for a slower car ahead in the own lane; plan nothing.

    Who never yields takes no notice of car 1, the robot. Who always does brakes for it as soon as its front has passed
    the own centre, in the own lane or beside it, until there is room for it, unless somebody is between them.

    Args:
        game: of which car 0 is driven.
        yields: whether it always yields.
    """

    def __init__(self, game: Game, yields: bool) -> None:
        self.game, self.yields = game, yields

    def reset(self) -> None:
        """Nothing is remembered."""

    def reset_partner(self) -> None:
        """Nothing is remembered."""

    def step(
        self, state: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None = None
    ) -> ControlStep:
        """Return the control of the coming step; ``before`` is ignored."""
        scene, own, others = self.game.scene, state[0], state[1:]
        length, width = float(np.asarray(scene.car_size)[0]), float(scene.lane_width)
        along, aside = others[:, 0] - own[0], np.abs(others[:, 1] - own[1])
        gaps, closing = np.maximum(along - length, CLOSEST), np.maximum(own[3] - others[:, 3], 0.0)
        ahead = (along > 0) & (aside < width / 2)
        ahead[0] &= self.yields
        braking = np.where(ahead, closing**2 / (2 * gaps), 0.0).max()
        between = ahead[1:] & (along[1:] < along[0])
        if self.yields and -length / 2 < along[0] < length + ROOM and aside[0] < BESIDE * width and not between.any():
            braking = max(braking, MAKING_ROOM)
        control = keep_velocity(self.game.world, own)
        control[1] -= min(braking, HARDEST, own[3] / float(self.game.world.time_step))
        kept = np.tile(control, (self.game.planner.horizon, 1))
        name = "always" if self.yields else "never"
        return ControlStep(control, kept, np.zeros_like(kept), name, 0.0)
