"""Files of named worlds: what a search has found, to be driven again for ever.

A file says which scenario its worlds are of, by its content, what drove there, and what that was measured to be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ethbrake_marl.defaults import MOST_NAMED_WORLDS
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.identity import scenario_sha256
from ethbrake_marl.files.yaml import flow_text, read_yaml
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.physics import Floats, Worlds
from ethbrake_marl.scenario import Scenario, worlds_from_table
from ethbrake_marl.scenario.quantities import QUANTITIES
from ethbrake_marl.scenario.sample import quantity_columns

FORMAT: Literal["ethbrake-worlds"] = "ethbrake-worlds"
VERSION = 1
SIZE_LIMIT = 8 << 20  # bytes of it: so many worlds of a long line

Number = Annotated[float, Field(allow_inf_nan=False)]


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


class NamedWorld(_Strict):
    """One world: its name, its initial state by the columns of a table, and what was measured there (m2/s2)."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$")]
    score: Number
    harm: Number
    reference: Number | None = None
    state: Annotated[dict[str, Number], Field(min_length=1, max_length=1000)]


class NamedWorlds(_Strict):
    """A file of named worlds."""

    format: Literal["ethbrake-worlds"]
    version: Annotated[int, Field(ge=VERSION, le=VERSION)]  # a literal would take true and 1.0, which equal 1
    scenario: str
    scenario_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    settings: list[str] = []  # what was set beside the scenario's name, as ``--set`` takes it
    agent: str
    measure: Literal["harm", "regret", "difference", "bound"]
    against: str | None = None
    harm_count: HarmCount
    found_by: str  # the command
    worlds: Annotated[list[NamedWorld], Field(min_length=1, max_length=MOST_NAMED_WORLDS)]

    def worlds_of(self, scenario: Scenario, where: str) -> Worlds:
        """The worlds at the alert; raises ``InvalidInput`` for another scenario than theirs."""
        if scenario_sha256(scenario) != self.scenario_sha256:
            raise InvalidInput(
                f"{where}: its worlds were found in scenario {self.scenario!r}"
                f"{''.join(f' with --set {each}' for each in self.settings)}, which {scenario.name!r} is not, or is no"
                " longer: their contents differ; use that scenario, or search again (ethbrake falsify)"
            )
        columns = self.worlds[0].state.keys()
        for k, world in enumerate(self.worlds):
            if world.state.keys() != columns:
                raise InvalidInput(f"{where}: worlds[{k}].state has other columns than worlds[0]; all need the same")
        return worlds_from_table({name: [world.state[name] for world in self.worlds] for name in columns}, scenario)


def read_named_worlds(path: str | Path) -> NamedWorlds:
    """Read a file of named worlds; raises ``InvalidInput`` naming file, line and key."""
    document = read_yaml(path, SIZE_LIMIT)
    try:
        found = NamedWorlds.model_validate(document.content)
    except ValidationError as error:
        first = error.errors()[0]
        place = tuple(first["loc"])
        line = document.line_of(place) or document.line_of(place[:-1])
        key = ".".join(map(str, place)) or "the file"
        raise InvalidInput(f"{path}{f', line {line}' if line else ''}: {key}: {first['msg']}") from None
    names = [world.name for world in found.worlds]
    if twice := next((name for k, name in enumerate(names) if name in names[:k]), None):
        raise InvalidInput(f"{path}: world {twice!r} is given twice; names must differ")
    return found


def states_of(worlds: Worlds, scenario: Scenario) -> list[dict[str, float]]:
    """The initial state of each world: the columns that the scenario does not fix, and gaps and speeds."""
    columns = {name: values for name, values in quantity_columns(worlds).items() if _needed(name, values, scenario)}
    return [{name: float(values[k]) for name, values in columns.items()} for k in range(worlds.n)]


def _needed(column: str, values: Floats, scenario: Scenario) -> bool:
    if column.startswith(("gap_", "speed_")) and not column.startswith("speed_limit"):
        return True
    return column not in _fixed_columns(scenario)


def _fixed_columns(scenario: Scenario) -> set[str]:
    """Columns whose value the scenario fixes for every world."""
    return {
        rule.column_of(i)
        for key, rule in QUANTITIES.items()
        for i, (low, high) in enumerate(scenario.bounds(key))
        if low == high
    }


def named_worlds_text(found: NamedWorlds) -> str:
    """The file's text; reading it back gives the same worlds to the bit."""
    head = found.model_dump(exclude={"worlds"}, exclude_none=True)
    lines = [f"{key}: {flow_text(value)}" for key, value in head.items() if value != []]
    lines.append("worlds:")
    for world in found.worlds:
        kept: Mapping[str, object] = world.model_dump(exclude_none=True)
        entries: Sequence[str] = [f"{key}: {flow_text(value)}" for key, value in kept.items()]
        lines += [f"  - {entries[0]}", *(f"    {entry}" for entry in entries[1:])]
    return "\n".join(lines) + "\n"
