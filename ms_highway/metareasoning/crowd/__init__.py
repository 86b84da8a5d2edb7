"""Choose a human model for each of several humans: Algorithm 1 for each, learned values, budgets, baselines.

Imports the rest of `ms_highway.metareasoning` and what stands below it.
"""
