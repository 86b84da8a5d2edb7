"""Write drives in recordings as CommonRoad files, a scenario and a solution, which
other tools can evaluate.

The scenario is the recording with its road and planning problem; the other vehicles
move as they did in the episode. The solution is the drive of the ego: a state every 0.1
s of the kinematic single-track model (KS) of CommonRoad's vehicle 2, whose steering
angles are computed from the yaw rates of the ego.
"""

from datetime import datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ms_highway.game.scenario import TIME_STEP
from ms_highway.recorded.commonroad import read_xml
from ms_highway.runtime.extras import needing
from ms_highway.runtime.files import replacing

WHEELBASE = (
    2.578999  # m, of CommonRoad's vehicle 2, a BMW 320i, which is as large as the ego
)
EPOCH = "2000-01-01"  # date of a solution if the recording has none
MIN_STEERING_SPEED = 0.5  # m/s, lowest speed in the computation of steering angles


class Drive:
    """The states of all vehicles in an episode of a recorded environment, until now.

    Args:
        env: the environment, unwrapped, just reset; its recording is a file.
    """

    def __init__(self, env: Any) -> None:
        self._env = env
        self._states: dict[
            int | None, list[tuple[float, ...]]
        ] = {}  # by number of the track, None for the ego
        self._sizes: dict[int | None, tuple[float, float]] = {}
        self.see()

    def see(self) -> None:
        """Add the present states of all vehicles."""
        env = self._env
        everyone = [env.vehicle, *env.road.others]
        points = env.axes.points([vehicle.position for vehicle in everyone])
        orientations = env.axes.headings([vehicle.heading for vehicle in everyone])
        for vehicle, (x, y), orientation in zip(
            everyone, points.tolist(), orientations.tolist(), strict=True
        ):
            number = None if vehicle is env.vehicle else vehicle.track.number
            states = self._states.setdefault(number, [])
            states.append((env.road.now, x, y, orientation, float(vehicle.speed)))
            self._sizes[number] = vehicle.LENGTH, vehicle.WIDTH

    def write(self, directory: Path, name: str) -> None:
        """Write ``NAME.xml``, the scenario of the episode, and ``NAME.solution.xml``,
        the ego's solution.

        Raises:
            ImportError: without the packages of the extra ``commonroad``.
            OSError: if a file cannot be written.
        """
        with needing("commonroad"):
            from commonroad.common.solution import (
                CommonRoadSolutionWriter,
                CostFunction,
                PlanningProblemSolution,
                Solution,
                VehicleModel,
                VehicleType,
            )
            from commonroad.scenario.scenario import ScenarioID
            from commonroad.scenario.state import KSState
            from commonroad.scenario.trajectory import Trajectory
        recording = Path(self._env.config["recording"])
        driven = self._driven(recording)
        identity = ScenarioID.from_benchmark_id(
            driven.attrib["benchmarkID"], driven.attrib["commonRoadVersion"]
        )
        date = datetime.fromisoformat(
            driven.get("date", EPOCH)
        )  # equal drives give equal files
        with replacing(directory / f"{name}.xml") as path:
            ElementTree.ElementTree(driven).write(
                path, encoding="utf-8", xml_declaration=True
            )
        states = [
            KSState(
                int(step),
                np.array([x, y]),
                orientation=orientation,
                velocity=speed,
                steering_angle=angle,
            )
            for (step, x, y, orientation, speed), angle in zip(
                self._states[None], self._steering(), strict=True
            )
        ]
        own = PlanningProblemSolution(
            planning_problem_id=self._env.task.number,
            vehicle_model=VehicleModel.KS,
            vehicle_type=VehicleType.BMW_320i,
            cost_function=CostFunction.JB1,
            trajectory=Trajectory(states[0].time_step, states),
        )
        with replacing(directory / f"{name}.solution.xml") as path:
            whole = CommonRoadSolutionWriter(Solution(identity, [own], date=date))
            whole.write_to_file(str(path.parent.resolve()), path.name, overwrite=True)

    def _steering(self) -> list[float]:
        """Return the steering angle of CommonRoad's vehicle at each state, from the yaw
        rate of the next step [rad].
        """
        _, _, _, orientations, speeds = np.array(self._states[None]).T
        turned = np.diff(np.unwrap(orientations)) / (
            TIME_STEP * np.maximum(speeds[:-1], MIN_STEERING_SPEED)
        )
        angles = np.arctan(WHEELBASE * turned).tolist()
        return [*angles, *(angles[-1:] or [0.0])]

    def _driven(self, recording: Path) -> ElementTree.Element:
        """Return the XML of a recording with the driven in place of the recorded motion
        of the others.
        """
        root = ElementTree.fromstring(read_xml(recording))
        for obstacle in root.findall("dynamicObstacle"):
            number = int(obstacle.attrib["id"])
            if number not in self._states:
                root.remove(obstacle)
                continue
            for old in [
                part
                for part in obstacle
                if part.tag in ("shape", "initialState", "trajectory")
            ]:
                obstacle.remove(old)
            length, width = self._sizes[
                number
            ]  # without an offset: states are those of the centre
            first, *later = (_state(row) for row in self._states[number])
            first.tag = "initialState"
            box = f"<rectangle><length>{length!r}</length><width>{width!r}</width></rectangle>"
            obstacle.extend([ElementTree.fromstring(f"<shape>{box}</shape>"), first])
            if later:
                ElementTree.SubElement(obstacle, "trajectory").extend(later)
        return root


def _state(row: tuple[float, ...]) -> ElementTree.Element:
    """Return a state in CommonRoad's XML, given its time step, x, y, orientation and
    speed.
    """
    step, x, y, orientation, speed = row
    return ElementTree.fromstring(
        f"<state><position><point><x>{x!r}</x><y>{y!r}</y></point></position>"
        f"<orientation><exact>{orientation!r}</exact></orientation><time><exact>{int(step)}</exact></time>"
        f"<velocity><exact>{speed!r}</exact></velocity></state>"
    )
