"""Drive in recorded traffic: CommonRoad scenarios as an environment, with their
planning problems.

Imports `ms_highway.road` and what stands below it.
"""

from ms_highway.recorded.environment import RecordedEnv

__all__ = ["RecordedEnv"]
