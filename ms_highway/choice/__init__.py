"""Choose, in every step and for every human, the model that is worth its computation.

`rule` defines the interface of all rules, and fixed orders of models. `quadratic` is the paper's Algorithm 1.
`learned_value` chooses by learned values of a `situation`, `nearest` by distance, and `budget` within a time. `belief`
infers whether humans respond.

Imports `ms_highway.planning` and the packages below it.
"""
