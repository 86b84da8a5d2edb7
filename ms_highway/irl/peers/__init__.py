"""Predictors of the literature, beside which a learned reward is judged."""
