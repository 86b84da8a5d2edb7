"""Draw tables, figures, a page and films from records; decides nothing.

Imports `ms_highway.experiments` and what stands below it.
"""
