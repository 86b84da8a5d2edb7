"""What can be earned by who knows what will happen: a beam search over copies of the environment.

It need not be the most, as speeds are few, choices are held for a second, and the beam is narrow.
"""

from collections.abc import Iterator
from copy import copy, deepcopy
from math import atan, sin, tan
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from highway_env.road.road import LaneIndex
from highway_env.vehicle.controller import ControlledVehicle

from ms_highway.benchmarks.road.measures import LONGEST, has_ended, stays_on_road
from ms_highway.benchmarks.road.peers import Peer, route_to_goal
from ms_highway.envs.road.driven import unheeded
from ms_highway.envs.road.stock import desired_speed_of, destination_of, replace_ego, success
from ms_highway.game.road import BEHIND, SPACING
from ms_highway.planning.road.motion import SLOWING
from ms_highway.planning.road.settings import CORNERING
from ms_highway.vehicle.road_robot import RoadRobot

SHARES = 0.0, 0.3, 0.5, 0.67, 0.85, 1.0
"""Speeds that may be told, as shares of the desired one."""

SECONDS = 1.0
"""Time that each choice is held [s]."""

KEPT = 16
"""Copies that are kept after each choice."""

CELL = 3.0, 1.5, 1.5  # m, m, m/s: of x, y and speed; of the copies in one, the one that has earned most is kept


class Choice(NamedTuple):
    """What to do for `SECONDS`: the share of the desired speed to go for, and the change of lane to the right."""

    share: float
    change: int = 0


class Told(RoadRobot):
    """Keep to a lane and a speed as it is told, by highway-env's controllers within this package's drivers' tyres.

    It is no `ControlledVehicle`, which a regulated road would tell to stop.

    Attributes:
        target_lane_index: the lane.
        target_speed: the speed [m/s].
        left_road: whether it has left the road in any frame.
    """

    target_lane_index: LaneIndex = None  # pyright: ignore
    target_speed = 0.0
    left_road = False
    KP_A, KP_HEADING, KP_LATERAL = (ControlledVehicle.KP_A, ControlledVehicle.KP_HEADING, ControlledVehicle.KP_LATERAL)
    TAU_PURSUIT, MAX_STEERING_ANGLE = ControlledVehicle.TAU_PURSUIT, ControlledVehicle.MAX_STEERING_ANGLE
    follow_road, steering_control = ControlledVehicle.follow_road, ControlledVehicle.steering_control
    speed_control = ControlledVehicle.speed_control

    def tell(self, choice: Choice, desired: float) -> None:
        """Take a choice where the desired speed is this [m/s]; bends ahead may allow less."""
        self.target_speed = min(choice.share * desired, self._allowed())
        start, end, number = self.target_lane_index
        self.target_lane_index = start, end, number + choice.change

    def choices(self, desired: float) -> Iterator[Choice]:
        """Yield what may be told now: each speed in its lane, and the desired one in those beside it.

        Of the speeds that it cannot reach until the next choice, only the next ones count.
        """
        changes, most = np.array(SHARES) * desired - self.speed, self.grip * SECONDS
        slower, faster = np.append(-np.inf, changes[:-1]), np.append(changes[1:], np.inf)
        yield from map(Choice, np.array(SHARES)[(faster > -most) & (slower < most)].tolist())
        start, end, number = self.target_lane_index
        for change in (-1, 1):
            if 0 <= number + change < len(self.road.network.graph[start][end]):
                lane = self.road.network.get_lane((start, end, number + change))
                if lane.is_reachable_from(self.position):
                    yield Choice(1.0, change)

    def _allowed(self) -> float:
        """Return the speed from which gentle braking, a choice later, suffices for all bends ahead."""
        seen = copy(self).look()  # not from the memory of lanes once followed, which copies of the environment lack
        bends = np.maximum(np.abs(seen.route.curvature[round(BEHIND / SPACING) :]), 1e-4)
        left = np.maximum(SPACING * np.arange(len(bends)) - self.speed * SECONDS, 0.0)
        return float(np.sqrt(CORNERING * self.grip / bends + 2 * SLOWING * left).min())

    def act(self, action: Any = None) -> None:
        """Go for the lane and the speed; actions are ignored."""
        self.follow_road()
        slip = atan(tan(self.steering_control(self.target_lane_index)) / 2)
        self._wanted = np.array([2 * sin(slip) / self.LENGTH, self.speed_control(self.target_speed)])

    def step(self, dt: float) -> None:
        """Move for ``dt`` seconds."""
        super().step(dt)
        self.left_road |= not self.crashed and not stays_on_road(self)


