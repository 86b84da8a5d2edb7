"""Learn a human's reward from recordings: windows, maximum entropy, prediction, evaluation, recovery.

Imports `ms_highway.envs` and what stands below it.
"""
