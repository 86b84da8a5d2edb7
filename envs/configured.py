"""Define the base of all environments, with checked configuration and actions."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import ClassVar, TypeAlias, TypeVar

import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import (
    ActionType,
    ContinuousAction,
    DiscreteMetaAction,
    action_factory,
)
from highway_env.envs.common.observation import ObservationType, observation_factory
from highway_env.road.road import Road
from msgspec import Struct

from ms_highway.envs.configuration import (
    TYPES,
    Annotation,
    Changes,
    Config,
    Types,
    Unchecked,
    as_dictionary,
    as_json,
    check,
    check_type,
    checked_seed,
    read_own,
    refuse_unknown,
)
from ms_highway.envs.keyboard import check_window
from ms_highway.envs.spaces import (
    Autopilot,
    CarStates,
    CarTracks,
    HumanModelAction,
    SceneStates,
    TupleObservation,
    finite,
    is_possible,
    limit_speed,
)
from ms_highway.envs.viewer import Viewer, enable_pictures
from ms_highway.game.scenario import TIME_STEP
from ms_highway.runtime.limits import Positive

Method = TypeVar("Method", bound=Callable[..., object])


def not_simulated(method: Method) -> Method:
    """Mark a method of a step that a simulation in JAX computes in its own way.

    A simulation refuses classes that override such a method, which it does not call.
    """
    method.__dict__["not_simulated"] = True
    return method


OWN_TYPES: dict[str, type] = {
    kind.__name__: kind
    for kind in (
        Autopilot,
        HumanModelAction,
        CarStates,
        CarTracks,
        SceneStates,
        TupleObservation,
    )
}
"""The package's types of actions and observations, by name."""

UNUSED = {
    "other_vehicles_type": (
        "'human_driver' says what drives the humans, and 'traffic' what drives recorded"
        " cars"
    ),
    "show_trajectories": "plan and prediction are always drawn",
    "render_agent": "render_mode says whether to draw",
    "neighbour_vehicles_connected_lanes": "all lanes of these roads are one road",
}
"""highway-env's own keys that have no effect here, and the reason or a key that has the
effect.
"""


SpaceType: TypeAlias = ActionType | ObservationType


def merged(changes: Config, config: Config) -> Config:
    """Return a configuration after changes.

    A nested mapping changes only the keys that it names. It replaces the old mapping if
    its ``type`` differs or if it is the humans' reward.
    """
    whole: Config = {**config, **changes}
    for key, value in changes.items():
        before = config[key]
        both_nested = isinstance(value, dict) and isinstance(before, dict)
        if not both_nested or key == "human_reward":
            continue
        if value.get("type", before.get("type")) == before.get("type"):
            whole[key] = {**before, **value}
    return whole


def _check_highway_env(config: Config, defaults: Config) -> None:
    """Check the values of highway-env's own keys.

    Raises:
        ValueError: for another type than the default's, and for a change of a key that
            has no effect.
    """
    annotations: dict[type, Annotation] = {bool: bool, int: Positive, float: Positive}
    for key, default in defaults.items():
        annotation = annotations.get(type(default), Unchecked)
        check(f"config[{key!r}]", config[key], annotation)
        if key in UNUSED and config[key] != default:
            raise ValueError(
                f"config[{key!r}] is {config[key]!r}, which has no effect here;"
                f" {UNUSED[key]}"
            )


def _set_frequencies(config: Config, changes: Config) -> None:
    """Let cars act, and the road move, once in each planned step.

    Raises:
        ValueError: for a change to another frequency.
    """
    frequency = 1 / config.get("time_step", TIME_STEP)
    if np.isclose(frequency, round(frequency)):
        frequency = round(frequency)
    for key in ("simulation_frequency", "policy_frequency"):
        if not np.isclose(changes.get(key, frequency), frequency):
            remedy = (
                f"plans are made of steps of {1 / frequency:g} s, so it must be"
                f" {frequency:g}"
            )
            raise ValueError(f"config[{key!r}] is {config[key]!r}; {remedy}")
        config[key] = frequency


