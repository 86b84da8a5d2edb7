"""Choose models by a learned value of computation, and keep it in files.

The value of computation (Russell and Wefald 1991; Callaway et al. 2018) of a rung is
how much more the robot earns per step if this rung, instead of the cheapest one,
predicts a human, while the same rung predicts all nearer humans. Networks estimate it
from the situation of the human (`ms_highway.choice.situation`); several of them, so
that their disagreement tells how doubtful an estimate is.

A gap may open only if two humans yield together. Therefore,
`ms_highway.choice.choosers.PriceTogether` chooses for the nearest humans together.

`Values` are what was learned, as it stands in files; `LearnedValue` is the estimator
that a rule gets of them, for the ladder of an episode.
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
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float
from msgspec import Meta

from ms_highway.choice.budget import Budget
from ms_highway.choice.choosers import PriceTogether
from ms_highway.choice.rule import (
    FROM_START,
    NOT_ESTIMATED,
    Estimate,
    Estimator,
    GameEvidence,
    Memory,
    Rule,
    Start,
)
from ms_highway.choice.shipped import VALUE_FILES, SceneKind, shipped_kind
from ms_highway.choice.situation import describe, description_names, nearness
from ms_highway.game.scenario import Semantics
from ms_highway.planning.costs import Costs
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import Array, Scalar, Structure, read, read_only
from ms_highway.runtime.files import read_arrays, reading, replacing
from ms_highway.runtime.sources import digest

SHIPPED_VALUES = "shipped"
"""Name of the values that come with the package."""


# Networks

Layer: TypeAlias = tuple[
    Float[Array, "networks _inputs _outputs"], Float[Array, "networks _outputs"]
]
"""Weights and biases of one layer of several networks."""

Network: TypeAlias = tuple[Layer, ...]
"""Layers of several networks; all layers but the last are followed by tanh."""


def outputs(
    network: Network,
    inputs: Float[jax.Array, "inputs"],
) -> tuple[Float[jax.Array, "networks means"], Float[jax.Array, "networks means"]]:
    """Return what each network expects for the same inputs, and how sure it is.

    The second result are numbers from which `noise` computes standard deviations.
    """
    *hidden, (weights, biases) = network
    values = jnp.broadcast_to(inputs, (len(biases), *inputs.shape))
    for layer_weights, layer_biases in hidden:
        sums = jnp.einsum("ni,nio->no", values, layer_weights)
        values = jnp.tanh(sums + layer_biases)
    both = jnp.einsum("ni,nio->no", values, weights) + biases
    means, spreads = jnp.split(both, 2, axis=-1)
    return means, spreads


def noise(spreads: Float[jax.Array, "*shape"]) -> Float[jax.Array, "*shape"]:
    """Return standard deviations of outcomes from the spreads of `outputs`.

    None is smaller than a gain that counts as nothing.
    """
    return Budget.little_gain + jax.nn.softplus(spreads)


# The estimator

ValuesFile = Annotated[
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
            `ms_highway.choice.situation.describe`; none outside an episode.
        centre, spread: mean and standard deviation by which the inputs of the networks
            are standardised; None outside an episode.
    """

    values: ValuesFile = field(default=None, metadata={"static": True})
    margin: Scalar = field(default=0.5, metadata=FROM_START)
    nearest: int | None = field(
        default=PriceTogether.most_humans, metadata={"static": True} | FROM_START
    )
    network: Network = field(default=(), metadata=FROM_START)
    centre: Float[Array, "inputs"] | None = field(default=None, metadata=FROM_START)
    spread: Float[Array, "inputs"] | None = field(default=None, metadata=FROM_START)

    def __post_init__(self) -> None:
        if self.values and self.values != SHIPPED_VALUES:
            load_values(self.values)

    def values_for(self, start: Start) -> "Values":
        """Return the values of the file, or the shipped values for a kind of scene.

        Among several humans, those of physical semantics know fewer models; longer
        ladders take those of the paper's.
        """
        kind = shipped_kind(start.semantics, start.humans)
        found = load_values(self.values or SHIPPED_VALUES, kind)
        names = {model.name for model in start.ladder}
        if not self.values and start.humans > 1 and not names <= {*found.ladder}:
            return load_values(SHIPPED_VALUES, "several")
        return found

    def at_start(self, start: Start) -> "LearnedValue":
        """Return the estimator with the networks of its values.

        Args:
            start: of an episode; its ladder is that of the estimator.

        Raises:
            ValueError: see `Values.estimator`.
        """
        networks = self.values_for(start).estimator(start.ladder)
        return replace(networks, margin=self.margin, nearest=self.nearest)

    def estimate(self, memory: Memory, evidence: GameEvidence) -> Estimate:
        """Estimate by the state after the last step."""
        gains = jnp.full(memory.last_check.shape, NOT_ESTIMATED)  # [humans, rungs]
        if gains.shape[1] == 1:
            return Estimate(gains, jnp.bool(False))

        # What each network expects for the nearest humans.
        game = evidence.game
        after = evidence.outcome.after
        nearest = jnp.argsort(nearness(game, after))[: self.nearest]
        assert self.centre is not None
        assert self.spread is not None
        described = describe(game, after, nearest)  # [nearest, inputs]
        inputs = (described - self.centre) / self.spread
        means, _ = jax.vmap(partial(outputs, self.network))(inputs)

        # Their mean and their disagreement, 0 for the first rung.
        expected = _with_first_rung(jnp.mean(means, axis=1))  # [nearest, rungs]
        doubts = _with_first_rung(jnp.std(means, axis=1))

        # A doubtful gain counts less. Situations without finite numbers have none.
        known = jnp.isfinite(expected).all(axis=1, keepdims=True)
        cautious = expected - self.margin * doubts
        gains = gains.at[nearest].set(jnp.where(known, cautious, NOT_ESTIMATED))
        return Estimate(gains, ~known.all())


