"""Drive in recorded traffic: CommonRoad scenarios as an environment.

Imports `ms_highway.road` and what stands below it.
"""

from ms_highway.recorded.environment import RecordedEnv

__all__ = ["RecordedEnv"]
