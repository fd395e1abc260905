"""Small files of recorded traffic for tests, and what a scenario was made of them."""

from pathlib import Path

from ethbrake_marl.extensions.recorded.scenario import FromData
from tests.fixtures.recordings import write_files


def rows_of(made: FromData) -> list[str]:
    return [line.rpartition(",")[0] for line in made.csv.splitlines()[1:]]


def scenario_of(vehicles: int, folder: Path) -> str:
    every = "braking_capacity_mps2: 6, driving_capacity_mps2: 3, mass_t: 2, latency_s: 0, roles: {vehicle_2: learner}"
    text = f"{{name: base, vehicles: {vehicles}, gaps_m: 9, speeds_mps: 9, {every}}}"
    return str(write_files(folder, {"base.yaml": [text]}) / "base.yaml")


def openacc(folder: Path, columns: str, *rows: str, heading: list[str] | None = None, name: str = "a.csv") -> Path:
    """A folder with one file of OpenACC; its rows are a second apart, and stand behind the time."""
    lines = [*(heading or []), f"Time,{columns}", *(f"{k},{row}" for k, row in enumerate(rows))]
    return write_files(folder, {name: lines})
