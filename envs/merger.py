"""Merger: the gap in the left lane is too small for the robot unless the human behind it yields."""

from ms_highway.envs.base import InteractionEnv
from ms_highway.game.scenario import COMMON_WEIGHTS, Scenario

__all__ = ["MERGER", "MergerEnv"]

MERGER = Scenario(
    name="merger",
    lanes=(-0.1, 0.0),
    cars=((-0.1, 0.0), (-0.2, -0.1), (0.05, -0.1)),
    steps=40,
    ladder=("naive", "turn", "tom"),
    prices=(0.6, 0.1),
    robot_weights=COMMON_WEIGHTS | {"target_lane": 150, "merged": 5},
    human_weights=COMMON_WEIGHTS | {"target_lane": 1000, "gap": 70},
    human_gap=0.25,
    merging_car=0,
)


class MergerEnv(InteractionEnv):
    """The robot on the right wants into the left lane, between a scripted car and the human behind it."""

    scenario = MERGER
