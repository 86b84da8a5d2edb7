"""What the environments share: configuration, road and cones, car 0's reward by feature, and what a step took."""

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import numpy as np
from gymnasium import spaces
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import action_factory
from highway_env.envs.common.observation import observation_factory
from highway_env.road.lane import LineType, StraightLane
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.objects import Obstacle
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.envs.configuration import TYPES, Changes, Config, Types, merged, read_own, refuse_unknown
from ms_highway.envs.graphics import Viewer
from ms_highway.envs.spaces import Autopilot, CarStates, CarTracks, HumanModelAction, finite
from ms_highway.game.features import features
from ms_highway.game.game import Game
from ms_highway.game.reward import Reward
from ms_highway.game.scenario import CONE_SIZE, PAPER_UNIT
from ms_highway.game.scene import Scene
from ms_highway.runtime.arrays import State

ROAD_BEHIND, ROAD_AHEAD = -100.0, 300.0  # m, ends of the drawn road
OWN_TYPES = {kind.__name__: kind for kind in (Autopilot, HumanModelAction, CarStates, CarTracks)}


@jax.jit
def evaluate(scene: Scene, driver: Reward, states: State) -> Float[jax.Array, "2 features"]:
    """Compute the features phi of car 0's state and their terms in its reward, in one transfer."""
    phi = features(scene, driver, states)
    return jnp.stack([phi, phi * driver.weights])


def straight_road(game: Game) -> RoadNetwork:
    """Build highway-env's road network of a game's lanes, with the robot's speed limit."""
    network, lanes, width = RoadNetwork(), np.asarray(game.scene.lanes, dtype=float), float(game.scene.lane_width)
    solid, striped, none = LineType.CONTINUOUS_LINE, LineType.STRIPED, LineType.NONE
    left = [solid, *np.where(np.diff(lanes) > 1.01 * width, striped, none)]
    for y, *lines in zip(lanes, left, [*[striped] * (len(lanes) - 1), solid], strict=True):
        limit = float(game.robot.speed_limit)
        lane = StraightLane([ROAD_BEHIND, y], [ROAD_AHEAD, y], width=width, line_types=lines, speed_limit=limit)
        network.add_lane("start", "end", lane)
    return network


@dataclass(frozen=True)
class Timing:
    """What the robot's step took on this machine. Any two compare equal: measured times are no part of what happened.

    Attributes:
        planning_seconds: wall time of the plan, compilation excluded.
        decision_seconds: wall time of choosing the model, compilation excluded; 0 without a choice.
        compile_seconds: time spent compiling and warming up.
    """

    planning_seconds: float = field(compare=False)
    decision_seconds: float = field(compare=False)
    compile_seconds: float = field(compare=False)


class Cone(Obstacle):
    """A traffic cone."""

    LENGTH, WIDTH = (size * PAPER_UNIT for size in CONE_SIZE)  # m


class StageEnv(AbstractEnv):
    """An environment of a fixed duration, whose reward is that of car 0 after the step, feature by feature.

    Cars are not solid: a collision only costs reward, as in the paper, and ``info["collision_effect"]`` says so.

    Attributes:
        settings: of the configuration, of the class's ``settings_type``.
        game: whose reward.
        collision: whether car 0 has collided in the last step.
    """

    settings_type: ClassVar[Any]
    types: ClassVar[Types] = TYPES
    viewer_type: ClassVar[type[Viewer]] = Viewer
    reset_options: ClassVar[tuple[str, ...]] = ("config",)
    config: Config
    metadata: Config
    time: float
    steps: int
    action_space: spaces.Space | None
    viewer: Viewer | None
    game: Game
    _running, _coming = False, None  # whether there is an episode; the configuration of the next one

    @classmethod
    def checked_config(cls, changes: Changes | None, config: Changes | None = None) -> Config:
        """Return the whole configuration, by default the default one, after changes.

        Raises:
            ValueError: for an unknown key or an impossible value.
        """
        return merged(cls.settings_type, cls.types, cls.default_config() if config is None else config, changes)

    def configure(self, config: Config | None) -> None:
        """Change the configuration, all of it or nothing; during an episode, from the next reset on.

        Raises:
            ValueError: for an unknown key or an impossible value.
        """
        config = self.checked_config(config, self._coming or self.config)
        if self._running:
            self._coming = config
            return
        self.config, self._coming = config, None
        self._read()
        super().configure(None)

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
        self.action_type = self._type(action_factory, self.config["action"])
        self.action_space = self.action_type.space()
        if before == self.action_space:
            self.action_space = before
        self.observation_type = self._type(observation_factory, self.config["observation"])
        self.observation_space = finite(self.observation_type.space())

    def _type(self, factory: Any, config: Config) -> Any:
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
        before, self._running = (self.config, self._coming, self._running, self.time, self.steps), False
        try:
            if self._coming or "config" in self.options:
                self.configure(self.options.get("config"))
            start = super().reset(seed=seed)
        except ValueError:
            self.config, self._coming, self._running, self.time, self.steps = before
            self._read()
            self.define_spaces()
            raise
        self._running = True
        if self.config["manual_control"]:
            self.action_type.act(self.action_type.last_action)  # keys that nobody touches also mean something
        return start

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, Config]:
        """Let all cars act and move for a time step.

        Raises:
            ValueError: for an action that is impossible; nothing has moved then.
        """
        if isinstance(self.action_type, Autopilot) and action is not None:
            self.action_type.check(action)
        elif action is not None and not np.isfinite(action).all():
            raise ValueError(f"action {action!r} is not finite; give numbers of the space {self.action_space}")
        return super().step(action)

    def _place(self, cars: list[Any]) -> None:
        """Put cars on the road, the first of them to be driven."""
        for car in cars:
            car.solid = False  # collisions are seen, without effect
        self.road.vehicles, self.controlled_vehicles, self.collision = cars, cars[:1], False

    @property
    @abstractmethod
    def car_states(self) -> State:
        """``(x, y, heading, speed)`` of all cars in SI units."""

    @property
    def episode_steps(self) -> int:
        """Length of an episode that nothing ends early."""
        return round(self.config["duration"] * self.config["policy_frequency"])

    def _simulate(self, action: Any = None) -> None:
        """Let all cars act and move, then evaluate the new state of car 0."""
        for car in self.road.vehicles:
            car.hit = False
        super()._simulate(action)
        robot = self.game.robot
        phi, terms = np.asarray(evaluate(self.game.scene, robot, self.car_states.astype(np.float32))).tolist()
        self._terms = dict(zip(robot.names, terms, strict=True))
        self.collision = bool(phi[robot.names.index("collision")])

    def _reward(self, action: Any) -> float:
        return sum(self._terms.values())

    def _rewards(self, action: Any) -> dict[str, float]:
        return dict(self._terms)

    def _is_truncated(self) -> bool:
        return self.steps >= self.episode_steps

    def _is_terminated(self) -> bool:
        return bool(self.config.get("terminate_on_collision") and self.collision)

    def _info(self, obs: Any, action: Any = None) -> Config:
        """Describe the last step; after a reset, only the speed of car 0 and what collisions do."""
        info = {"speed": self.vehicle.speed, "collision_effect": "reward only"}
        if self.steps == 0:
            return info
        happened = {"collision": self.collision, "crashed": self.vehicle.hit, "control": dict(self.vehicle.action)}
        return info | {"action": action, "rewards": self._rewards(action)} | happened

    def render(self) -> np.ndarray | None:
        """Draw the road from above."""
        if self.viewer is None and self.render_mode is not None:
            self.viewer = self.viewer_type(self)
        return super().render()