def _with_first_rung(
    above_first: Float[jax.Array, "humans above"],
) -> Float[jax.Array, "humans rungs"]:
    """Return numbers of all rungs, 0 for the first, given those of the rungs above."""
    return jnp.pad(above_first, ((0, 0), (1, 0)))


# What was learned


@dataclass(frozen=True)
class ValuesFormat:
    """Set the form of files of learned values, and the limits of their numbers."""

    version: int = 3
    """Version of the form; files of another one are refused."""

    max_bytes: int = 2**24
    """Largest size of an unpacked file; the package's files have a hundredth."""

    min_spread: float = 1e-9
    """Least standard deviation of an input; it rules out overflow."""

    max_number: float = 1e9
    """Largest mean or standard deviation of an input; it rules out overflow."""

    max_weight: float = 1e3
    """Largest weight or bias of a network; those of the package are below 1."""

    remedy: str = "learn values with `ms-highway values learn`"
    """What to do about a file that cannot be used, for messages."""


VALUES_FORMAT = ValuesFormat()


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
        self._check_shapes()
        self._check_numbers()

    def _check_shapes(self) -> None:
        """Check that the layers fit each other, the inputs and the ladder.

        For each rung above the first, the last layer gives a mean and a spread.
        """
        shapes = [np.shape(part) for layer in self.network for part in layer]
        networks = shapes[0][:1] if shapes else ()

        # Numbers of inputs and outputs of the layers, as the shapes of biases tell.
        sizes = [len(self.inputs)]
        for bias_shape in shapes[1::2]:
            sizes += bias_shape[-1:]

        expected = []
        for inputs, outputs in pairwise(sizes):
            expected += [(*networks, inputs, outputs), (*networks, outputs)]

        last = 2 * (len(self.ladder) - 1)
        if shapes != expected or 0 in networks or sizes[-1] != last:
            raise ValueError(
                f"the networks have layers of shapes {shapes}, not those for"
                f" {len(self.ladder)} models"
            )

    def _check_numbers(self) -> None:
        """Check that all numbers are within the limits of `ValuesFormat`."""
        limits = VALUES_FORMAT
        for scale in (self.centre, self.spread):
            one_each = np.shape(scale) == (len(self.inputs),)
            if not one_each or not (np.abs(scale) <= limits.max_number).all():
                raise ValueError(
                    f"centre or spread has a number beyond {limits.max_number:g}, or"
                    " not one for each input"
                )
        for layer in self.network:
            if not all((np.abs(part) <= limits.max_weight).all() for part in layer):
                raise ValueError(
                    f"the weights of the networks are beyond {limits.max_weight:g}, or"
                    " not finite"
                )
        if np.min(self.spread) < limits.min_spread:
            raise ValueError(f"spreads are below {limits.min_spread:g}")

    def estimator(self, models: tuple[HumanModel, ...]) -> LearnedValue:
        """Return the estimator on a ladder of learned models.

        Args:
            models: that were learned; the first is the cheapest of those learned.

        Raises:
            ValueError: if values of a model were not learned, or the ladder begins with
                another model.
        """
        names = [model.name for model in models]
        self._check_ladder(names)

        # Keep the outputs of these models: their means, then their spreads.
        gains = len(self.ladder) - 1
        means = [self.ladder.index(name) - 1 for name in names[1:]]
        spreads = [gains + place for place in means]
        kept = means + spreads
        *hidden, (weights, biases) = self.network
        network = (*hidden, (weights[..., kept], biases[..., kept]))
        return LearnedValue(network=network, centre=self.centre, spread=self.spread)

    def _check_ladder(self, names: list[str]) -> None:
        """Check that values of these models were learned over the first of them."""
        message = (
            f"{self.place}: values were learned on the ladder {' '.join(self.ladder)}"
        )
        alternatives = (
            "choose another controller, such as switching at a lambda of 0.1, or"
            f" {VALUES_FORMAT.remedy}"
        )
        unknown = [name for name in names if name not in self.ladder]
        if unknown:
            raise ValueError(
                f"{message}, without {unknown[0]!r}; {alternatives} --set"
                f" ladder={','.join(names)}"
            )
        if names[0] != self.ladder[0]:
            raise ValueError(
                f"{message}, over {self.ladder[0]!r}; begin the ladder with it,"
                f" {alternatives}"
            )

    def rule(
        self,
        models: tuple[HumanModel, ...],
        costs: Costs,
        price: float,
    ) -> Rule[GameEvidence]:
        """Return the rule that chooses by these values at a price, see `estimator`."""
        return Rule(models, costs, PriceTogether(price), self.estimator(models))


