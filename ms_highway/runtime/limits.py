"""Annotate numbers of configurations with their limits.

The ``description`` of a `msgspec.Meta` is the remedy: it ends the message about a
number beyond the limits.
"""

from typing import Annotated

import numpy as np
from msgspec import Meta

LARGEST = float(np.finfo(np.float32).max)
"""The largest number that single precision holds."""

Number = Annotated[
    float,
    Meta(
        ge=-LARGEST,
        le=LARGEST,
        description=f"it must be a number of at most {LARGEST:.2g}",
    ),
]
Positive = Annotated[
    float, Meta(gt=0, le=LARGEST, description="it must be a positive number")
]
NotNegative = Annotated[
    float,
    Meta(ge=0, le=LARGEST, description=f"it must be a number from 0 to {LARGEST:.2g}"),
]
