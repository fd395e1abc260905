"""Load the policies of a run as a team; ``team.json`` in the run's folder says which policy drives which vehicle."""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.files.model import FileModel, Wording, read_model, refuse
from ethbrake_marl.files.plain import parse_strict_json, read_plain
from ethbrake_marl.files.yaml import Document
from ethbrake_marl.first_edition.agents.learned import LearnedAgent
from ethbrake_marl.first_edition.agents.protocol import Team
from ethbrake_marl.first_edition.policies.bundle import load_policy
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.training.recipe import Scheme
from ethbrake_marl.first_edition.training.run_folder import RunDirectory


def bundle_of(scheme: Scheme, vehicle: str) -> str:
    """Return the folder of the policy of the learner ``vehicle``, relative to the folder of the run."""
    return f"policy/{vehicle}" if scheme == "independent" else "policy"


_RIGHT_TEAM = (
    'the content must be similar to {"scheme": "shared", "vehicles": 3, "drivers": {"vehicle_2": "policy",'
    ' "vehicle_3": "policy"}}'
)


class TeamFile(FileModel):
    """Content of ``team.json`` in the folder of a run: which policy drives which vehicle."""

    format: Literal["ethbrake-team"] = "ethbrake-team"  # name of this kind of file
    format_version: Literal[1] = 1  # version of the format
    scheme: Scheme  # how the learners trained together
    vehicles: Annotated[int, Field(ge=2, le=64)]  # number of vehicles in the line
    drivers: Annotated[dict[str, str], Field(min_length=1)]  # learner's name -> folder of its policy inside the run

    @model_validator(mode="after")
    def _drivers_of_the_line_and_scheme(self) -> TeamFile:
        line = [f"vehicle_{i + 1}" for i in range(self.vehicles)]
        for name, bundle in self.drivers.items():
            if name not in line:
                refuse(("drivers",), name, f"must be one of {line[0]} to {line[-1]}")
            if bundle != bundle_of(self.scheme, name):
                refuse(("drivers", name), bundle, f"must be {bundle_of(self.scheme, name)} under scheme {self.scheme}")
        is_one = len(self.drivers) == 1
        if (self.scheme == "single" and not is_one) or (self.scheme == "independent" and is_one):
            right = "two vehicles or more" if is_one else "one vehicle"
            refuse(("drivers",), self.drivers, f"must be {right} under scheme {self.scheme}")
        return self


def read_team(file: Path) -> TeamFile:
    """Read and check ``team.json`` of a run; raise ``CorruptBundle`` if its content is invalid."""
    data = read_plain(file, 1 << 20)
    try:
        document = Document(str(file), parse_strict_json(data), {})
    except ValueError as error:
        raise CorruptBundle(f"{file}: is not JSON ({error}); {_RIGHT_TEAM}") from None
    try:
        return read_model(document, TeamFile, Wording(TeamFile, _RIGHT_TEAM), f"of keys to values; {_RIGHT_TEAM}")
    except InvalidInput as error:
        raise CorruptBundle(str(error)) from None


def has_policy_each(run: RunDirectory) -> bool:
    """Return whether the learners of a run have different policies; False if the run has no ``team.json``."""
    return os.path.lexists(run.team) and len(set(read_team(run.team).drivers.values())) > 1


def load_team(
    folder: str | os.PathLike[str],
    scenario: str | Path | Scenario,
    name: str = "team",
    vehicles: Collection[int] | None = None,
) -> Team:
    """Load the policies of a run as a team, in which each policy drives the vehicles that it was trained for.

    ``vehicles`` has the indices (0 = front) of the vehicles to drive; None: the scenario's learners. The team does not
    contain the policies of the run's other learners. Raises ``InvalidInput`` if the folder has no ``team.json``, if the
    team is for a line of another length, or if the team has no policy for one of the vehicles. Raises ``CorruptBundle``
    if ``team.json`` is damaged.
    """
    path, scenario = Path(folder), scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    file = RunDirectory(path).team
    if not os.path.lexists(file):
        raise InvalidInput(
            f"{path}: has no file {file.name}, so it is not the folder of a team; give the folder of a training run"
            f" or, if {path} is a policy bundle, write ppo@{path}"
        )
    team = read_team(file)
    if team.vehicles != scenario.vehicles:
        shared = len(set(team.drivers.values())) == 1
        raise InvalidInput(
            f"{path}: this team is for a line of {team.vehicles} vehicles, but scenario {scenario.name!r} has"
            f" {scenario.vehicles} vehicles; "
            + (
                f"its shared policy can drive lines of other lengths: write policy@{path}"
                if shared
                else "choose a scenario of the right length, or a run with a shared policy"
            )
        )
    wanted = {scenario.vehicle_names[i]: i for i in (scenario.learners if vehicles is None else vehicles)}
    missing = [each for each in wanted if each not in team.drivers]
    if missing or not wanted:
        has = f"learner {', '.join(missing)}" if missing else "no learner"
        raise InvalidInput(
            f"{path}: this team can drive {', '.join(team.drivers)}, but scenario {scenario.name!r} has {has}; choose a"
            " scenario with the same learners"
        )
    return Team({i: LearnedAgent(load_policy(path / team.drivers[each]), name) for each, i in wanted.items()}, name)
