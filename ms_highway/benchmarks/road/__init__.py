"""Drive stock scenes of highway-env with this package's drivers and with peers, in the same episodes, and measure both.

Imports what `ms_highway.benchmarks` may import; `ms_highway.benchmarks.road.names` imports nothing that computes.
"""
