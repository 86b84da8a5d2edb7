"""Serve every other package and know no driving: JAX settings, compilation, timing, files, interrupts, processes.

Imports nothing else of ms_highway.
"""
