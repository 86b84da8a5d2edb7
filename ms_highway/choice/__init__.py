"""Choose, in every step and for every human, the model that is worth its computation.

`rule` defines rules and their two parts, estimators and choosers, and fixed orders of
models; `records` is what they take and return, and `checks` refuses what a user's parts
may not return. Two estimators say what models would gain: `quadratic` is the paper's
Algorithm 1, `learned_value` expects gains from a `situation`. Choosers weigh gains
against a price (`choosers`) or fit them into a time (`budget`). `belief` infers whether
humans respond. `shipped` names the scenes for which the package has costs and values.

Imports `ms_highway.planning` and the packages below it.
"""
