"""The scenes of a robot among several humans."""

from ms_highway.envs.crowd.base import CrowdEnv
from ms_highway.game.crowd_scenario import CROSSING_CROWD, DENSE_MERGE

__all__ = ["CrossingCrowdEnv", "DenseMergeEnv"]


class DenseMergeEnv(CrowdEnv):
    """The robot's lane ends; it has to get into a stream of humans in the lane beside it."""

    scenario = DENSE_MERGE


class CrossingCrowdEnv(CrowdEnv):
    """The robot crosses one stream of humans to join another, so that other humans matter early and late."""

    scenario = CROSSING_CROWD
