"""Draw figures and tables of learned rewards; learn nothing.

Imports what `ms_highway.visualization` may import.
"""
