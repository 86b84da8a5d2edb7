"""Learned values of computation per human and their file: the network, and what it was learned on."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ms_highway.metareasoning.crowd.learned import LearnedCrowdValue
from ms_highway.metareasoning.crowd.rule import CrowdCosts
from ms_highway.metareasoning.crowd.situation import human_description_names
from ms_highway.metareasoning.learned_value import Network
from ms_highway.metareasoning.network_file import NetworkFile, check_network, read_network, write_network
from ms_highway.metareasoning.values import DAMAGES, SHIPPED_VALUES
from ms_highway.planning.crowd import RUNGS

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
        check_network(self.network, self.centre, self.spread, len(self.inputs), 2 * (len(RUNGS) - 1))
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
    write_network(path, NetworkFile(about, values.network, values.centre, values.spread))


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
        about, network, centre, spread = read_network(path)
        if (about.get("kind"), about["version"]) != (KIND, VERSION):
            raise ValueError(f"it is of version {about['version']} and kind {about.get('kind', 'of one human')!r}")
        return CrowdValues(network, centre, spread, tuple(about["inputs"]), about["provenance"])
    except DAMAGES as error:
        raise ValueError(f"{path} is damaged or no values of crowds: {error}; {REMEDY} --out {path}") from error
