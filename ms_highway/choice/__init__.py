"""Choose, in every step and for every human, the model that is worth its computation.

`rule` defines the interface of all rules, and two simple ones: fixed orders of models, and the top model for the
nearest humans. `quadratic` is the paper's Algorithm 1. `learned_value` chooses by learned values of a `situation`,
`budget` within a time. `belief` infers whether humans respond.

Imports `ms_highway.planning` and the packages below it.
"""
