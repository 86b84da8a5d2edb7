"""Plan on any road, in road coordinates: proposals, predictions of traffic, answers and checks.

May import ``game``, ``optimization`` and ``runtime``.
"""
