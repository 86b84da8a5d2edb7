"""Stay Back: cones narrow the road, and two cars side by side do not fit between them."""

from ms_highway.envs.base import InteractionEnv
from ms_highway.game.scenario import COMMON_WEIGHTS, Scenario

__all__ = ["STAY_BACK", "StayBackEnv"]

STAY_BACK = Scenario(
    name="stay_back",
    lanes=(-0.14, 0.0),
    cars=((-0.9, -0.14), (-0.9, 0.0)),
    steps=35,
    ladder=("naive", "turn"),
    prices=(5.0, 0.4),
    robot_weights=COMMON_WEIGHTS,
    human_weights=COMMON_WEIGHTS,
    cones=(
        (-0.25, -0.18),
        (-0.2, -0.17),
        (-0.15, -0.15),
        (-0.1, -0.15),
        (-0.1, 0.01),
        (-0.15, 0.01),
        (-0.2, 0.03),
        (-0.25, 0.04),
    ),
)


class StayBackEnv(InteractionEnv):
    """The robot on the left and the human on the right approach cones that only one car at a time can pass."""

    scenario = STAY_BACK
