"""Drive in closed loop: live, by any rule among any number of humans, and many episodes
at once in JAX.

Imports `ms_highway.choice` and what stands below it.
"""
