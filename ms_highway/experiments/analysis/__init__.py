"""Analyse records: summaries, trade-offs, regrets, findings in words, and the selection that is shown.

Imports what `ms_highway.experiments` may import.
"""
