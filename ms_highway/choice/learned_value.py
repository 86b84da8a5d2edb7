"""Choose models by a learned value of computation (Russell and Wefald 1991; Callaway et
al. 2018); keep it in files.

From the situation of a human, networks estimate how much more the robot earns per step
if a rung, instead of the cheapest one, predicts this human, while the same rung
predicts all nearer humans. A gap may open only if two humans yield together. Therefore,
`ms_highway.choice.choosers.PriceTogether` chooses for the nearest humans together.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from importlib import resources
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypedDict

import jax
import msgspec
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float
from msgspec import Meta

from ms_highway.choice.budget import LITTLE_GAIN
from ms_highway.choice.choosers import TOGETHER, PriceTogether
from ms_highway.choice.rule import (
    FROM_START,
    NOT_ESTIMATED,
    Estimate,
    Estimator,
    GameEvidence,
    Memory,
    Rule,
    Start,
    shipped_kind,
)
from ms_highway.choice.situation import describe, description_names, nearness
from ms_highway.game.scenario import Semantics
from ms_highway.planning.costs import Costs
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import Array, Scalar, Structure, read, read_only
from ms_highway.runtime.files import read_arrays, reading, replacing
from ms_highway.runtime.sources import digest

Network: TypeAlias = tuple[
    tuple[Float[Array, "networks inputs outputs"], Float[Array, "networks outputs"]],
    ...,
]
"""Weights and biases of each layer of several networks; all layers but the last are
followed by tanh.
"""

DOUBT_MARGIN = 0.5  # in standard deviations among the networks
MIN_NOISE = LITTLE_GAIN  # least standard deviation of a gain


File = Annotated[
    str | None, Meta(description="say 'shipped' or name a file of learned values")
]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LearnedValue(Estimator[GameEvidence]):
    """Expect gains by networks, from the situation of each human.

    The gain of a rung is what the networks expect over the first one, on average, less
    a margin for doubt.

    Attributes:
        values: ``"shipped"``, which None and ``""`` mean as well, or a file; None in an
            episode, where the networks stand for it (static).
        margin: how much doubt lowers a gain, in standard deviations among the networks.
        nearest: number of the nearest humans for whom gains are estimated; None for all
            (static).
        network: networks that estimate the gains over the first rung from
            `ms_highway.choice.situation.describe`.
        centre, spread: mean and standard deviation by which the inputs of the networks
            are standardised.
    """

    values: File = field(default=None, metadata={"static": True})
    margin: Scalar = field(default=DOUBT_MARGIN, metadata=FROM_START)
    nearest: int | None = field(
        default=TOGETHER, metadata={"static": True} | FROM_START
    )
    network: Network = field(default=(), metadata=FROM_START)
    centre: Float[Array, "inputs"] | None = field(default=None, metadata=FROM_START)
    spread: Float[Array, "inputs"] | None = field(default=None, metadata=FROM_START)

    def __post_init__(self) -> None:
        if self.values and self.values != SHIPPED_VALUES:
            load_values(self.values)

    def learned(self, start: Start) -> "Values":
        """Return the values of the file, or the shipped values for a number of humans
        and semantics.

        Among several humans, those of physical semantics know fewer models; longer
        ladders take those of the paper's.
        """
        found = load_values(
            self.values or SHIPPED_VALUES, shipped_kind(start.semantics, start.humans)
        )
        if (
            not self.values
            and start.humans > 1
            and not {model.name for model in start.ladder} <= {*found.ladder}
        ):
            return load_values(SHIPPED_VALUES, "several")
        return found

    def at_start(self, start: Start) -> "LearnedValue":
        """Return the estimator with the networks of its values, for the ladder of an
        episode.

        Raises:
            ValueError: see `Values.estimator`.
        """
        networks = self.learned(start).estimator(start.ladder)
        return replace(networks, margin=self.margin, nearest=self.nearest)

    def estimate(self, memory: Memory, evidence: GameEvidence) -> Estimate:
        """Estimate by the state after the last step."""
        gains = jnp.full(memory.last_check.shape, NOT_ESTIMATED)
        if gains.shape[1] == 1:
            return Estimate(gains, jnp.bool(False))

        # What each network expects for the nearest humans.
        game = evidence.game
        after = evidence.outcome.after
        nearest = jnp.argsort(nearness(game, after))[: self.nearest]
        assert self.centre is not None
        assert self.spread is not None
        inputs = (describe(game, after, nearest) - self.centre) / self.spread
        means, _ = jax.vmap(partial(outputs, self.network))(
            inputs
        )  # [nearest, networks, rungs above the first]

        # Their mean less the doubt, 0 for the first rung.
        expected, doubts = (
            jnp.pad(part(means, axis=1), ((0, 0), (1, 0)))
            for part in (jnp.mean, jnp.std)
        )
        known = jnp.isfinite(expected).all(axis=1, keepdims=True)
        cautious = expected - self.margin * doubts
        gains = gains.at[nearest].set(jnp.where(known, cautious, NOT_ESTIMATED))
        return Estimate(gains, ~known.all())


def outputs(
    network: Network, inputs: Float[jax.Array, "inputs"]
) -> tuple[Float[jax.Array, "networks means"], Float[jax.Array, "networks means"]]:
    """Return what each network expects for the same inputs, and the numbers from which
    `noise` computes spreads.
    """
    *hidden, (weights, biases) = network
    inputs = jnp.broadcast_to(inputs, (len(biases), *inputs.shape))
    for layer_weights, layer_biases in hidden:
        inputs = jnp.tanh(
            jnp.einsum("ni,nio->no", inputs, layer_weights) + layer_biases
        )
    means, spreads = jnp.split(
        jnp.einsum("ni,nio->no", inputs, weights) + biases, 2, axis=-1
    )
    return means, spreads


def noise(spreads: Float[jax.Array, "*shape"]) -> Float[jax.Array, "*shape"]:
    """Return standard deviations of outcomes from the second half of a network's
    `outputs`.
    """
    return MIN_NOISE + jax.nn.softplus(spreads)


# Files of learned values

SHIPPED_VALUES = "shipped"
"""Name of the values that come with the package."""

SHIPPED_FILES = {
    "pair": "values.npz",
    "physical": "physical_values.npz",
    "several": "several_values.npz",
    "physical several": "crowd_values.npz",
}
"""Files that come with the package, by kind of scene, see
`ms_highway.choice.rule.shipped_kind`.
"""

VERSION = 3  # of the form of files
REMEDY = "learn values with `ms-highway values learn`"
ALTERNATIVES = (
    f"choose another controller, such as switching at a lambda of 0.1, or {REMEDY}"
)
MAX_BYTES = 2**24  # of an unpacked file; the package's files have a hundredth
MIN_SPREAD, MAX_NUMBER = (
    1e-9,
    1e9,
)  # bounds of `spread` that rule out overflow; the second also bounds `centre`
MAX_WEIGHT = 1e3  # of networks; those of the package are below 1


@dataclass(frozen=True)
class Values:
    """Result of ``ms-highway values learn``.

    Attributes:
        network: see `LearnedValue`.
        centre, spread: mean and standard deviation of its inputs.
        ladder: names of the models that the values were learned on, cheapest first.
        inputs: names of the network's inputs.
        provenance: scenarios, settings and software versions with which the values were
            learned.
        place: file from which they were read, for messages.
    """

    network: Network
    centre: Float[np.ndarray, "inputs"]
    spread: Float[np.ndarray, "inputs"]
    ladder: tuple[str, ...]
    inputs: tuple[str, ...]
    provenance: Mapping[str, Any]
    place: str = "learned values"

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: naming the problem.
        """
        if len(self.ladder) < 2 or len({*self.ladder}) < len(self.ladder):
            raise ValueError(
                f"the ladder has the models {list(self.ladder)}; it must have at least"
                " two, each once"
            )
        if self.inputs != description_names():
            raise ValueError("the networks have the inputs of another version")
        layers = [part for layer in self.network for part in layer]
        shapes = [np.shape(part) for part in layers]
        networks = shapes[0][:1] if shapes else ()
        sizes = [len(self.inputs)]
        sizes += [size for shape in shapes[1::2] for size in shape[-1:]]
        wanted = [
            networks + shape
            for one, other in pairwise(sizes)
            for shape in ((one, other), (other,))
        ]
        if shapes != wanted or 0 in networks or sizes[-1] != 2 * (len(self.ladder) - 1):
            raise ValueError(
                f"the networks have layers of shapes {shapes}, not those for"
                f" {len(self.ladder)} models"
            )
        standard = np.shape(self.centre), np.shape(self.spread)
        if set(standard) != {(sizes[0],)} or not all(
            (np.abs(part) <= MAX_NUMBER).all() for part in (self.centre, self.spread)
        ):
            raise ValueError(
                f"centre or spread has a number beyond {MAX_NUMBER:g}, or not one for"
                " each input"
            )
        if not all((np.abs(part) <= MAX_WEIGHT).all() for part in layers):
            raise ValueError(
                f"the weights of the networks are beyond {MAX_WEIGHT:g}, or not finite"
            )
        if np.min(self.spread) < MIN_SPREAD:
            raise ValueError(f"spreads are below {MIN_SPREAD:g}")

    def estimator(self, models: tuple[HumanModel, ...]) -> LearnedValue:
        """Return the estimator on a ladder of learned models that begins with the
        cheapest of them.

        Raises:
            ValueError: if values of a model were not learned, or the ladder begins with
                another model.
        """
        names = [model.name for model in models]
        message = (
            f"{self.place}: values were learned on the ladder {' '.join(self.ladder)}"
        )
        if unknown := [name for name in names if name not in self.ladder]:
            raise ValueError(
                f"{message}, without {unknown[0]!r}; {ALTERNATIVES} --set"
                f" ladder={','.join(names)}"
            )
        if names[0] != self.ladder[0]:
            raise ValueError(
                f"{message}, over {self.ladder[0]!r}; begin the ladder with it,"
                f" {ALTERNATIVES}"
            )
        gains = len(self.ladder) - 1
        places = [self.ladder.index(name) - 1 for name in names[1:]]
        places += [gains + place for place in places]
        *hidden, (weights, biases) = self.network
        network = (*hidden, (weights[..., places], biases[..., places]))
        return LearnedValue(network=network, centre=self.centre, spread=self.spread)

    def rule(
        self, models: tuple[HumanModel, ...], costs: Costs, price: float
    ) -> Rule[GameEvidence]:
        """Return the rule that chooses by these values at a price, see `estimator`."""
        return Rule(models, costs, PriceTogether(price), self.estimator(models))


