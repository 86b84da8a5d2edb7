"""Drive humans who never yield to the robot, or always do. Neither plans.

Everything here works for arrays of NumPy and of JAX.
"""

from dataclasses import dataclass
from functools import partial

from jaxtyping import Bool, Float

from ms_highway.game.car_following import CAR_LIMITS
from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.game import Game
from ms_highway.runtime.arrays import SameArray


@dataclass(frozen=True)
class YieldingSettings:
    """Set how the drivers of this module brake, and make room for the robot."""

    room: float = 8.0
    """Gap that is made for the robot, between bumpers [m]."""

    lanes: float = 1.5
    """Distance to the side within which a human makes room [lanes]."""

    deceleration: float = 3.0
    """Deceleration to make room [m/s^2]."""

    max_deceleration: float = CAR_LIMITS.braking
    """Largest deceleration, also for a car ahead [m/s^2]."""

    min_gap: float = 0.5
    """Gap to a car ahead below which braking grows no further [m]."""


YIELDING = YieldingSettings()


def unmoved_control(
    game: Game,
    state: Float[SameArray, "cars 4"],
    yields: bool | Bool[SameArray, ""],
) -> Float[SameArray, "2"]:
    """Return the control, not scaled, of car 0, which always yields to car 1, or never.

    Car 1 is the robot. Car 0 keeps its velocity, and brakes in time for a slower car
    ahead in its lane. If it never yields, it ignores the robot. If it always yields, it
    brakes for a robot in its lane or the next one as soon as the robot's front has
    passed its own centre, until there is room for the robot, unless another car is
    between them.
    """
    xp = state.__array_namespace__()  # of NumPy or JAX
    scene = game.scene
    own = state[0]
    others = state[1:]
    length = xp.asarray(scene.car_size)[0]
    width = xp.asarray(scene.lane_width)

    # Where the others are to this car, and how fast it closes in on them: [others].
    along = others[:, 0] - own[0]
    aside = xp.abs(others[:, 1] - own[1])
    gaps = xp.maximum(along - length, YIELDING.min_gap)
    closing = xp.maximum(own[3] - others[:, 3], 0.0)

    # Brake in time for cars ahead, by v^2 / (2 gap).
    is_robot = xp.arange(len(others)) == 0
    ahead = (along > 0) & (aside < width / 2) & (yields | ~is_robot)
    braking = xp.max(xp.where(ahead, closing**2 / (2 * gaps), 0.0))

    # Make room for a robot that is beside this car or in front of it.
    is_between = ahead & (along < along[0]) & ~is_robot
    between = xp.any(is_between)
    near = (
        (-length / 2 < along[0])
        & (along[0] < length + YIELDING.room)
        & (aside[0] < YIELDING.lanes * width)
    )
    braking = xp.where(
        yields & near & ~between,
        xp.maximum(braking, YIELDING.deceleration),
        braking,
    )

    # Otherwise keep the velocity, and never reverse.
    coasting = keep_velocity(game.world, own)
    until_standing = own[3] / xp.asarray(game.world.time_step)
    hardest = xp.minimum(YIELDING.max_deceleration, until_standing)
    acceleration = coasting[1] - xp.minimum(braking, hardest)
    return xp.stack([coasting[0], acceleration])


never_yields = partial(unmoved_control, yields=False)
always_yields = partial(unmoved_control, yields=True)
