"""Run the closed loop in pure JAX: many episodes at once, on all devices.

Imports `ms_highway.control` and what stands below it.
"""
