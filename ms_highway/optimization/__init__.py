"""Optimise functions of controls and know no cars: second derivatives, solvers, step sizes, trust region.

Imports `ms_highway.runtime` only.
"""
