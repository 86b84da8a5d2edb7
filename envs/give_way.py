"""Give Way: the human wants into the robot's lane, and the robot is paid for letting it in."""

from math import sqrt

from ms_highway.envs.base import InteractionEnv
from ms_highway.game.scenario import COMMON_WEIGHTS, Scenario

__all__ = ["GIVE_WAY", "GiveWayEnv"]

GIVE_WAY = Scenario(
    name="give_way",
    lanes=(-0.1, 0.0),
    cars=((-0.275, -0.1), (-0.275, 0.0), (0.05, -0.1), (-0.6, -0.1)),
    steps=40,
    ladder=("naive", "turn", "tom"),
    prices=(0.03, 0.01),
    robot_weights=COMMON_WEIGHTS | {"target_lane": 1000, "gap": 10, "partner_target_lane": 350, "partner_merged": 5},
    human_weights=COMMON_WEIGHTS | {"target_lane": 0.7 * 150},
    robot_gap=0.325,
    merging_car=1,
    corner=0.675 / sqrt(2),
)


class GiveWayEnv(InteractionEnv):
    """The robot drives in the left lane between two scripted cars; the human beside it wants to merge."""

    scenario = GIVE_WAY
