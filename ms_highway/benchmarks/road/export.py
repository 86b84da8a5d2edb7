"""Write drives in recordings as CommonRoad files, which other tools can evaluate.

A drive has two files, a scenario and a solution. The scenario is the recording with its
road and planning problem; the other vehicles move as they did in the episode. The
solution is the drive of the ego: a state every 0.1 s of the kinematic single-track
model (KS) of CommonRoad's vehicle 2, whose steering angles are computed from the yaw
rates of the ego.
"""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ms_highway.game.scenario import TIME_STEP
from ms_highway.recorded.commonroad import read_xml
from ms_highway.recorded.environment import RecordedEnv
from ms_highway.runtime.extras import needing
from ms_highway.runtime.files import replacing


@dataclass(frozen=True)
class SolutionVehicle:
    """Describe the vehicle of a solution."""

    wheelbase: float
    """Distance of the axles [m]."""
    min_speed: float = 0.5
    """Lowest speed in the computation of steering angles [m/s]."""


BMW_320I = SolutionVehicle(wheelbase=2.578999)
"""CommonRoad's vehicle 2, which is as large as the ego."""


class Drive:
    """The states of all vehicles in an episode of a recorded environment, until now.

    Args:
        env: the environment, unwrapped, just reset; its recording is a file.
    """

    def __init__(self, env: RecordedEnv) -> None:
        self._env = env
        # By number of the track, None for the ego: time step, x, y, orientation, speed.
        self._states: dict[int | None, list[tuple[float, ...]]] = {}
        self._sizes: dict[int | None, tuple[float, float]] = {}
        self.see()

    def see(self) -> None:
        """Add the present states of all vehicles."""
        env = self._env
        everyone = [env.vehicle, *env.road.others]
        points = env.axes.points([vehicle.position for vehicle in everyone]).tolist()
        headings = env.axes.headings([vehicle.heading for vehicle in everyone])
        orientations = headings.tolist()
        for vehicle, (x, y), orientation in zip(
            everyone, points, orientations, strict=True
        ):
            number = None if vehicle is env.vehicle else vehicle.track.number
            states = self._states.setdefault(number, [])
            states.append((env.road.now, x, y, orientation, float(vehicle.speed)))
            self._sizes[number] = vehicle.LENGTH, vehicle.WIDTH

    def write(self, directory: Path, name: str) -> None:
        """Write the scenario of the episode and the ego's solution.

        They are ``NAME.xml`` and ``NAME.solution.xml``.

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
        scenario = self._scenario(recording)

        # What may be refused is read before anything is written. A fixed date stands
        # where the recording has none: equal drives give equal files.
        identity = ScenarioID.from_benchmark_id(
            scenario.attrib["benchmarkID"], scenario.attrib["commonRoadVersion"]
        )
        date = datetime.fromisoformat(scenario.get("date", "2000-01-01"))
        with replacing(directory / f"{name}.xml") as path:
            ElementTree.ElementTree(scenario).write(
                path, encoding="utf-8", xml_declaration=True
            )

        states = []
        own_states = zip(self._states[None], self._steering(), strict=True)
        for (step, x, y, orientation, speed), angle in own_states:
            state = KSState(
                int(step),
                np.array([x, y]),
                orientation=orientation,
                velocity=speed,
                steering_angle=angle,
            )
            states.append(state)
        own = PlanningProblemSolution(
            planning_problem_id=self._env.task.number,
            vehicle_model=VehicleModel.KS,
            vehicle_type=VehicleType.BMW_320i,
            cost_function=CostFunction.JB1,
            trajectory=Trajectory(states[0].time_step, states),
        )
        with replacing(directory / f"{name}.solution.xml") as path:
            writer = CommonRoadSolutionWriter(Solution(identity, [own], date=date))
            writer.write_to_file(str(path.parent.resolve()), path.name, overwrite=True)

    def _steering(self) -> list[float]:
        """Return the steering angle of the solution's vehicle at each state [rad].

        It follows from the yaw rate of the next step; the last state keeps that of the
        state before it.
        """
        _, _, _, orientations, speeds = np.array(self._states[None]).T
        speeds = np.maximum(speeds[:-1], BMW_320I.min_speed)
        # tan(angle) = wheelbase * curvature, the yaw rate divided by the speed.
        curvatures = np.diff(np.unwrap(orientations)) / (TIME_STEP * speeds)
        angles = np.arctan(BMW_320I.wheelbase * curvatures).tolist()
        last = angles[-1] if angles else 0.0
        return [*angles, last]

    def _scenario(self, recording: Path) -> ElementTree.Element:
        """Return the XML of a recording in which others move as in the episode."""
        root = ElementTree.fromstring(read_xml(recording))
        for obstacle in root.findall("dynamicObstacle"):
            number = int(obstacle.attrib["id"])
            if number not in self._states:
                root.remove(obstacle)
                continue
            for part in list(obstacle):
                if part.tag in ("shape", "initialState", "trajectory"):
                    obstacle.remove(part)

            # The shape has no offset: states are those of the centre.
            length, width = self._sizes[number]
            shape = ElementTree.fromstring(
                f"<shape><rectangle><length>{length!r}</length>"
                f"<width>{width!r}</width></rectangle></shape>"
            )
            first, *later = (_state(row) for row in self._states[number])
            first.tag = "initialState"
            obstacle.extend([shape, first])
            if later:
                ElementTree.SubElement(obstacle, "trajectory").extend(later)
        return root


def _state(row: tuple[float, ...]) -> ElementTree.Element:
    """Return a state in CommonRoad's XML.

    Args:
        row: its time step, x, y, orientation and speed.
    """
    step, x, y, orientation, speed = row
    return ElementTree.fromstring(
        f"<state><position><point><x>{x!r}</x><y>{y!r}</y></point></position>"
        f"<orientation><exact>{orientation!r}</exact></orientation>"
        f"<time><exact>{int(step)}</exact></time>"
        f"<velocity><exact>{speed!r}</exact></velocity></state>"
    )
