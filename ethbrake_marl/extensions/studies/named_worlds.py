"""YAML files of named worlds.

A search for an agent's worst worlds writes a file of named worlds, and agents can drive the worlds of the file again.

A file stores the worlds, the scenario with a hash of its content, the agent that drove the worlds, and the harm and
score of each world.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import FileModel, Wording, read_model
from ethbrake_marl.files.yaml import flow_text, read_yaml
from ethbrake_marl.first_edition.evaluation.identity import scenario_sha256
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.physics.state import Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.tables import worlds_from_table

MOST_NAMED_WORLDS = 1000  # largest number of worlds in a file

SIZE_LIMIT = 8 << 20  # largest size of a file in bytes, enough for 1000 worlds with many vehicles

Number = Annotated[float, Field(allow_inf_nan=False)]


class NamedWorld(FileModel):
    """One world of a file of named worlds: its name, its initial state, and the harm and score measured in it."""

    # Name of the world, unique in the file.
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$")]
    score: Number  # value of the measure that the search maximised, the larger the worse for the agent (m2/s2)
    harm: Number  # harm of the agent (m2/s2)
    reference: Number | None = None  # harm of the agent to compare with, or bound of the shield (m2/s2)
    # Initial state: column of a table of worlds (``gap_1_m``, ``speed_1_mps``) -> value.
    state: Annotated[dict[str, Number], Field(min_length=1, max_length=1000)]


class NamedWorlds(FileModel):
    """Content of a YAML file with the worst worlds of an agent that a search has found."""

    format: Literal["ethbrake-worlds"]  # mark of this kind of file
    # Version of the format; not a Literal, which would accept true and 1.0.
    version: Annotated[int, Field(ge=1, le=1)]
    scenario: str  # name or path of the scenario of the worlds
    # Hash of the scenario's content, which must be the same when the worlds are driven again.
    scenario_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    settings: list[str] = Field(default=[])  # settings of the scenario, as for ``--set``
    agent: str  # spec of the agent that drove
    measure: Literal["harm", "regret", "difference", "bound"]  # measure that the search maximised, see weakness.Measure
    against: str | None = None  # spec of the agent to compare with; None: the default, or no comparison
    harm_count: HarmCount  # harm count: the first impact of each pair (``first``) or all impacts (``total``)
    found_by: str  # command of the search
    # The worlds, worst first.
    worlds: Annotated[list[NamedWorld], Field(min_length=1, max_length=MOST_NAMED_WORLDS)]

    @classmethod
    def of(cls, scenario: Scenario, /, **fields: Any) -> NamedWorlds:
        """Return the content of a file of worlds that were drawn from ``scenario``.

        ``fields`` are all fields of this class except ``format``, ``version`` and ``scenario_sha256``.
        """
        return cls(format="ethbrake-worlds", version=1, scenario_sha256=scenario_sha256(scenario), **fields)

    @classmethod
    def read(cls, path: str | Path) -> NamedWorlds:
        """Read and check a file of named worlds.

        Raises ``InvalidInput``, which names the file, the line and the key, if the content is invalid.
        """
        document = read_yaml(path, SIZE_LIMIT)
        worlds = read_model(document, cls, Wording(cls, "search again (ethbrake study falsify)"), "of named worlds")
        names = [world.name for world in worlds.worlds]
        if twice := next((name for k, name in enumerate(names) if name in names[:k]), None):
            raise InvalidInput(f"{path}: two worlds have the name {twice!r}; give each world a different name")
        return worlds

    @property
    def text(self) -> str:
        """YAML text of the file. Reading this text gives the same worlds, bit for bit."""
        head = self.model_dump(exclude={"worlds"}, exclude_none=True)
        lines = [f"{key}: {flow_text(value)}" for key, value in head.items() if value != []]
        lines.append("worlds:")
        for world in self.worlds:
            entries = [f"{key}: {flow_text(value)}" for key, value in world.model_dump(exclude_none=True).items()]
            lines += [f"  - {entries[0]}", *(f"    {entry}" for entry in entries[1:])]
        return "\n".join(lines) + "\n"

    def worlds_of(self, scenario: Scenario, where: str) -> Worlds:
        """Return the worlds of the file at the alert.

        Raises ``InvalidInput`` if the content of ``scenario`` has changed since the search. ``where`` is the path of
        the file, for messages.
        """
        if scenario_sha256(scenario) != self.scenario_sha256:
            raise InvalidInput(
                f"{where}: scenario {self.scenario!r}{''.join(f' with --set {each}' for each in self.settings)} has"
                " changed since these worlds were found; restore the scenario, or search again (ethbrake study falsify)"
            )
        columns = self.worlds[0].state.keys()
        for k, world in enumerate(self.worlds):
            if world.state.keys() != columns:
                raise InvalidInput(
                    f"{where}: worlds[{k}].state and worlds[0].state have different keys; give all worlds the same keys"
                )
        return worlds_from_table(scenario, {name: [world.state[name] for world in self.worlds] for name in columns})
