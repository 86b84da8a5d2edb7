"""Measure latency and throughput, also beside the same planners in CasADi, and how steady driving is.

Imports `ms_highway.experiments` and what stands below it.
"""
