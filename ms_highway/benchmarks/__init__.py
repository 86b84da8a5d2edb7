"""Measure latency and throughput, how steady driving is, and how drivers fare on stock roads.

Imports `ms_highway.experiments` and what stands below it.
"""
