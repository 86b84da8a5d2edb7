"""Plan under each human model of the ladder, pure and compiled.

Imports `ms_highway.game` and what stands below it.
"""
