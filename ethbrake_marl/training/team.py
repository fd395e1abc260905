"""``team.json`` in a run's folder: which policy drives which vehicle. Reading it needs no torch."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.files.store import parse_strict_json, read_plain
from ethbrake_marl.files.yaml import Document, FileModel, Wording, read_model, refuse
from ethbrake_marl.training.recipe import Scheme


def bundle_of(scheme: Scheme, vehicle: str) -> str:
    """Where in the run's folder the bundle stands that drives a learner."""
    return f"policy/{vehicle}" if scheme == "independent" else "policy"


# ``team.json`` in a run's folder: which bundle drives which vehicle. Reading a team needs no torch.

_RIGHT_TEAM = (
    'right is, for instance, {"scheme": "shared", "vehicles": 3, "drivers": {"vehicle_2": "policy", "vehicle_3":'
    ' "policy"}}'
)


class TeamFile(FileModel):
    format: Literal["ethbrake-team"] = "ethbrake-team"
    format_version: Literal[1] = 1
    scheme: Scheme
    vehicles: Annotated[int, Field(ge=2, le=64)]
    drivers: Annotated[dict[str, str], Field(min_length=1)]

    @model_validator(mode="after")
    def _drivers_of_the_line_and_scheme(self) -> TeamFile:
        line = [f"vehicle_{i + 1}" for i in range(self.vehicles)]
        for name, bundle in self.drivers.items():
            if name not in line:
                refuse(("drivers",), name, f"must be one of {line[0]} to {line[-1]}")
            if bundle != bundle_of(self.scheme, name):
                refuse(("drivers", name), bundle, f"must be {bundle_of(self.scheme, name)} under scheme {self.scheme}")
        alone = len(self.drivers) == 1
        if (self.scheme == "single" and not alone) or (self.scheme == "independent" and alone):
            right = "two vehicles or more" if alone else "one vehicle"
            refuse(("drivers",), self.drivers, f"must be {right} under scheme {self.scheme}")
        return self


def read_team(file: Path) -> TeamFile:
    data = read_plain(file, 1 << 20)
    try:
        document = Document(str(file), parse_strict_json(data), {})
    except ValueError as error:
        raise CorruptBundle(f"{file}: is not JSON ({error}); {_RIGHT_TEAM}") from None
    try:
        return read_model(document, TeamFile, Wording(TeamFile, _RIGHT_TEAM), f"of keys to values; {_RIGHT_TEAM}")
    except InvalidInput as error:
        raise CorruptBundle(str(error)) from None
