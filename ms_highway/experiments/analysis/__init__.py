"""Analyse records: summaries, regrets, findings in words, and the selection that is shown.

Imports what `ms_highway.experiments` may import.
"""
