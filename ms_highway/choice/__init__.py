"""Decide which human model is worth its computation: Algorithm 1 of the paper.

Imports `ms_highway.planning` and what stands below it.
"""
