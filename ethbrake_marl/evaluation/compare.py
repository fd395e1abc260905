"""Compare two results on the same worlds: the difference in harm for each team, paired by world."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.captions import by_recording
from ethbrake_marl.evaluation.evaluate import Columns, Result
from ethbrake_marl.evaluation.results import HARMS, Saved
from ethbrake_marl.evaluation.statistics import difference, unpaired
from ethbrake_marl.evaluation.summary import summarise
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from ethbrake_marl.worlds.describe import clusters_of

SAME = {  # what two results must have in common -> what differs otherwise
    "worlds_sha256": "their worlds differ",
    "controlled_vehicles": "their controlled vehicles differ",
    "scenario_sha256": "their scenarios differ",
    "time_step_s": "their time steps differ",
    "horizon_s": "their horizons differ",
}


@dataclass(frozen=True)
class Comparison:
    """Mean harm of the second result minus that of the first, for every team in both."""

    differences: Mapping[str, Mapping[str, Estimate]]  # team -> count of harm -> difference of the means (m2/s2)
    unpaired_because: str  # why worlds cannot be paired; "": intervals are paired
    recordings: int  # number of recordings; 0: all worlds are independent
    left_over: tuple[tuple[str, ...], tuple[str, ...]]  # teams of the first result only, and of the second
    changed: Mapping[str, tuple[Any, Any]]  # setting, package, policy or digest -> its values, where they differ

    def sheet(self) -> Sheet:
        rows = [(agent, *harms.values()) for agent, harms in self.differences.items()]
        heads = [Column("First-impact harm", HARMS[0]), Column("Total harm", HARMS[1])]
        return Sheet("", ["Agent", *heads], rows, "\n".join(self.notes()))

    def notes(self) -> Iterator[str]:
        how = "paired by world"
        if self.unpaired_because:
            how = f"NOT paired by world, so wider than paired intervals: {self.unpaired_because}"
        by = by_recording(self.recordings)
        yield f"Second minus first, mean per world in m²/s²; in brackets: 95 % intervals, {how}{by}."
        for which, agents in zip(("first", "second"), self.left_over, strict=True):
            if agents:
                yield f"Only in the {which} result: {', '.join(agents)}."
        for name, (one, other) in self.changed.items():
            yield f"Note: {name}: {_shown(one)} in the first result, {_shown(other)} in the second."

    def to_json(self) -> dict[str, Any]:
        return {
            "intervals": "unpaired" if self.unpaired_because else "paired",
            "unpaired_because": self.unpaired_because or None,
            "recordings": self.recordings,
            "agents": [
                {"agent": agent} | Estimate.side_by_side({f"{name}_difference": each for name, each in harms.items()})
                for agent, harms in self.differences.items()
            ],
            "only_in_first": list(self.left_over[0]),
            "only_in_second": list(self.left_over[1]),
            "changed": {name: list(both) for name, both in self.changed.items()},
        }


def compare_results(first: Saved | Result, second: Saved | Result) -> Comparison:
    """Return the difference in harm, team by team: paired by world if both results have rows per world.

    Raises ``InvalidInput`` for results of different worlds or scenarios, and without a common team.
    """
    one, other = (each if isinstance(each, Saved) else _in_memory(each) for each in (first, second))
    for key, what in SAME.items():
        values = [_recorded(each, key) for each in (other, one)]
        if values[0] != values[1]:
            raise InvalidInput(
                f"{other.path} and {one.path} cannot be compared: {what} ({key} is {_shown(values[0])} and"
                f" {_shown(values[1])})"
            )
    common = [agent for agent in one.agents if agent in other.agents]
    mine, theirs = (tuple(agent for agent in each.agents if agent not in common) for each in (one, other))
    if not common:
        names = f"{one.path} ({', '.join(mine)}) and {other.path} ({', '.join(theirs)})"
        raise InvalidInput(f"{names} have no agent in common")
    because = one.no_rows_because or other.no_rows_because
    if because:
        because = f"both results need a file with one row per world; {because}"
    before, after = _noted(one, common), _noted(other, common)
    changed = {
        name: (before.get(name), after.get(name))
        for name in dict.fromkeys([*before, *after])
        if before.get(name) != after.get(name)
    }
    differences = {agent: _difference(one, other, agent) for agent in common}
    return Comparison(differences, because, int(_recorded(one, "recordings") or 0), (mine, theirs), changed)


def _difference(one: Saved, other: Saved, agent: str) -> dict[str, Estimate]:
    if one.rows is not None and other.rows is not None:
        before, after = _of(one.rows, agent), _of(other.rows, agent)
        if not np.array_equal(before["world"], after["world"]):  # parts of results
            raise InvalidInput(f"{other.path} and {one.path} cannot be compared: they do not list the same worlds")
        return {name: difference(after[name], before[name], clusters_of(before)) for name in HARMS}
    return {name: unpaired(other.estimate(agent, name), one.estimate(agent, name)) for name in HARMS}


def _of(rows: Columns, agent: str) -> Columns:
    mine = rows["agent"] == agent
    return {name: column[mine] for name, column in rows.items()}


def _in_memory(result: Result) -> Saved:
    agents = {each["agent"]: each for each in summarise(result).to_json()}
    return Saved(Path("result"), agents, result.arrays(), "")


def _recorded(saved: Saved, key: str) -> Any:
    return saved.about.get(key, saved.about["parameters"].get(key))


def _shown(value: Any) -> str:
    return "missing" if value is None else f"{value!s:.20}"


def _noted(saved: Saved, agents: list[str]) -> dict[str, Any]:
    parts = [_recorded(saved, key) or {} for key in ("agent_settings", "versions")]
    for agent in agents:
        policies = saved.agents[agent]["policy_sha256"]
        parts.append({f"policy of {vehicle} in {agent}": sha256 for vehicle, sha256 in policies.items()})
    return {"physics_digest": saved.about["physics_digest"], **{k: v for part in parts for k, v in part.items()}}
