"""CommonRoad scenarios written by hand: two lanes at an angle, cars that keep their
velocity, a planning problem.
"""

import numpy as np

SPEED = 12.0  # m/s, of the cars
STEPS = 20
TURN = 0.6  # rad, of the road against the x axis of the map


def lanelet(number, left, line, links=""):
    """A lanelet 3.5 m wide whose centre lies that far to the left of a line."""
    direction = np.gradient(line, axis=0)
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=-1) / np.linalg.norm(
        direction, axis=-1, keepdims=True
    )
    bounds = {
        side: "".join(
            f"<point><x>{x}</x><y>{y}</y></point>"
            for x, y in line + (left + half) * normal
        )
        for side, half in (("leftBound", 1.75), ("rightBound", -1.75))
    }
    sides = "".join(f"<{side}>{points}</{side}>" for side, points in bounds.items())
    return (
        "<lanelet"
        f' id="{number}">{sides}{links}<laneletType>highway</laneletType></lanelet>'
    )


def straight(start, end, points=30):
    return np.linspace(start, end, points)[:, None] * [np.cos(TURN), np.sin(TURN)]


def bend(radius, side, angle, before=60.0, after=30.0):
    """The line of a straight, an arc to the left (side 1) or to the right (side -1),
    and a straight.
    """
    step = min(2.0, radius / 10)
    turned = np.linspace(0.0, angle, round(radius * angle / step) + 1)
    arc = [before, 0.0] + radius * np.stack(
        [np.sin(turned), 1 - np.cos(turned)], axis=-1
    )
    first = np.arange(0.0, before, step)
    last = np.arange(step, after, step)
    out = arc[-1] + last[:, None] * [np.cos(angle), np.sin(angle)]
    along, left = np.concatenate([np.stack([first, 0 * first], axis=-1), arc, out]).T
    cosine = np.cos(TURN)
    sine = np.sin(TURN)
    return np.stack(
        [along * cosine - side * left * sine, along * sine + side * left * cosine],
        axis=-1,
    )


def two_lanes(way="same", points=30):
    """Two lanes of two lanelets each, 1 and 2 to the left of 3 and 4, linked in the
    same or the opposite direction.
    """
    lanes = (
        (1, 0.0, "Right", 3, 0),
        (2, 0.0, "Right", 4, 1),
        (3, -3.5, "Left", 1, 0),
        (4, -3.5, "Left", 2, 1),
    )
    joints = '<successor ref="{}"/>', '<predecessor ref="{}"/>'
    return "".join(
        lanelet(
            number,
            left,
            straight(100 * second, 100 * second + 100, points),
            f"{joints[second].format(number + 1 - 2 * second)}<adjacent{side}"
            f' ref="{other}" drivingDir="{way}"/>',
        )
        for number, left, side, other, second in lanes
    )


def place(along, right):
    """A point of the map: a distance along the road, and a distance to the right of the
    left lane's centre.
    """
    cosine = np.cos(TURN)
    sine = np.sin(TURN)
    return along * cosine + right * sine, along * sine - right * cosine


def state(name, time, x, y, orientation, speed=SPEED, more=""):
    return (
        f"<{name}><position><point><x>{x}</x><y>{y}</y></point></position>"
        f"<orientation><exact>{orientation}</exact></orientation><time><exact>{time}</exact></time>"
        f"<velocity><exact>{speed}</exact></velocity>{more}</{name}>"
    )


RECTANGLE = "<rectangle><length>4.5</length><width>1.8</width></rectangle>"


def moving(number, states, kind="car", shape=RECTANGLE):
    """An obstacle with recorded states: step, x, y, orientation and speed."""
    first, *rest = states
    trajectory = (
        f"<trajectory>{''.join(state('state', *one) for one in rest)}</trajectory>"
        if rest
        else ""
    )
    return (
        f'<dynamicObstacle id="{number}"><type>{kind}</type><shape>{shape}</shape>'
        f"{state('initialState', *first)}{trajectory}</dynamicObstacle>"
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
    return moving(number, states, "pedestrian", "<circle><radius>0.3</radius></circle>")


def standing(number, shape, x, y):
    """A static obstacle."""
    there = f"<type>parkedVehicle</type><shape>{shape}</shape>{state('initialState', 0, x, y, TURN)}"
    return f'<staticObstacle id="{number}">{there}</staticObstacle>'


def sign(number, limit):
    """A speed limit sign of the United States."""
    value = f"<additionalValue>{limit}</additionalValue>"
    element = f"<trafficSignElement><trafficSignID>R2-1</trafficSignID>{value}</trafficSignElement>"
    return f'<trafficSign id="{number}">{element}</trafficSign>'


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
):
    """A planning problem: from a place to a region 20 m long and 3 m wide around
    another, within intervals.

    Without a goal, there is no region: it is reached in time, wherever on the road.
    """

    def between(name, values):
        low, high = values
        return f"<{name}><intervalStart>{low}</intervalStart><intervalEnd>{high}</intervalEnd></{name}>"

    x, y = place(goal or 0.0, goal_right)
    region = (
        f"<position><rectangle><length>20</length><width>3</width><orientation>{TURN}</orientation>"
        f"<center><x>{x}</x><y>{y}</y></center></rectangle></position>"
    )
    direction = between("orientation", headings) if headings else ""
    more = "<yawRate><exact>0</exact></yawRate><slipAngle><exact>0</exact></slipAngle>"
    return (
        "<planningProblem"
        f' id="7">{state("initialState", 0, *place(start, right), TURN, speed, more)}<goalState>'
        f"{'' if goal is None else region}{direction}{between('time', times)}"
        f"{between('velocity', speeds) if speeds else ''}</goalState></planningProblem>"
    )


def scenario(*, lanelets="", cars="", problems="", number=1):
    """A scenario, by default with two lanes and two cars."""
    return (
        '<?xml version="1.0"?><commonRoad commonRoadVersion="2020a"'
        f' benchmarkID="USA_Test-1_{number}_T-1" '
        'timeStepSize="0.1" author="a" affiliation="b" source="c" date="2020-01-01">'
        "<location><geoNameId>1</geoNameId><gpsLatitude>1</gpsLatitude><gpsLongitude>1</gpsLongitude></location>"
        "<scenarioTags><highway/></scenarioTags>"
        f"{lanelets or two_lanes()}{cars or car(100, 20, 0) + car(101, 40, 3.0)}{problems}</commonRoad>"
    )
