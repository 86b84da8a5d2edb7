"""Compare controllers over many episodes, live or many at a time; search for the best choices, and learn them.

Imports `ms_highway.irl` and what stands below it.
"""
