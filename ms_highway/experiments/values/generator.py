"""Draw scenes to learn values on, so that these serve scenes that nobody has learned on.

All scenes have three lanes, eight cones and two scripted cars, of which some stand on each other or far away: one
program serves them all.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from ms_highway.experiments.values.rollouts import Course, Random
from ms_highway.game.scenario import COMMON_WEIGHTS, Scenario, draw_episode
from ms_highway.simulation.records import Loop

LANE = 0.1  # paper units, between the lanes' centres
FAR = 300.0  # paper units, 10 km
SHORTEST_GAP = 0.19  # paper units between the centres of cars in one lane
STEPS = 40


def draw_scenario(random: Random) -> Scenario:
    """Draw lanes, cars, cones, and what both drivers are after."""
    while True:
        count = int(random.choice([1, 2, 3], p=[0.1, 0.6, 0.3]))
        lanes = [-LANE * lane for lane in range(count)]
        robot, human = int(random.integers(count)), int(random.integers(count))
        if count > 1 and robot == human and random.random() < 0.7:
            human = (robot + 1) % count
        cars = [(0.0, lanes[robot]), (random.uniform(-0.3, 0.25), lanes[human])]
        leads, follows = random.random() < 0.6, random.random() < 0.3
        ahead = max(x for x, _ in cars) + random.uniform(0.15, 0.4), lanes[random.choice([human, count - 1])]
        behind = min(x for x, _ in cars) - random.uniform(0.2, 0.45), lanes[random.choice([human, robot])]
        cars += [ahead if leads else (FAR, lanes[0]), behind if follows else (-FAR, lanes[0])]
        gaps = [abs(one[0] - two[0]) for k, one in enumerate(cars) for two in cars[:k] if one[1] == two[1]]
        if min(gaps, default=1.0) > SHORTEST_GAP:
            break
    cones = [(FAR, 0.0)] * 8
    if random.random() < 0.4:
        closed, first, last = lanes[random.choice([robot, human])], random.uniform(0.3, 0.9), int(random.integers(3, 9))
        side = random.uniform(-0.03, 0.03)
        cones[:last] = [(first + 0.07 * place, closed + side) for place in range(last)]
    return Scenario(
        name="generated",
        lanes=tuple((lanes * 3)[:3]),
        cars=tuple(cars),
        steps=STEPS,
        ladder=("naive", "turn", "tom"),
        prices=(0.1, 0.1),
        robot_weights=_robot_weights(random, leads),
        human_weights=({"target_lane": _between(random, 60, 1000)} if random.random() < 0.75 else {})
        | ({"gap": _between(random, 10, 90)} if leads and random.random() < 0.4 else {}),
        robot_gap=random.uniform(0.2, 0.4),
        human_gap=random.uniform(0.2, 0.4),
        cones=tuple(cones),
        merging_car=int(random.integers(2)),
    )


def _robot_weights(random: Random, leads: bool) -> dict[str, float]:
    """Draw weights: the common ones, each within a third of its own, as collisions cost what they do, and aims."""
    weights = {
        name: weight if name == "collision" else weight * _between(random, 0.75, 1.33)
        for name, weight in COMMON_WEIGHTS.items()
    }
    if random.random() < 0.75:
        weights |= {"target_lane": _between(random, 60, 1000), "merged": random.choice([0.0, 5.0])}
    if leads and random.random() < 0.3:
        weights["gap"] = _between(random, 5, 70)
    if random.random() < 0.3:
        weights |= {"partner_target_lane": _between(random, 100, 500), "partner_merged": random.choice([0.0, 5.0])}
    return weights


def _between(random: Random, low: float, high: float) -> float:
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def generated_courses(
    loop: Callable[[Scenario], Loop], rungs: tuple[int, ...], count: int, random: Random
) -> list[Course]:
    """Draw courses, which share the states of not quite three whole ones.

    Args:
        loop: makes what the episodes of a scenario have in common.
        rungs: places of the models of every course in the ladder that is learned.
        count: number of courses.
        random: draws them.
    """
    share, courses = min(1.0, 3 / count) * 0.99, []
    for place in range(count):
        scenario = draw_scenario(random)
        own = loop(scenario)
        draw = partial(draw_episode, scenario, humans=own.game.humans)
        courses.append(Course(f"generated {place}", own, draw, STEPS, rungs, share))
    return courses
