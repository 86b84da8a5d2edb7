"""Optimise functions of controls and know no roads: second derivatives, solvers, step
sizes.

Imports `ms_highway.runtime` only.
"""