class ConfiguredEnv(AbstractEnv):
    """A highway-env environment that checks its whole configuration.

    It does so before it changes anything.

    Attributes:
        settings: the keys that highway-env does not have, read into the class's
            ``settings_type``.
    """

    settings_type: ClassVar[type[Struct]]
    types: ClassVar[Types] = TYPES
    reset_options: ClassVar[tuple[str, ...]] = ("config",)
    viewer_type: ClassVar[type[Viewer]] = Viewer

    # At 20 m/s, 0.1 rad of the front wheels takes the 8 m/s^2 that tyres hold; 40 m/s
    # is highway-env's highest speed.
    usual_ranges: ClassVar[dict[str, list[float]]] = {
        "steering_range": [-0.1, 0.1],
        "speed_range": [0.0, 40.0],
    }

    settings: Struct
    viewer: Viewer | None
    road: Road
    config: Config
    metadata: Config
    action_space: spaces.Space

    _running = False  # whether an episode runs
    _stale = False  # whether the next step needs a reset first
    _made = False  # whether the constructor has ended
    _coming: Config | None = None  # the configuration of the next episode
    _spec: EnvSpec | None = None

    def __init__(
        self,
        config: Config | None = None,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(config, render_mode)
        # The episode that highway-env starts in its constructor does not count.
        self._running = False
        self._made = True

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's specification, with arguments of types that JSON has."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            spec.kwargs = as_json(spec.kwargs)
        self._spec = spec

    @classmethod
    def checked_config(
        cls,
        changes: Changes | None,
        config: Changes | None = None,
    ) -> Config:
        """Return the whole configuration after changes, see `merged`.

        They are changes of a configuration, by default of the default one.

        Raises:
            ValueError: for anything unknown or impossible.
        """
        place = "the configuration"
        changes = as_dictionary(place, {} if changes is None else changes)
        known = as_dictionary(place, cls.default_config() if config is None else config)
        refuse_unknown("config", changes, known)
        whole = merged(changes, known)
        read_own(cls.settings_type, whole)
        _check_highway_env(whole, super().default_config())
        _set_frequencies(whole, changes)
        for key, types in cls.types.items():
            check_type(f"config[{key!r}]", whole[key], types)

        # The usual ranges are copies, which users may change.
        if "speed_range" in cls.types["action"][whole["action"]["type"]]:
            whole["action"] = {**as_json(cls.usual_ranges), **whole["action"]}
        return whole

    def configure(self, config: Config | None) -> None:
        """Make all changes of the configuration, or none.

        Changes during an episode act from the next reset on. When no episode runs, the
        spaces change at once, and the next step needs a reset before it.

        Raises:
            ValueError: for an unknown key or an impossible value.
        """
        config = self.checked_config(config, self._coming or self.config)
        if self._running:
            self._coming = config
            return
        with self._all_or_nothing():
            self.config = config
            self._coming = None
            self._read()
            super().configure(None)

            # Spaces must not depend on the cars of the last episode; highway-env's
            # constructor has no road yet.
            if hasattr(self, "road"):
                last_road = self.road
                self.road = None
                self.define_spaces()
                self.road = last_road
                self._stale = True

    @contextmanager
    def _all_or_nothing(self) -> Iterator[None]:
        """Restore all attributes if the block fails."""
        before = self.__dict__.copy()
        try:
            yield
        except Exception:
            self.__dict__.update(before)
            raise

    def _read(self) -> None:
        """Read the checked configuration."""
        self.settings = read_own(self.settings_type, self.config)

    def update_metadata(self, video_real_time_ratio: int = 1) -> None:
        """Set the frames per second of a video that plays at true speed."""
        # highway-env would write into the dictionary that all environments share.
        self.metadata = dict(self.metadata)
        super().update_metadata(video_real_time_ratio)

    @property
    def keys_drive(self) -> bool:
        """Whether the arrow keys drive a car."""
        return bool(self.config["manual_control"]) and self.render_mode == "human"

    def define_spaces(self) -> None:
        """Set types and spaces of observations and actions.

        An unchanged action space keeps its random generator.
        """
        before = self.action_space
        self.action_type = self.type_of(action_factory, self.config["action"])
        if isinstance(self.action_type, ContinuousAction):
            limit_speed(self.action_type, self.config["action"]["speed_range"])
        self.action_space = self.action_type.space()
        if before == self.action_space:
            self.action_space = before
        observation = self.config["observation"]
        self.observation_type = self.type_of(observation_factory, observation)
        enable_pictures(self)
        self.observation_space = finite(self.observation_type.space())

    def type_of(
        self,
        factory: Callable[[AbstractEnv, Config], SpaceType],
        config: Config,
    ) -> SpaceType:
        """Make a type of actions or observations.

        It is one of the package, or else made by a factory of highway-env.
        """
        # highway-env needs a tuple; JSON has only lists.
        if "observation_shape" in config:
            config = {**config, "observation_shape": tuple(config["observation_shape"])}
        kind = OWN_TYPES.get(config["type"])
        return kind(self, **config) if kind else factory(self, config)

    def reset(
        self,
        *,
        seed: int | None = None,
        options: Config | None = None,
    ) -> tuple[np.ndarray, Config]:
        """Start an episode.

        Args:
            seed: of all random draws.
            options: ``"config"``, changes of the configuration, of which all are made
                or none; the class may have more.

        Raises:
            ValueError: for an impossible seed, unknown options or an impossible
                configuration.
            OSError: if the arrow keys are to drive, and there is no window to press
                them in.
        """
        seed = checked_seed(seed)
        self.options = options or {}
        refuse_unknown("the reset options", self.options, self.reset_options)
        with self._all_or_nothing():
            self._running = False
            if self._coming or "config" in self.options:
                self.configure(self.options.get("config"))
            if self._made and self.keys_drive:
                check_window(self.render_mode)
            self.road = None
            start = super().reset(seed=seed)
        self._running = True
        self._stale = False
        # An action even before the first key is pressed.
        if self.config["manual_control"]:
            self.action_type.act(self.action_type.last_action)
        return start

    def get_available_actions(self) -> Sequence[object]:
        """Return the actions available now.

        These are all discrete actions, or highway-env's selection of meta-actions.
        """
        space = self.action_space
        if isinstance(space, spaces.MultiDiscrete):
            return [*np.ndindex(*space.nvec)]
        chooses_manoeuvres = isinstance(self.action_type, DiscreteMetaAction)
        if isinstance(space, spaces.Discrete) and not chooses_manoeuvres:
            return range(space.n)
        return super().get_available_actions()

    @not_simulated
    def step(self, action: object) -> tuple[np.ndarray, float, bool, bool, Config]:
        """Let all cars act and move for a time step.

        Raises:
            ValueError: for an impossible action, before anything moves.
            ResetNeeded: if the configuration has changed since the last episode.
        """
        if self._stale:
            raise ResetNeeded(
                "the configuration has changed since the last episode; call reset"
                " before step"
            )
        if action is not None and not is_possible(self.action_space, action):
            raise ValueError(
                f"action {action!r} is impossible; give one of {self.action_space}"
            )
        *outcome, info = super().step(action)
        self._running = not any(outcome[2:])
        return *outcome, info

    def render(self) -> np.ndarray | None:
        """Draw the road from above."""
        if self.viewer is None and self.render_mode is not None:
            self.viewer = self.viewer_type(self)
        return super().render()
