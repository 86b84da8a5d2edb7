"""Plan under each human model of the ladder, pure and compiled.

Imports `ms_highway.data` and what stands below it.
"""
