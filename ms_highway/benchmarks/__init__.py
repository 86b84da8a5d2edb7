"""Measure latency and throughput, and the performance of drivers on stock roads.

Imports `ms_highway.experiments` and what stands below it.
"""
