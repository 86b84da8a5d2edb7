"""CommonRoad scenarios written by hand: two lanes at an angle, cars that keep their velocity, a planning problem."""

import numpy as np

SPEED = 12.0  # m/s, of the cars
STEPS = 20
TURN = 0.6  # rad, of the road against the x axis of the map


def lanelet(number, left, line, links=""):
    """A lanelet 3.5 m wide whose centre lies that far to the left of a line."""
    direction = np.gradient(line, axis=0)
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=-1) / np.linalg.norm(direction, axis=-1, keepdims=True)
    bounds = {
        side: "".join(f"<point><x>{x}</x><y>{y}</y></point>" for x, y in line + (left + half) * normal)
        for side, half in (("leftBound", 1.75), ("rightBound", -1.75))
    }
    sides = "".join(f"<{side}>{points}</{side}>" for side, points in bounds.items())
    return f'<lanelet id="{number}">{sides}{links}<laneletType>highway</laneletType></lanelet>'


def straight(start, end):
    return np.linspace(start, end, 30)[:, None] * [np.cos(TURN), np.sin(TURN)]


def two_lanes():
    """Two lanes; the left one, lanelets 1 and 2, is listed last, and none knows who is beside it."""
    return (
        lanelet(3, -3.5, straight(0, 200))
        + lanelet(2, 0.0, straight(100, 200), '<predecessor ref="1"/>')
        + lanelet(1, 0.0, straight(0, 100), '<successor ref="2"/>')
    )


def linked_lanes(way="same"):
    """Two lanes of two lanelets each, 1 and 2 to the left of 3 and 4, that know each other, and which way they go."""
    lanes = ((1, 0.0, "Right", 3, 0), (2, 0.0, "Right", 4, 1), (3, -3.5, "Left", 1, 0), (4, -3.5, "Left", 2, 1))
    joints = '<successor ref="{}"/>', '<predecessor ref="{}"/>'
    return "".join(
        lanelet(
            number,
            left,
            straight(100 * second, 100 * second + 100),
            f'{joints[second].format(number + 1 - 2 * second)}<adjacent{side} ref="{other}" drivingDir="{way}"/>',
        )
        for number, left, side, other, second in lanes
    )


def place(along, right):
    """A point of the map at a place along the road, that far to the right of the left lane's centre."""
    cosine, sine = np.cos(TURN), np.sin(TURN)
    return along * cosine + right * sine, along * sine - right * cosine


def state(name, time, x, y, orientation, speed=SPEED, more=""):
    return (
        f"<{name}><position><point><x>{x}</x><y>{y}</y></point></position>"
        f"<orientation><exact>{orientation}</exact></orientation><time><exact>{time}</exact></time>"
        f"<velocity><exact>{speed}</exact></velocity>{more}</{name}>"
    )


def car(number, start, right, samples=STEPS, first=0):
    """A car that keeps its velocity along the road from a step on."""
    points = [place(start + SPEED * 0.1 * step, right) for step in range(samples)]
    states = [state("state", first + step, *point, TURN) for step, point in enumerate(points)]
    trajectory = f"<trajectory>{''.join(states[1:])}</trajectory>" if samples > 1 else ""
    return (
        f'<dynamicObstacle id="{number}"><type>car</type><shape><rectangle><length>4.5</length><width>1.8</width>'
        f"</rectangle></shape>{state('initialState', first, *points[0], TURN)}{trajectory}</dynamicObstacle>"
    )


def problem(
    start=20.0, right=0.0, speed=SPEED, *, goal=50.0, goal_right=0.0, times=(10, 40), speeds=None, headings=None, time=0
):
    """A planning problem: from a place to a region 20 m long and 3 m wide around another, in intervals of the rest."""

    def between(name, values):
        low, high = values
        return f"<{name}><intervalStart>{low}</intervalStart><intervalEnd>{high}</intervalEnd></{name}>"

    x, y = place(goal, goal_right)
    more = "<yawRate><exact>0</exact></yawRate><slipAngle><exact>0</exact></slipAngle>"
    return (
        f'<planningProblem id="7">{state("initialState", time, *place(start, right), TURN, speed, more)}<goalState>'
        f"<position><rectangle><length>20</length><width>3</width><orientation>{TURN}</orientation>"
        f"<center><x>{x}</x><y>{y}</y></center></rectangle></position>"
        f"{between('orientation', headings) if headings else ''}{between('time', times)}"
        f"{between('velocity', speeds) if speeds else ''}</goalState></planningProblem>"
    )


def scenario(*, lanelets=None, cars=None, problems="", time_step=0.1, number=1):
    return (
        f'<?xml version="1.0"?><commonRoad commonRoadVersion="2020a" benchmarkID="USA_Test-1_{number}_T-1" '
        f'timeStepSize="{time_step}" author="a" affiliation="b" source="c" date="2020-01-01">'
        "<location><geoNameId>1</geoNameId><gpsLatitude>1</gpsLatitude><gpsLongitude>1</gpsLongitude></location>"
        "<scenarioTags><highway/></scenarioTags>"
        f"{two_lanes() if lanelets is None else lanelets}"
        f"{car(100, 20, 0) + car(101, 40, 3.0) if cars is None else cars}{problems}</commonRoad>"
    )
