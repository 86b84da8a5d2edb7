"""Define rewards that are linear in features, the package's and user-defined ones."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, TypeAlias

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.dynamics import Motion
from ms_highway.game.scene import Scene
from ms_highway.runtime.arrays import Array, Scalar, Weights
from ms_highway.runtime.definitions import note_definition

PAPER_FEATURES = (
    "speed",
    "lane_alignment",
    "collision_risk",
    "collision",
    "off_road",
    "target_lane",
    "gap",
    "merged",
    "partner_target_lane",
    "partner_merged",
)
"""Names of the paper's features, in the order of a weight vector."""

TRAFFIC_FEATURES = ("direction", "headway", "closing_speed", "induced_braking")

FEATURES = (*PAPER_FEATURES, *TRAFFIC_FEATURES)
"""Names of the package's features: the paper's, then those of real traffic.

Features of real traffic have weight 0 in the paper.
"""

COMFORT = ("comfort_steering", "comfort_acceleration")
"""Names of the weights of comfort, which cost controls, not states, see `Reward`."""

Feature: TypeAlias = Callable[[Scene, Motion, Motion], Scalar]
"""A user-defined feature at one moment.

It is a number computed from the scene, the motion of car 0 and the motion of all
others, arrays [others], its partner first.
"""

USER_FEATURES: dict[str, Feature] = {}
"""User-defined features by name, see `add_feature`."""