class _Provenance(TypedDict, total=False):
    """Entries of the provenance of values by which scenes are compared; all others are
    for people to read.
    """

    scenarios: list[str]
    semantics: Semantics
    solver: str
    planning_horizon: int | list[int]
    human_reward: str | dict[str, float] | None


class _About(Structure):
    """Description in a file of values; the fields are those of `Values`."""

    ladder: tuple[str, ...]
    inputs: tuple[str, ...]
    provenance: dict[str, Any]


def save_values(values: Values, path: Path) -> None:
    """Write learned values as a NumPy archive, atomically."""
    about = {
        "version": VERSION,
        **{name: getattr(values, name) for name in _About.__struct_fields__},
    }
    arrays: dict[str, Any] = {"about": np.array(json.dumps(about, default=dict))}
    arrays |= {"centre": values.centre, "spread": values.spread}
    for number, (weights, biases) in enumerate(values.network):
        arrays |= {
            f"weights_{number}": np.asarray(weights),
            f"biases_{number}": np.asarray(biases),
        }
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


def load_values(which: str | PathLike[str], kind: str = "pair") -> Values:
    """Read learned values from the package or from a file that `save_values` wrote.

    Args:
        which: `SHIPPED_VALUES`, or a file.
        kind: kind of scene of the package's values, a key of `SHIPPED_FILES`.

    Raises:
        ValueError: if the file cannot be read, is damaged, or has another version.
    """
    if which == SHIPPED_VALUES:
        return _shipped(SHIPPED_FILES[kind])
    with reading(Path(which), f"{REMEDY} --out {which}", " as learned values"):
        return _read(Path(which), digest(Path(which)))


