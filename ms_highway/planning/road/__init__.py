"""Plan on any road, in road coordinates: proposals, predictions of traffic, refined plans and their checks.

May import ``game``, ``optimization`` and ``runtime``.
"""
