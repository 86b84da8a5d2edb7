"""State what robot and humans play: dynamics, scenes, rewards and scenarios.

Imports `ms_highway.numerics` and what stands below it.
"""