# Files


class _Provenance(TypedDict, total=False):
    """Entries of the provenance of values by which scenes are compared.

    All others are for people to read.
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
    about: dict[str, object] = {"version": VALUES_FORMAT.version}
    for name in _About.__struct_fields__:
        about[name] = getattr(values, name)

    arrays: dict[str, Any] = {
        "about": np.array(json.dumps(about, default=dict)),
        "centre": values.centre,
        "spread": values.spread,
    }
    for number, (weights, biases) in enumerate(values.network):
        arrays[f"weights_{number}"] = np.asarray(weights)
        arrays[f"biases_{number}"] = np.asarray(biases)

    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


def load_values(which: str | PathLike[str], kind: SceneKind = "pair") -> Values:
    """Read learned values from the package or from a file that `save_values` wrote.

    Args:
        which: `SHIPPED_VALUES`, or a file.
        kind: kind of scene of the package's values.

    Raises:
        ValueError: if the file cannot be read, is damaged, or has another version.
    """
    if which == SHIPPED_VALUES:
        return _shipped(VALUE_FILES[kind])
    remedy = f"{VALUES_FORMAT.remedy} --out {which}"
    with reading(Path(which), remedy, " as learned values"):
        return _read(Path(which), digest(Path(which)))


@cache
def _shipped(name: str) -> Values:
    with resources.as_file(resources.files("ms_highway") / "data" / name) as path:
        return _read(path, "")


@cache
def _read(path: Path, content: str) -> Values:
    """Read a file once for every content, whose digest is given."""
    arrays = read_arrays(path, VALUES_FORMAT.max_bytes)

    # The version first, as files of another one may have any other content.
    about = json.loads(str(arrays.pop("about")))
    version = about.pop("version", None) if isinstance(about, dict) else None
    if version != VALUES_FORMAT.version:
        raise ValueError(f"it is of version {version}, not {VALUES_FORMAT.version}")

    # Numbers, which cannot be written, as all who read the file share them.
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise ValueError(f"{name} holds {array.dtype}; it must hold numbers")
    with np.errstate(over="ignore"):
        single = {name: array.astype(np.float32) for name, array in arrays.items()}
    numbers = read_only(single)

    centre = numbers.pop("centre")
    spread = numbers.pop("spread")
    layers = range(len(numbers) // 2)
    network = tuple((numbers[f"weights_{n}"], numbers[f"biases_{n}"]) for n in layers)

    read(about.get("provenance"), _Provenance)
    described = read(about, _About)
    return Values(
        network,
        centre,
        spread,
        described.ladder,
        described.inputs,
        described.provenance,
        place=str(path),
    )
