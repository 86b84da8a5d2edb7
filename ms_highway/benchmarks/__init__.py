"""Measure latency and throughput, also beside the same planners in CasADi.

Imports `ms_highway.experiments` and what stands below it.
"""