@cache
def _shipped(name: str) -> Values:
    with resources.as_file(resources.files("ms_highway") / "data" / name) as path:
        return _read(path, "")


@cache
def _read(path: Path, content: str) -> Values:
    """Read a file once for every content, whose digest is given."""
    arrays = read_arrays(path, MAX_BYTES)
    about = json.loads(str(arrays.pop("about")))
    version = about.pop("version", None) if isinstance(about, dict) else None
    if version != VERSION:
        raise ValueError(f"it is of version {version}, not {VERSION}")
    if wrong := [
        name for name, array in arrays.items() if array.dtype.kind not in "fiu"
    ]:
        raise ValueError(
            f"{wrong[0]} holds {arrays[wrong[0]].dtype}; it must hold numbers"
        )
    with np.errstate(over="ignore"):
        numbers = read_only(
            {name: array.astype(np.float32) for name, array in arrays.items()}
        )  # as all share them
    centre = numbers.pop("centre")
    spread = numbers.pop("spread")
    layers = range(len(numbers) // 2)
    network = tuple(
        (numbers[f"weights_{number}"], numbers[f"biases_{number}"]) for number in layers
    )
    read(about.get("provenance"), _Provenance)
    return Values(
        network,
        centre,
        spread,
        **msgspec.structs.asdict(read(about, _About)),
        place=str(path),
    )
