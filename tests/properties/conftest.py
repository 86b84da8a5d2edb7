"""Settings of the tests whose examples Hypothesis draws.

They are few and the same in every run. A failure prints the smallest example.
"""

from hypothesis import settings

settings.register_profile(
    "few", max_examples=50, deadline=None, derandomize=True, database=None
)
settings.load_profile("few")
