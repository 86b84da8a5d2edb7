"""The commands ``ms-highway irl ...``, a file for each; `options` has what they share.

Imports what `ms_highway.cli` may import.
"""
