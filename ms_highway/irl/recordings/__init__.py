"""Read, record and smooth driving: Minari data sets, CommonRoad scenarios, demonstrators.

Imports `ms_highway.envs` and what stands below it.
"""
