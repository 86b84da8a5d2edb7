"""Compare controllers over many episodes, live or in batches.

Also search for the best choices of models, and learn them. Imports `ms_highway.irl` and
the packages below it.
"""
