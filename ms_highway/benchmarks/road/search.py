"""A bound on what drivers can earn: a beam search over copies of the environment, which know what will happen."""

from collections.abc import Iterator
from copy import deepcopy
from math import atan, sin, tan
from typing import Any, NamedTuple

import numpy as np
from highway_env.road.road import LaneIndex
from highway_env.vehicle.controller import ControlledVehicle

from ms_highway.benchmarks.road.peers import Peer, route_to_goal
from ms_highway.envs.road.driven import unheeded
from ms_highway.envs.road.stock import desired_speed_of, destination_of, replace_ego, success
from ms_highway.game.road import BEHIND, SPACING
from ms_highway.planning.road.settings import CORNERING
from ms_highway.vehicle.road_robot import RoadRobot

SHARES = 0.0, 0.3, 0.5, 0.67, 0.85, 1.0
"""Speeds that may be told, as shares of the desired one."""

SECONDS = 1.0
"""Time that each choice is held [s]."""

KEPT = 16
"""Copies that are kept after each choice."""

CELL = 3.0, 1.5, 1.5  # m, m, m/s: of x, y and speed; of the copies in one, the one that has earned most is kept
LONGEST = 60.0  # s
SLOWING = 2.5  # m/s^2, before bends


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
    """

    target_lane_index: LaneIndex = None  # pyright: ignore
    target_speed = 0.0
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
        bends = np.maximum(np.abs(self.look().route.curvature[round(BEHIND / SPACING) :]), 1e-4)
        left = np.maximum(SPACING * np.arange(len(bends)) - self.speed * SECONDS, 0.0)
        return float(np.sqrt(CORNERING * self.grip / bends + 2 * SLOWING * left).min())

    def act(self, action: Any = None) -> None:
        """Go for the lane and the speed; actions are ignored."""
        self.follow_road()
        slip = atan(tan(self.steering_control(self.target_lane_index)) / 2)
        self._wanted = np.array([2 * sin(slip) / self.LENGTH, self.speed_control(self.target_speed)])


class Node(NamedTuple):
    """A copy of the environment, what it has earned, the choices that led there, and whether the episode has ended."""

    env: Any
    earned: float = 0.0
    told: tuple[Choice, ...] = ()
    ended: bool = False

    @property
    def ego(self) -> Any:
        """The car that is told."""
        return self.env.vehicle

    @property
    def cell(self) -> tuple[int, ...]:
        """What nodes have in common of which one is kept."""
        place = np.array([*self.ego.position, self.ego.speed]) / CELL
        return (*np.rint(place).astype(int).tolist(), self.ego.target_lane_index[2])

    @property
    def worth(self) -> tuple[bool, bool, int, float]:
        """What ends are compared by: success, no crash, how long it lasted otherwise, and what was earned."""
        return (
            not self.failed and success(self.env) is not False,
            not self.failed,
            self.failed * len(self.told),
            self.earned,
        )

    @property
    def failed(self) -> bool:
        """Whether the car has crashed or left the road."""
        return bool(self.ego.crashed or not self.ego.on_road)

    def after(self, choice: Choice, desired: float) -> "Node":
        """Return the node that a choice leads to."""
        env, earned, ended = copied(self.env), self.earned, False
        env.vehicle.tell(choice, desired)
        for _ in range(max(1, round(SECONDS * env.config["policy_frequency"]))):
            _, reward, terminated, truncated, _ = env.step(unheeded(env.action_type))
            earned += float(reward)
            ended = terminated or truncated or env.time >= max(LONGEST, env.config.get("duration", 0.0))
            if ended or not env.vehicle.on_road:
                break
        node = Node(env, earned, (*self.told, choice), bool(ended))
        return node._replace(ended=node.ended or node.failed)


def copied(env: Any) -> Any:
    """Return a copy of an environment with random numbers of its own, which are the same; its roads are shared."""
    shared = env.road.network, env.config, env.observation_space, env.action_space, env.spec
    return deepcopy(env, {id(part): part for part in shared})


def best_choices(env: Any, desired: float) -> tuple[Choice, ...]:
    """Search for the choices that earn most until the episode ends.

    Args:
        env: whose controlled vehicle is `Told`; it is left as it is.
        desired: speed [m/s].
    """
    now, ends = [Node(env)], list[Node]()
    while now:
        after = [node.after(choice, desired) for node in now for choice in node.ego.choices(desired)]
        ends += [node for node in after if node.ended]
        cells: dict[tuple[int, ...], Node] = {}
        for node in sorted((node for node in after if not node.ended), key=lambda node: node.earned):
            cells[node.cell] = node
        now = sorted(cells.values(), key=lambda node: node.earned)[-KEPT:]
    return max(ends, key=lambda node: node.worth).told


class Search(Peer):
    """Drive as a search found that knows all that will happen: *privileged*, a bound on what others can earn.

    The ego holds the tyres of this package's drivers, and decides once a second.
    """

    def begin(self, seed: int | None) -> None:
        """Search from the start of the episode."""
        desired = desired_speed_of(self.inner)
        told = replace_ego(self.env, lambda old: Told(old.road, old.position, old.heading, old.speed))
        told.route = route_to_goal(self.inner) or told.route
        told.goal, told.target_lane_index = destination_of(self.inner), told.lane_index
        self.desired, self.left = desired, iter(best_choices(self.inner, desired))
        self.every, self.steps = max(1, round(SECONDS * self.inner.config["policy_frequency"])), 0

    def choose(self) -> Any:
        """Tell the car what was found."""
        if self.steps % self.every == 0:
            self.inner.vehicle.tell(next(self.left, Choice(0.0)), self.desired)
        self.steps += 1
        return super().choose()
