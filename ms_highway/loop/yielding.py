"""Drive as humans who yield never, or always, whatever it earns them."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.game import Game
from ms_highway.loop.controller import ControlStep
from ms_highway.runtime.arrays import SameArray, State

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

    def step(self, state: State, before: State | None = None) -> ControlStep:
        """Return the control of the coming step; ``before`` is ignored."""
        control = unmoved_control(self.game, np.asarray(state, dtype=float), self.yields)
        kept = np.tile(control, (self.game.planner.horizon, 1))
        return ControlStep(control, kept, np.zeros((1, *kept.shape)), ("always" if self.yields else "never",))


def unmoved_control(game: Game, state: Float[SameArray, "cars 4"], yields: Any) -> Float[SameArray, "2"]:
    """Return the control, not scaled, of car 0, which yields to car 1 always, or else never; see `Unmoved`."""
    xp, scene, own, others = state.__array_namespace__(), game.scene, state[0], state[1:]
    length, width = xp.asarray(scene.car_size)[0], xp.asarray(scene.lane_width)
    along, aside = others[:, 0] - own[0], xp.abs(others[:, 1] - own[1])
    gaps, closing = xp.maximum(along - length, CLOSEST), xp.maximum(own[3] - others[:, 3], 0.0)
    partner = xp.arange(len(others)) == 0
    ahead = (along > 0) & (aside < width / 2) & (yields | ~partner)
    braking = xp.max(xp.where(ahead, closing**2 / (2 * gaps), 0.0))
    between = xp.any(ahead & (along < along[0]) & ~partner)
    beside = (-length / 2 < along[0]) & (along[0] < length + ROOM) & (aside[0] < BESIDE * width)
    braking = xp.where(yields & beside & ~between, xp.maximum(braking, MAKING_ROOM), braking)
    kept = keep_velocity(game.world, own)
    hardest = xp.minimum(HARDEST, own[3] / xp.asarray(game.world.time_step))
    return xp.stack([kept[0], kept[1] - xp.minimum(braking, hardest)])