COMPUTATION = "computation"
"""Name of the price of planning among the reward terms of environments."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Reward:
    """A linear reward and the reference values of its features.

    Attributes:
        weights: theta, one weight per name of a feature.
        speed_limit: speed at which the speed feature is highest [m/s].
        gap: distance behind the leader at which the gap feature is highest [m].
        comfort: weights of the cost of controls, half the squared difference of each
            scaled control from the one that keeps the velocity.
        names: of the features that are computed: `PAPER_FEATURES` or `FEATURES`, then
            user-defined ones (static).
        user_features: functions of the user-defined features, in the order of the last
            names (static).
        headway: time gap between bumpers that the headway feature wants, besides 2 m
            [s].
    """

    weights: Weights
    speed_limit: Scalar
    gap: Scalar
    comfort: Float[Array, "2"]
    names: tuple[str, ...] = field(metadata={"static": True})
    user_features: tuple[Feature, ...] = field(default=(), metadata={"static": True})
    headway: Scalar = 1.0

    def price(self, name: str) -> Scalar:
        """Return what a unit of a feature costs by its weight; 0 if it is rewarded."""
        return jnp.maximum(-jnp.asarray(self.weights)[self.names.index(name)], 0.0)


def add_feature(name: str, function: Feature) -> None:
    """Register a user-defined feature by name.

    Rewards, configurations and commands of this process may then weigh it. The feature
    is computed where a reward weighs it; Algorithm 1 then neglects nothing in its
    derivatives, see `ms_highway.choice.rule.decide`. Learned weights are positive:
    define the feature as what drivers want more of. A feature of the same name is
    replaced in all rewards that are made later.

    Args:
        name: one word.
        function: see `Feature`; written with `jax.numpy`, and twice differentiable
            where plans optimise it. Before the first plan, an environment or a
            simulation refuses a value or a gradient that is not finite. It takes one
            moment and is mapped over all moments. Lengths are in metres; divide them by
            ``scene.length_unit`` for weights of the size of the others. To be pickled,
            it must be defined in a module. It is tested on a straight scene without a
            leader: ``scene.bend`` and ``scene.leader`` may be None. There are one or
            more others.

    Raises:
        ValueError: if the package uses the name, or it is no word; if the function is
            not hashable, cannot be computed, or does not return one number.
    """
    taken = (*FEATURES, *COMFORT, COMPUTATION)
    if not isinstance(name, str) or not name.isidentifier() or name in taken:
        raise ValueError(
            f"a feature cannot be called {name!r}; choose one word other than"
            f" {', '.join(taken)}"
        )
    result = _traced_result(name, function)
    found = type(result).__name__
    is_number = False
    if isinstance(result, jax.ShapeDtypeStruct):
        found = f"{result.dtype} of shape {result.shape}"
        is_number = not result.shape and not jnp.iscomplexobj(result)
    if not is_number:
        raise ValueError(
            f"the feature {name!r} returns {found} for one moment; it must return one"
            " number"
        )
    USER_FEATURES[name] = function
    note_definition(name, function)


def _traced_result(name: str, function: Feature) -> object:
    """Return the shape and type of what a feature returns for one moment.

    The scene is straight, without a leader, and there are three others.

    Raises:
        ValueError: if the function is not hashable or cannot be computed.
    """
    own = Motion(*np.zeros(5, np.float32))
    others = Motion(*np.zeros((5, 3), np.float32))
    scene = Scene(np.zeros(3), 0.0, obstacles=np.zeros((2, 2)))
    try:
        hash(function)
        return jax.eval_shape(function, scene, own, others)
    except Exception as error:  # a user's function may fail in any way
        message = str(error).partition("\n")[0]
        raise ValueError(
            f"the feature {name!r} cannot be computed: {type(error).__name__}:"
            f" {message}; give a function of (scene, own, others), written with"
            " jax.numpy"
        ) from error


def weight_names() -> tuple[str, ...]:
    """Return the names of all known weights: of all features, and of comfort."""
    return (*FEATURES, *USER_FEATURES, *COMFORT)


def linear_reward(
    values: Mapping[str, float],
    speed_limit: float,
    gap: float = 0.0,
    names: tuple[str, ...] | None = None,
) -> Reward:
    """Build a reward from weights by name (`weight_names`); missing weights are 0.

    Args:
        values: the weights.
        speed_limit: see `Reward` [m/s].
        gap: see `Reward` [m].
        names: of the features to compute; by default those of `features_for`.

    Raises:
        ValueError: for an unknown name, or a weight that is not finite or whose feature
            is not computed.
    """
    _check_weights(values, names or ())
    names = names or features_for(values)
    if names != tuple(name for name in (*FEATURES, *USER_FEATURES) if name in names):
        raise ValueError(
            f"the features {', '.join(names)} are not in the order of FEATURES, then"
            " user-defined ones"
        )
    left_out = [
        name
        for name, value in values.items()
        if value != 0 and name not in (*names, *COMFORT)
    ]
    if left_out:
        raise ValueError(
            f"{', '.join(left_out)} would not be computed; add them to the names of the"
            " features"
        )
    weights = np.array([values.get(name, 0.0) for name in names], np.float32)
    comfort = np.array([values.get(name, 0.0) for name in COMFORT], np.float32)
    functions = tuple(USER_FEATURES[name] for name in names if name in USER_FEATURES)
    return Reward(weights, speed_limit, gap, comfort, names, functions)


def _check_weights(values: Mapping[str, float], names: tuple[str, ...]) -> None:
    """Check the weights of a reward, and the names of features to compute.

    Raises:
        ValueError: for an unknown name, or a weight that is not finite.
    """
    known = weight_names()
    unknown = sorted(map(str, {*values, *names} - set(known)))
    if unknown:
        raise ValueError(
            f"unknown reward features {unknown}; the features are {', '.join(known)};"
            " add one of your own with ms_highway.add_feature, or --import the module"
            " that does"
        )
    largest = 1e30  # which single precision holds
    for name, value in values.items():
        is_number = np.isscalar(value) and not isinstance(value, (bool, str))
        if not is_number or not np.abs(value) <= largest:
            raise ValueError(
                f"the weight of {name} is {value!r}; it must be a finite number, at"
                f" most {largest:g}"
            )


def features_for(
    *rewards: Mapping[str, float],
    least: tuple[str, ...] = PAPER_FEATURES,
) -> tuple[str, ...]:
    """Return the names of the features that these weights by name need.

    Args:
        rewards: weights of each reward; features with weight 0 in all are left out.
        least: features that are computed in any case, `PAPER_FEATURES` or `FEATURES`.
    """
    weighed = {
        name for values in rewards for name, value in values.items() if value != 0
    }
    packaged = least if weighed.isdisjoint(TRAFFIC_FEATURES) else FEATURES
    return (*packaged, *(name for name in USER_FEATURES if name in weighed))


@dataclass(frozen=True)
class RewardModel:
    """A reward that is linear in its features: the weights to learn, and those given.

    Attributes:
        learned: names of the weights to learn, of `weight_names`.
        given: fixed weights, by name; those of comfort set the scale of all others.
        tails: whether drivers are now and then far from the best driving, see
            `ms_highway.irl.maximum_entropy`.

    Raises:
        ValueError: for unknown names, indicators, a weight named twice, or no given
            comfort weight.
    """

    penalties: ClassVar[tuple[str, ...]] = ("collision_risk", "collision", "off_road")
    """Features with negative weights; all other weights are positive."""
    indicators: ClassVar[tuple[str, ...]] = ("collision", "merged", "partner_merged")
    """Features without a gradient: driving carries no information about their weights.
    """
    floor_share: ClassVar[float] = 0.5
    """`floor` as a share of the least given comfort weight."""

    learned: tuple[str, ...]
    given: Mapping[str, float]
    tails: bool = False

    def __post_init__(self) -> None:
        known = [name for name in weight_names() if name not in self.indicators]
        for name in self.names:
            if name not in known:
                raise ValueError(
                    f"{name!r} cannot be learned; the weights to learn are"
                    f" {', '.join(known)}"
                )
        twice = sorted(set(self.learned) & set(self.given))
        if twice or len(set(self.learned)) < len(self.learned):
            raise ValueError(f"weights {twice or list(self.learned)} are named twice")
        if not any(self.given.get(name, 0.0) > 0 for name in COMFORT):
            raise ValueError(
                f"one of {', '.join(COMFORT)} must be given: it sets the scale of all"
                " weights"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """All names: the learned ones, then the given ones."""
        return (*self.learned, *self.given)

    @property
    def floor(self) -> float:
        """The least curvature of -R in any direction that a fit assumes."""
        comforts = [self.given[name] for name in self.given if name in COMFORT]
        return self.floor_share * min(weight for weight in comforts if weight > 0)

    def signs(self) -> Float[np.ndarray, "learned"]:
        """Return the signs of the learned weights, which are fixed."""
        return np.array(
            [-1.0 if name in self.penalties else 1.0 for name in self.learned]
        )

    def weights(self, logarithms: Float[np.ndarray, "parameters"]) -> dict[str, float]:
        """Return all weights by name, from the logarithms that a fit finds.

        Those of the learned ones come first.
        """
        learned = (self.signs() * np.exp(logarithms[: len(self.learned)])).tolist()
        return {**dict(zip(self.learned, learned, strict=True)), **self.given}
