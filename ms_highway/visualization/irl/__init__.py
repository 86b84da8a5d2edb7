"""Figures and tables of learned rewards: recovery, prediction, tables; they show data and learn nothing themselves.

Imports what `ms_highway.visualization` may import.
"""
