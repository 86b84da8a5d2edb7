"""Drive in recorded traffic: CommonRoad scenarios as an environment.

`scenario` defines the records of a recording, whatever the format of its file.
`commonroad` reads them from a file, `elements` the numbers and shapes in its XML, and
`opening` keeps what has been read. `network` turns lanelets into lanes of highway-env,
and `straight_road` straightens these. `traffic` moves the vehicles, `planning_problem`
says what the ego has to do, and `environment` joins them.

Imports `ms_highway.road` and what stands below it.
"""

from ms_highway.recorded.environment import RecordedEnv

__all__ = ["RecordedEnv"]
