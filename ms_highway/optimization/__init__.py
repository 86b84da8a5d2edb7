"""Optimise functions of controls and know no cars: second derivatives, ascent, gradient steps, trust region.

Imports `ms_highway.runtime` only.
"""
