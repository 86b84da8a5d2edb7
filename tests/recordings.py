"""Write CommonRoad scenarios by hand: two lanes at an angle, cars that keep their
velocity, a planning problem.

All functions return XML. `place` converts places along the road to points of the map.
"""

import numpy as np

SPEED = 12.0  # m/s, of the cars
STEPS = 20
TURN = 0.6  # rad, of the road against the x axis of the map
LANE_WIDTH = 3.5  # m


def element(name, *content, **attributes):
    """An element with attributes, around its content."""
    written = "".join(f' {key}="{value}"' for key, value in attributes.items())
    return f"<{name}{written}>{''.join(map(str, content))}</{name}>"


def exact(name, value):
    return element(name, element("exact", value))


def interval(name, ends):
    first, last = ends
    return element(name, element("intervalStart", first), element("intervalEnd", last))


def point(x, y):
    return element("point", element("x", x), element("y", y))


# Places


def place(along, right):
    """A point of the map: a distance along the road, and a distance to the right of the
    left lane's centre.
    """
    cosine = np.cos(TURN)
    sine = np.sin(TURN)
    return along * cosine + right * sine, along * sine - right * cosine


def straight(start, end, points=30):
    """The line from a place along the road to another one [points, 2]."""
    return np.linspace(start, end, points)[:, None] * [np.cos(TURN), np.sin(TURN)]


def bend(radius, side, angle, before=60.0, after=30.0):
    """The line of a straight, an arc to the left (side 1) or to the right (side -1),
    and a straight.
    """
    step = min(2.0, radius / 10)
    turned = np.linspace(0.0, angle, round(radius * angle / step) + 1)

    # The three parts along the x axis, with the arc to the left.
    first = np.arange(0.0, before, step)
    straight_before = np.stack([first, 0 * first], axis=-1)
    directions = np.stack([np.sin(turned), 1 - np.cos(turned)], axis=-1)
    arc = [before, 0.0] + radius * directions
    last = np.arange(step, after, step)
    straight_after = arc[-1] + last[:, None] * [np.cos(angle), np.sin(angle)]
    along, left = np.concatenate([straight_before, arc, straight_after]).T

    cosine = np.cos(TURN)
    sine = np.sin(TURN)
    x = along * cosine - side * left * sine
    y = along * sine + side * left * cosine
    return np.stack([x, y], axis=-1)


# Roads


def lanelet(number, left, line, links="", kind="highway"):
    """A lanelet whose centre lies that far to the left of a line."""
    direction = np.gradient(line, axis=0)
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=-1)
    normal = normal / np.linalg.norm(direction, axis=-1, keepdims=True)

    def bound(name, offset):
        edge = line + (left + offset) * normal
        return element(name, *(point(x, y) for x, y in edge))

    return element(
        "lanelet",
        bound("leftBound", LANE_WIDTH / 2),
        bound("rightBound", -LANE_WIDTH / 2),
        links,
        element("laneletType", kind),
        id=number,
    )


def two_lanes(way="same", points=30):
    """Two lanes of two lanelets each, 1 and 2 to the left of 3 and 4, linked in the
    same or the opposite direction.
    """

    def beside(side, other):
        return element(f"adjacent{side}", ref=other, drivingDir=way)

    first = straight(0, 100, points)
    second = straight(100, 200, points)
    return "".join(
        [
            lanelet(1, 0.0, first, element("successor", ref=2) + beside("Right", 3)),
            lanelet(2, 0.0, second, element("predecessor", ref=1) + beside("Right", 4)),
            lanelet(
                3,
                -LANE_WIDTH,
                first,
                element("successor", ref=4) + beside("Left", 1),
            ),
            lanelet(
                4,
                -LANE_WIDTH,
                second,
                element("predecessor", ref=3) + beside("Left", 2),
            ),
        ]
    )


def sign(number, limit):
    """A speed limit sign of the United States."""
    shown = element(
        "trafficSignElement",
        element("trafficSignID", "R2-1"),
        element("additionalValue", limit),
    )
    return element("trafficSign", shown, id=number)


# Obstacles

RECTANGLE = element("rectangle", element("length", 4.5), element("width", 1.8))


def state(name, time, x, y, orientation, speed=SPEED, more=""):
    """A state of a tag, at a step of time."""
    return element(
        name,
        element("position", point(x, y)),
        exact("orientation", orientation),
        exact("time", time),
        exact("velocity", speed),
        more,
    )


def moving(number, states, kind="car", shape=RECTANGLE):
    """An obstacle with recorded states: step, x, y, orientation and speed."""
    first, *rest = states
    later = [state("state", *one) for one in rest]
    return element(
        "dynamicObstacle",
        element("type", kind),
        element("shape", shape),
        state("initialState", *first),
        element("trajectory", *later) if later else "",
        id=number,
    )


def car(number, start, right, samples=STEPS, first=0, shape=RECTANGLE):
    """A car that keeps its velocity along the road, recorded from a step on."""
    states = [
        (first + step, *place(start + SPEED * 0.1 * step, right), TURN)
        for step in range(samples)
    ]
    return moving(number, states, shape=shape)


def pedestrian(number, along, samples=STEPS):
    """A pedestrian who crosses the road from the right at 1.5 m/s."""
    states = [
        (step, *place(along, 5.0 - 0.15 * step), TURN + np.pi / 2, 1.5)
        for step in range(samples)
    ]
    circle = element("circle", element("radius", 0.3))
    return moving(number, states, "pedestrian", circle)


def standing(number, shape, x, y):
    """A static obstacle."""
    return element(
        "staticObstacle",
        element("type", "parkedVehicle"),
        element("shape", shape),
        state("initialState", 0, x, y, TURN),
        id=number,
    )


# Planning problems


def problem(
    start=20.0,
    right=0.0,
    speed=SPEED,
    *,
    goal: float | None = 50.0,
    goal_right=0.0,
    times=(10, 40),
    speeds=None,
    headings=None,
    number=7,
):
    """A planning problem: from a place to a region 20 m long and 3 m wide around
    another, within intervals.

    Without a goal, there is no region: it is reached in time, wherever on the road.
    """
    conditions = []
    if goal is not None:
        conditions.append(goal_position(goal, goal_right))
    if headings:
        conditions.append(interval("orientation", headings))
    conditions.append(interval("time", times))
    if speeds:
        conditions.append(interval("velocity", speeds))

    motion = exact("yawRate", 0) + exact("slipAngle", 0)
    x, y = place(start, right)
    return element(
        "planningProblem",
        state("initialState", 0, x, y, TURN, speed, motion),
        element("goalState", *conditions),
        id=number,
    )


def goal_position(along, right):
    """The position of a goal: a region around a place on the road."""
    x, y = place(along, right)
    region = element(
        "rectangle",
        element("length", 20),
        element("width", 3),
        element("orientation", TURN),
        element("center", element("x", x), element("y", y)),
    )
    return element("position", region)


def scenario(*, lanelets="", cars="", problems="", number=1):
    """A scenario, by default with two lanes and two cars."""
    location = element(
        "location",
        element("geoNameId", 1),
        element("gpsLatitude", 1),
        element("gpsLongitude", 1),
    )
    root = element(
        "commonRoad",
        location,
        element("scenarioTags", element("highway")),
        lanelets or two_lanes(),
        cars or car(100, 20, 0) + car(101, 40, 3.0),
        problems,
        commonRoadVersion="2020a",
        benchmarkID=f"USA_Test-1_{number}_T-1",
        timeStepSize=0.1,
        author="a",
        affiliation="b",
        source="c",
        date="2020-01-01",
    )
    return '<?xml version="1.0"?>' + root
