"""Decide which human model is worth its computation.

`rule` defines what a rule sees and returns, and fixed orders of models; `quadratic` is the paper's Algorithm 1,
`learned_value` chooses by learned values of `situation`, `nearest` by distance, `budget` within a time. `belief` infers
whether humans respond.

Imports `ms_highway.planning` and what stands below it.
"""
