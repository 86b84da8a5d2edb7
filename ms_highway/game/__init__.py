"""State what robot and humans play: dynamics, scenes, rewards and scenarios.

Imports `ms_highway.geometry` and what stands below it.
"""
