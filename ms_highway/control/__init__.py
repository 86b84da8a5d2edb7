"""Drive a car live: controllers with one model, a schedule or switching, and what they fall back on.

Imports `ms_highway.metareasoning` and what stands below it.
"""
