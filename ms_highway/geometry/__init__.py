"""Curves, lanes of highway-env networks joined to curves, and coordinates along them.

Imports `ms_highway.numerics` and what stands below it.
"""
