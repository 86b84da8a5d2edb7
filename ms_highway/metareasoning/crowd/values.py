"""Learned values of computation per human and their file: the network, and what it was learned on."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ms_highway.metareasoning.crowd.learned import LearnedCrowdValue
from ms_highway.metareasoning.crowd.rule import CrowdCosts
from ms_highway.metareasoning.crowd.situation import human_description_names
from ms_highway.metareasoning.learned_value import Network
from ms_highway.metareasoning.values import DAMAGES, SHIPPED_VALUES
from ms_highway.planning.crowd import RUNGS
from ms_highway.runtime.files import replacing

__all__ = ["CrowdValues", "load_crowd_values", "save_crowd_values"]

KIND, VERSION = "values of computation per human", 1
REMEDY = "learn values with `ms-highway values learn dense_merge crossing_crowd`"


@dataclass(frozen=True)
class CrowdValues:
    """Result of ``ms-highway values learn`` with scenarios of several humans.

    Attributes:
        network, centre, spread: see `ms_highway.metareasoning.crowd.learned.LearnedCrowdValue`.
        inputs: names of the network's inputs.
        provenance: scenarios, settings and versions of the software.
    """

    network: Network
    centre: Float[np.ndarray, "inputs"]
    spread: Float[np.ndarray, "inputs"]
    inputs: tuple[str, ...]
    provenance: Mapping[str, Any]

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: naming the problem.
        """
        if self.inputs != human_description_names():
            raise ValueError("the inputs of the network are those of another version")
        sizes = [len(self.inputs), *(np.shape(biases)[-1] for _, biases in self.network)]
        shapes = [np.shape(weights)[1:] for weights, _ in self.network]
        if shapes != list(pairwise(sizes)) or sizes[-1] != 2 * (len(RUNGS) - 1):
            raise ValueError(f"the layers of the network are of shapes {shapes}")
        numbers = [self.centre, self.spread, *(part for layer in self.network for part in layer)]
        if {np.shape(part) for part in numbers[:2]} != {(sizes[0],)} or not all(np.isfinite(n).all() for n in numbers):
            raise ValueError("the numbers of the network are not finite, or not as many as its inputs")
        if not (self.spread > 0).all():
            raise ValueError("the spreads of the inputs must be positive")

    def rule(self, costs: CrowdCosts, price: float) -> LearnedCrowdValue:
        """Return the rule at a price of a second of planning."""
        return LearnedCrowdValue(costs, price, self.network, self.centre, self.spread)


def save_crowd_values(values: CrowdValues, path: Path) -> None:
    """Write learned values as a NumPy archive, atomically."""
    about = {
        "kind": KIND,
        "version": VERSION,
        "inputs": list(values.inputs),
        "provenance": dict(values.provenance),
    }
    arrays: dict[str, Any] = {"about": np.array(json.dumps(about)), "centre": values.centre, "spread": values.spread}
    for number, (weights, biases) in enumerate(values.network):
        arrays |= {f"weights_{number}": np.asarray(weights), f"biases_{number}": np.asarray(biases)}
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


def load_crowd_values(which: str | PathLike[str]) -> CrowdValues:
    """Read learned values: those of the package (`SHIPPED_VALUES`), or a file that `save_crowd_values` wrote.

    Raises:
        ValueError: if the file cannot be read, is damaged, or is of another kind or version.
    """
    if which == SHIPPED_VALUES:
        return _shipped()
    try:
        return _read(Path(which), Path(which).stat().st_mtime_ns)
    except OSError as error:
        raise ValueError(f"{which} cannot be read as learned values: {error}; {REMEDY} --out {which}") from error


@cache
def _shipped() -> CrowdValues:
    with resources.as_file(resources.files("ms_highway") / "data" / "crowd_values.npz") as path:
        return _read(path, 0)


@cache
def _read(path: Path, changed: int) -> CrowdValues:
    """Read a file, once for every time that it was ``changed``."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        about = json.loads(str(arrays["about"]))
        if (about.get("kind"), about["version"]) != (KIND, VERSION):
            raise ValueError(f"it is of version {about['version']} and kind {about.get('kind', 'of one human')!r}")
        layers = range((len(arrays) - 3) // 2)
        return CrowdValues(
            tuple((arrays[f"weights_{number}"], arrays[f"biases_{number}"]) for number in layers),
            arrays["centre"],
            arrays["spread"],
            tuple(about["inputs"]),
            about["provenance"],
        )
    except DAMAGES as error:
        raise ValueError(f"{path} is damaged or no values of crowds: {error}; {REMEDY} --out {path}") from error
