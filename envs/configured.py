"""What all environments of the package share with those of highway-env: a configuration that is checked, and spaces."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import product
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import ContinuousAction, DiscreteMetaAction, action_factory
from highway_env.envs.common.observation import observation_factory

from ms_highway.envs.configuration import (
    TYPES,
    Changes,
    Config,
    Positive,
    Types,
    as_json,
    check,
    check_type,
    read_own,
    refuse_unknown,
)
from ms_highway.envs.spaces import (
    SPEED_RANGE,
    Autopilot,
    CarStates,
    CarTracks,
    HumanModelAction,
    SceneStates,
    TupleObservation,
    finite,
    limit_speed,
)
from ms_highway.envs.viewer import Viewer, enable_pictures
from ms_highway.game.scenario import TIME_STEP

OWN = (Autopilot, HumanModelAction, CarStates, CarTracks, SceneStates, TupleObservation)
OWN_TYPES = {kind.__name__: kind for kind in OWN}
SCALARS: dict[type, Any] = {bool: bool, int: Positive, float: Positive}
"""What the values of highway-env's own keys must be, by the type of their default."""

UNUSED = {
    "other_vehicles_type": "'human_driver' says what drives the humans, and 'traffic' what drives recorded cars",
    "show_trajectories": "plan and prediction are always drawn",
    "render_agent": "render_mode says whether to draw",
    "neighbour_vehicles_connected_lanes": "all lanes of these roads are one road",
}
"""highway-env's own keys that have no effect here, and what has."""

STEERING_RANGE = [-0.1, 0.1]  # rad, of the front wheels: at 20 m/s, 0.1 rad turns with 8 m/s^2, what tyres hold


