"""Read each element of CommonRoad files; refuse a damaged file by the names of the file
and the element.
"""

import copy
import random
import re
from xml.etree import ElementTree

import gymnasium as gym
import numpy as np
import pytest
from commonroad.common.reader.file_reader_xml import XMLFileReader
from recordings import (
    RECTANGLE,
    car,
    element,
    interval,
    lanelet,
    pedestrian,
    place,
    point,
    problem,
    scenario,
    sign,
    standing,
    straight,
    two_lanes,
)

from ms_highway.recorded.commonroad import read_scenario

HOSTILE = [
    "",
    "x",
    "nan",
    "inf",
    "-1",
    "0",
    "1e9",
    "1e400",
    "9" * 5000,
    "0.5",
    "7",
    "100",
    "²",
    "<>\n",
]


def damage(root, chance):
    """Damage one element of a file; every kind of element has the same chance."""
    kinds = {element.tag for element in root.iter()} - {root.tag}
    kind = chance.choice(sorted(kinds))
    of_kind = [
        (parent, child)
        for parent in root.iter()
        for child in parent
        if child.tag == kind
    ]
    parent, element = chance.choice(of_kind)
    how = chance.choice(["remove", "rename", "text", "attribute"])
    if how == "remove":
        parent.remove(element)
    elif how == "rename":
        element.tag = chance.choice(["x", "circle", "lanelet", "point", "exact"])
    elif how == "attribute" and element.attrib:
        element.set(chance.choice(sorted(element.attrib)), chance.choice(HOSTILE))
    else:
        element.text = chance.choice(HOSTILE)


def varied():
    """A scenario with an element of each kind."""
    # Lanes, one with a sign, and a way for pedestrians.
    with_sign = '<trafficSignRef ref="50"/><laneletType>'
    lanes = two_lanes(points=6).replace("<laneletType>", with_sign, 1)
    walk = lanelet(9, -7.0, straight(0, 200, 6), kind="sidewalk")

    # Obstacles of each role and shape.
    moving = car(100, 60, 0, 5) + pedestrian(102, 120, 5)
    corners = [point(x, y) for x, y in ((0, 50), (9, 50), (9, 70))]
    polygon = element("polygon", *corners)
    static = standing(103, RECTANGLE, *place(180, 3.5)) + standing(104, polygon, 0, 0)

    # A problem with two goals: a rectangle, and a lanelet.
    in_lanelet = element(
        "goalState",
        element("position", element("lanelet", ref=2)),
        interval("time", (20, 30)),
    )
    problems = problem(speeds=(5.0, 20.0), headings=(0.0, 1.0))
    problems = problems.replace("</planningP", in_lanelet + "</planningP")
    return scenario(
        lanelets=lanes + sign(50, 13.9) + walk, cars=moving + static, problems=problems
    )


def test_commonroads_own_reader_finds_the_same_content(tmp_path):
    path = tmp_path / "varied.xml"
    path.write_text(varied())
    scene, problems = XMLFileReader(str(path)).open()
    found = read_scenario(path)

    for lane in found.lanelets:
        same = scene.lanelet_network.find_lanelet_by_id(lane.number)
        np.testing.assert_array_equal(lane.left, same.left_vertices)
        np.testing.assert_array_equal(lane.right, same.right_vertices)
        assert list(lane.before) == same.predecessor
        assert list(lane.after) == same.successor
        assert lane.beside == (same.adj_left, same.adj_right)

    for track in found.tracks[:2]:
        obstacle = scene.obstacle_by_id(track.number)
        states = [obstacle.initial_state, *obstacle.prediction.trajectory.state_list]
        rows = [
            [state.time_step, *state.position, state.orientation, state.velocity]
            for state in states
        ]
        np.testing.assert_allclose(track.samples, rows, atol=1e-9)
    shape = scene.obstacle_by_id(100).obstacle_shape
    assert found.tracks[0].size == (shape.length, shape.width)

    (same_problem,) = problems.planning_problem_dict.values()
    start = same_problem.initial_state
    assert found.problems[0].start == (*start.position, start.orientation, 12.0)


def test_damaged_files_are_read_or_refused_by_file_and_element(tmp_path):
    path = tmp_path / "damaged.xml"
    whole = ElementTree.fromstring(varied())
    names = "|".join(sorted({element.tag for element in whole.iter()}))
    refusal = rf".*damaged\.xml\W.*\b({names}|planning problem)\b"
    wrong = {}
    survived = 0
    path.write_text(varied())
    env = gym.make(
        "ms-highway/recorded-v0", config={"recording": str(path), "traffic": "replay"}
    ).unwrapped
    for seed in range(200):
        root = copy.deepcopy(whole)
        damage(root, random.Random(seed))
        path.write_bytes(ElementTree.tostring(root))
        try:
            env.reset(seed=0)
            env.road.act()
            env.road.step(0.1)
            survived += 1
        except ValueError as error:
            if not re.match(refusal, str(error)):
                wrong[seed] = str(error)
        except Exception as error:
            wrong[seed] = repr(error)
    assert not wrong
    assert 40 < survived < 160


def test_a_time_step_that_is_no_number_is_named(tmp_path):
    path = tmp_path / "damaged.xml"
    path.write_text(scenario().replace('timeStepSize="0.1"', 'timeStepSize="often"'))
    with pytest.raises(
        ValueError, match=r"damaged\.xml .*timeStepSize of <commonRoad>"
    ):
        read_scenario(path)
