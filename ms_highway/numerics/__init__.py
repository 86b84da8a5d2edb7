"""Optimise functions of controls: second derivatives, solvers, step sizes.

Imports `ms_highway.runtime` only.
"""