class ConfiguredEnv(AbstractEnv):
    """An environment of highway-env whose configuration is checked, all of it, before anything changes.

    Attributes:
        settings: of the configuration, of the class's ``settings_type``.
    """

    settings_type: ClassVar[Any]
    types: ClassVar[Types] = TYPES
    reset_options: ClassVar[tuple[str, ...]] = ("config",)
    viewer_type: ClassVar[type[Viewer]] = Viewer
    viewer: Viewer | None
    road: Any
    config: Config
    metadata: Config
    action_space: Any
    _running, _stale = False, False  # whether an episode runs; whether a step needs a reset before it
    _coming: Config | None = None  # the configuration of the next episode
    _spec: EnvSpec | None = None

    def __init__(self, config: Config | None = None, render_mode: str | None = None) -> None:
        super().__init__(config, render_mode)
        self._running = False  # the episode that highway-env starts in its constructor does not count

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's specification; its arguments have only types that JSON has."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            spec.kwargs = as_json(spec.kwargs)
        self._spec = spec

    @classmethod
    def checked_config(cls, changes: Changes | None, config: Changes | None = None) -> Config:
        """Return the whole configuration, by default the default one, after changes.

        A nested mapping changes only the keys that it names, unless its ``type`` differs or it is a reward: then it
        replaces what stood there.

        Raises:
            ValueError: naming key, value, place and remedy, for anything unknown or impossible.
        """
        changes = {} if changes is None else changes
        if not isinstance(changes, Mapping):
            raise ValueError(f"the configuration is {changes!r}; it must be a dictionary")
        defaults = cls.default_config() if config is None else config
        refuse_unknown("config", changes, defaults)
        whole: Config = {**defaults, **changes}
        for key, value in changes.items():
            if isinstance(value, Mapping):
                before: Changes = defaults[key] if isinstance(defaults[key], Mapping) and key != "human_reward" else {}
                same_type = value.get("type", before.get("type")) == before.get("type")
                whole[key] = {**before, **value} if same_type else dict(value)
        read_own(cls.settings_type, whole)
        for key, default in super().default_config().items():
            check(f"config[{key!r}]", whole[key], SCALARS.get(type(default), Any))
            if key in UNUSED and whole[key] != default:
                raise ValueError(f"config[{key!r}] is {whole[key]!r}, which has no effect here; {UNUSED[key]}")
        frequency = 1 / whole.get("time_step", TIME_STEP)  # cars act, and the road moves, once in each planned step
        frequency = round(frequency) if np.isclose(frequency, round(frequency)) else frequency
        for key in ("simulation_frequency", "policy_frequency"):
            if not np.isclose(changes.get(key, frequency), frequency):
                message = f"plans are made of steps of {1 / frequency:g} s, so it must be {frequency:g}"
                raise ValueError(f"config[{key!r}] is {whole[key]!r}; {message}")
            whole[key] = frequency
        for key, known in cls.types.items():
            check_type(f"config[{key!r}]", whole[key], known)
        if "steering_range" in cls.types["action"][whole["action"]["type"]]:
            whole["action"] = {"steering_range": STEERING_RANGE, **whole["action"]}
        return whole

    def configure(self, config: Config | None) -> None:
        """Change the configuration, all of it or nothing; during an episode, from the next reset on.

        When no episode runs, the spaces follow at once, and the next step needs a reset before it.

        Raises:
            ValueError: for an unknown key or an impossible value.
        """
        config = self.checked_config(config, self._coming or self.config)
        if self._running:
            self._coming = config
            return
        with self._all_or_nothing():
            self.config, self._coming = config, None
            self._read()
            super().configure(None)
            if hasattr(self, "road"):  # or else it is only being made
                road, self.road = self.road, None  # spaces must not depend on the cars of the last episode
                self.define_spaces()
                self.road, self._stale = road, True

    @contextmanager
    def _all_or_nothing(self) -> Iterator[None]:
        """Leave everything as it was if the block fails."""
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
        self.metadata = dict(self.metadata)  # or else highway-env would write them into the class's own
        super().update_metadata(video_real_time_ratio)

    def define_spaces(self) -> None:
        """Set observation and action type; an action space that did not change keeps its random generator."""
        before = self.action_space
        self.action_type = self.type_of(action_factory, self.config["action"])
        if isinstance(self.action_type, ContinuousAction):
            limit_speed(self.action_type, as_json(self.config["action"].get("speed_range", SPEED_RANGE)))
        self.action_space = self.action_type.space()
        if before == self.action_space:
            self.action_space = before
        self.observation_type = self.type_of(observation_factory, self.config["observation"])
        enable_pictures(self)
        self.observation_space = finite(self.observation_type.space())

    def type_of(self, factory: Any, config: Config) -> Any:
        """Return a type of actions or observations: the package's own, else what a factory of highway-env makes."""
        if "observation_shape" in config:  # highway-env needs a tuple; JSON has only lists
            config = {**config, "observation_shape": tuple(config["observation_shape"])}
        kind = OWN_TYPES.get(config["type"])
        return kind(self, **config) if kind else factory(self, config)

    def reset(self, *, seed: int | None = None, options: Config | None = None) -> tuple[np.ndarray, Config]:
        """Start an episode.

        Args:
            seed: seeds all that is drawn.
            options: ``"config"``: changes of the configuration, of which all are made or none; others see the class.

        Raises:
            ValueError: for unknown options or an impossible configuration.
        """
        self.options = options or {}
        refuse_unknown("the reset options", self.options, self.reset_options)
        with self._all_or_nothing():
            self._running = False
            if self._coming or "config" in self.options:
                self.configure(self.options.get("config"))
            self.road = None
            start = super().reset(seed=seed)
        self._running, self._stale = True, False
        if self.config["manual_control"]:
            self.action_type.act(self.action_type.last_action)  # keys that nobody touches also mean something
        return start

    def get_available_actions(self) -> Sequence[Any]:
        """Return the actions available now: all discrete actions, or highway-env's selection of meta-actions."""
        if isinstance(self.action_space, spaces.MultiDiscrete):
            return [*product(*map(range, self.action_space.nvec))]
        if isinstance(self.action_type, DiscreteMetaAction) or not isinstance(self.action_space, spaces.Discrete):
            return super().get_available_actions()
        return range(self.action_space.n)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, Config]:
        """Let all cars act and move for a time step.

        Raises:
            ValueError: for an action that is impossible; nothing has moved then.
            ResetNeeded: if the configuration has changed since the last episode.
        """
        if self._stale:
            raise ResetNeeded("the configuration has changed since the last episode; call reset before step")
        chosen = isinstance(self.action_type, Autopilot)
        if action is not None and not (self.action_space.contains(action) if chosen else np.isfinite(action).all()):
            raise ValueError(f"action {action!r} is impossible; give one of {self.action_space}")
        *outcome, info = super().step(action)
        self._running = not any(outcome[2:])
        return *outcome, info

    def render(self) -> np.ndarray | None:
        """Draw the road from above."""
        if self.viewer is None and self.render_mode is not None:
            self.viewer = self.viewer_type(self)
        return super().render()
