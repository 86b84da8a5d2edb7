"""Learn values of computation: courses to learn on, rollouts of each model, fitting of the network.

Imports `ms_highway.loop`, `ms_highway.envs` and what stands below them.
"""
