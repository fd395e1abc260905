"""A recording of CommonRoad as docs/simulators.md reads it: ``cars.csv`` in the current folder. See field.py.

Run in an environment with commonroad-io.
"""

import re
from pathlib import Path

import numpy as np
from commonroad.common.file_writer import CommonRoadFileWriter, FileFormat, OverwriteExistingFile
from commonroad.geometry.obstacle_shapes.rect_obstacle_shape import RectObstacleShape
from commonroad.planning.planning_problem import PlanningProblemSet
from commonroad.prediction.prediction import TrajectoryPrediction
from commonroad.scenario.lanelet import Lanelet
from commonroad.scenario.obstacle import DynamicObstacle, ObstacleType
from commonroad.scenario.scenario import Scenario, ScenarioID
from commonroad.scenario.state import CustomState, InitialState
from commonroad.scenario.trajectory import Trajectory

PAGE = Path(__file__).resolve().parents[2] / "docs" / "simulators.md"
CARS = ((100.0, 20.0), (80.0, 19.0), (50.0, 22.0))  # middle (m) and speed (m/s) of each; gaps 15.5 and 25.5 m
LENGTH_M, STEP_S, STATES = 4.5, 0.1, 20


def main() -> None:
    """Write ``recording.xml``, with three cars of constant speed in one lane, and run the block of the page."""
    scenario = Scenario(dt=STEP_S, scenario_id=ScenarioID.from_benchmark_id("ZAM_Test-1_1_T-1", "2020a"))
    middle = np.column_stack([np.linspace(0.0, 1000.0, 101), np.zeros(101)])
    side = np.array([0.0, 1.75])
    left, right = middle + side, middle - side
    scenario.add_objects(Lanelet(left_vertices=left, center_vertices=middle, right_vertices=right, lanelet_id=1))
    for number, (place, speed) in enumerate(CARS):
        shape, turn = RectObstacleShape(width=1.8, length=LENGTH_M), {"orientation": 0.0, "velocity": speed}
        at = [np.array([place + speed * STEP_S * k, 0.0]) for k in range(STATES)]
        still = {"acceleration": 0.0, "yaw_rate": 0.0, "slip_angle": 0.0}
        first = InitialState(time_step=0, position=at[0], **turn, **still)
        later = [CustomState(time_step=k, position=at[k], **turn) for k in range(1, STATES)]
        course = TrajectoryPrediction(Trajectory(1, later), shape)
        scenario.add_objects(DynamicObstacle(10 + number, ObstacleType.CAR, shape, first, course))
    about = {"author": "", "affiliation": "", "source": "", "tags": set()}
    writer = CommonRoadFileWriter(scenario, PlanningProblemSet(), **about, file_format=FileFormat.XML)
    writer.write_to_file("recording.xml", OverwriteExistingFile.ALWAYS)
    block = re.search(r"needs commonroad-io -->\n```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    assert block is not None
    exec(compile(block[1], str(PAGE), "exec"), {})
