"""Learn a human's reward from recordings: windows, maximum entropy, prediction, evaluation.

Imports `ms_highway.envs` and what stands below it.
"""
