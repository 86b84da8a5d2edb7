"""Observe a highway-env road from a vehicle as arrays of fixed shapes.

The arrays describe its route, its lanes and the paths of others. Imports
`ms_highway.geometry` and what stands below it.
"""
