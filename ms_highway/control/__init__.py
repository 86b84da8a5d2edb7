"""Drive a car live: one driver for all rules and numbers of humans, drivers of roads, and what they fall back on.

Imports `ms_highway.metareasoning` and what stands below it.
"""
