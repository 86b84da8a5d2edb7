"""Draw tables, figures, pages and films from records; decides nothing.

Imports `ms_highway.experiments` and what stands below it.
"""
