"""Serve every other package: JAX settings, compilation, timing, files, interrupts.

This package knows no driving, and imports nothing else of ms_highway.
"""