def put_told(env: gym.Env) -> None:
    """Put a car that is told, on its way to the goal, in the place of the ego of a stock environment."""
    told = replace_ego(env, lambda old: Told(old.road, old.position, old.heading, old.speed))
    told.route = route_to_goal(env.unwrapped) or told.route
    told.goal, told.target_lane_index = destination_of(env), told.lane_index


class Node(NamedTuple):
    """A copy of the environment, and how it came about.

    Attributes:
        env: the copy.
        earned: rewards so far.
        steps: of the environment so far.
        told: choices so far.
        ended: whether the episode has ended, or the car has crashed or left the road.
    """

    env: Any
    earned: float = 0.0
    steps: int = 0
    told: tuple[Choice, ...] = ()
    ended: bool = False

    @property
    def ego(self) -> Any:
        """The car that is told."""
        return self.env.vehicle

    @property
    def failed(self) -> bool:
        """Whether the car has crashed or left the road."""
        return bool(self.ego.crashed or self.ego.left_road)

    @property
    def cell(self) -> tuple[int, ...]:
        """What nodes have in common of which one is kept."""
        place = np.array([*self.ego.position, self.ego.speed]) / CELL
        return (*np.rint(place).astype(int).tolist(), self.ego.target_lane_index[2])

    @property
    def worth(self) -> tuple[bool, bool, int, float]:
        """What ends are compared by: success, no failure, how long it lasted otherwise, and the reward per step."""
        sound = not self.failed
        return sound and success(self.env) is not False, sound, 0 if sound else self.steps, self.earned / self.steps

    def after(self, choice: Choice, desired: float) -> "Node":
        """Return the node that a choice leads to."""
        env, earned, steps = copied(self.env), self.earned, self.steps
        env.vehicle.tell(choice, desired)
        for _ in range(steps_of_choice(env)):
            _, reward, terminated, truncated, _ = env.step(unheeded(env.action_type))
            earned, steps = earned + float(reward), steps + 1
            ended = has_ended(env, terminated, truncated) or env.vehicle.left_road
            if ended:
                break
        return Node(env, earned, steps, (*self.told, choice), ended)


def steps_of_choice(env: Any) -> int:
    """Return how many steps of an environment a choice is held."""
    return max(1, round(SECONDS * env.config["policy_frequency"]))


def copied(env: Any) -> Any:
    """Return a copy of an environment with random numbers of its own, which are the same; its roads are shared."""
    network = env.road.network
    shared = network, *network.lanes_list(), env.config, env.observation_space, env.action_space, env.spec
    return deepcopy(env, {id(part): part for part in shared})


def best_end(env: Any, desired: float, kept: int = KEPT) -> Node:
    """Search for the end of the episode that is worth most.

    Args:
        env: whose controlled vehicle is `Told`; it is left as it is.
        desired: speed [m/s].
        kept: copies that are kept after each choice.
    """
    now, ends = [Node(env)], list[Node]()
    while now:
        after = [node.after(choice, desired) for node in now for choice in node.ego.choices(desired)]
        ends += [node for node in after if node.ended]
        cells: dict[tuple[int, ...], Node] = {}
        for node in sorted((node for node in after if not node.ended), key=lambda node: node.earned):
            cells[node.cell] = node
        now = sorted(cells.values(), key=lambda node: node.earned)[-kept:]
    return max(ends, key=lambda node: node.worth)


class Search(Peer):
    """Drive as a search found that knows all that will happen: *privileged*.

    The ego keeps within the tyres of this package's drivers, and decides once a second.

    Raises:
        ValueError: for an episode that is too long for it.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        duration = self.inner.config.get("duration", 0.0)
        if duration > LONGEST:
            raise ValueError(
                f"{self.inner.spec.id} lasts {duration:g} s, too long for the driver search; it searches {LONGEST:g} s "
                "at most"
            )

    def begin(self, seed: int | None) -> None:
        """Search from the start of the episode."""
        desired = desired_speed_of(self.inner)
        put_told(self.env)
        self.desired, self.left = desired, iter(best_end(self.inner, desired).told)
        self.every, self.steps = steps_of_choice(self.inner), 0

    def choose(self) -> Any:
        """Tell the car what was found."""
        if self.steps % self.every == 0:
            self.inner.vehicle.tell(next(self.left, Choice(0.0)), self.desired)
        self.steps += 1
        return super().choose()
