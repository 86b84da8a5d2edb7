"""State what robot and humans play: dynamics, scenes, rewards and scenarios.

Imports `ms_highway.optimization` and what stands below it.
"""
