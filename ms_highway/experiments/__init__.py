"""Run and analyse comparisons: episodes, records, sweeps, frontiers, safety, validation, provenance.

Imports `ms_highway.irl` and what stands below it; draws nothing.
"""
