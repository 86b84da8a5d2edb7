"""Drive in recorded traffic: CommonRoad scenarios as an environment, with their planning problems.

Imports what `ms_highway.envs` does.
"""
