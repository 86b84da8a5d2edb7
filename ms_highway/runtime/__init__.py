"""Serve every other package and know no driving: JAX settings, compilation, timing,
files, interrupts.

Imports nothing else of ms_highway.
"""
