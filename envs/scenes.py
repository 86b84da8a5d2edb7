"""The environments of the package's scenarios."""

from ms_highway.envs.base import InteractionEnv
from ms_highway.game.scenarios import (
    CROSSING_CROWD,
    DENSE_MERGE,
    DENSE_MERGE_V1,
    GIVE_WAY,
    GIVE_WAY_V1,
    MERGER,
    MERGER_V1,
    STAY_BACK,
    STAY_BACK_V1,
)


class StayBackEnv(InteractionEnv):
    """The robot on the left and the human on the right approach cones that only one car at a time can pass."""

    scenario = STAY_BACK


class MergerEnv(InteractionEnv):
    """The robot on the right wants into the left lane, between a scripted car and the human behind it."""

    scenario = MERGER


class GiveWayEnv(InteractionEnv):
    """The robot drives in the left lane between two scripted cars; the human beside it wants to merge."""

    scenario = GIVE_WAY


class StayBackV1Env(InteractionEnv):
    """Stay Back within what tyres hold: plans last two seconds, and the human starts ahead of the robot."""

    scenario = STAY_BACK_V1


class MergerV1Env(InteractionEnv):
    """Merger within what tyres hold: plans of a second."""

    scenario = MERGER_V1


class GiveWayV1Env(InteractionEnv):
    """Give Way within what tyres hold: plans of a second."""

    scenario = GIVE_WAY_V1


class DenseMergeEnv(InteractionEnv):
    """The robot's lane ends; it has to get into a stream of humans in the lane beside it."""

    scenario = DENSE_MERGE


class DenseMergeV1Env(InteractionEnv):
    """A careful robot has to get into a denser stream, whose humans yield; plans of a second, within tyres."""

    scenario = DENSE_MERGE_V1


class CrossingCrowdEnv(InteractionEnv):
    """The robot crosses one stream of humans to join another, so that other humans matter early and late."""

    scenario = CROSSING_CROWD
