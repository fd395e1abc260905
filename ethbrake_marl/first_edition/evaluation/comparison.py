"""Comparison of two results files on the same worlds of the same scenario."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.first_edition.evaluation.exploits import MARK, Exploits
from ethbrake_marl.first_edition.evaluation.per_world import COMPARED, HARMS, SAME, Result, recorded_value
from ethbrake_marl.first_edition.evaluation.statistics import Texts, paired_difference, unpaired_difference
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.scenario.fields import RECORDING
from ethbrake_marl.first_edition.scenario.sample import clusters_of


@dataclass(frozen=True, slots=True)
class Difference:
    """Difference of one agent's mean harm per world between two results: second result minus first (m2/s2)."""

    agent: str  # name of the agent, the same in both results
    # Whether the agent has the same trained policy in both results, another one, or none in either.
    policy: Literal["same", "other", "none"]
    harms: Mapping[str, Estimate]  # count of harm (``first_impact_harm``, ``total_harm``) -> difference with interval
    exploits: tuple[Exploits, Exploits]  # the agent's exploits in the first and in the second result

    @property
    def marked(self) -> str:
        """Name of the agent, followed by ‡ if it has exploits in either result."""
        return f"{self.agent} {MARK}" if any(each.names for each in self.exploits) else self.agent

    def to_json(self) -> dict[str, Any]:
        """Return the object for JSON: agent, policy, exploits, and the differences of harm with their intervals."""
        harms = {f"{name}_difference": estimate for name, estimate in self.harms.items()}
        exploits = [list(each.names) for each in self.exploits]
        return {"agent": self.agent, "policy": self.policy, **Estimate.side_by_side(harms), "exploits": exploits}


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of two results files on the same worlds, agent by agent."""

    differences: tuple[Difference, ...]  # second result minus first, one entry per agent that is in both results
    unpaired_because: str | None  # why worlds of the two results cannot be paired; None: the intervals are paired
    recordings: int  # number of recordings, as clusters of worlds; 0: all worlds are independent
    left_over: tuple[tuple[str, ...], tuple[str, ...]]  # agents of the first result only, agents of the second only
    # Name of a setting that differs -> value in the first and in the second result; None: the setting is missing.
    other_settings: Mapping[str, tuple[str | None, str | None]]
    # Name of a package whose version differs -> version in the first and in the second result; None: not used.
    other_versions: Mapping[str, tuple[str | None, str | None]]

    @property
    def exploits_line(self) -> str:
        """Sentence that says which agents have exploits in which of the two results; "" if no agent has exploits."""
        of_agents: dict[str, Exploits] = {}
        for each in self.differences:
            first, second = each.exploits
            same = {each.agent: first}
            apart = {f"{each.agent} in the first": first, f"{each.agent} in the second": second}
            of_agents |= same if first == second else apart
        return Exploits.sentence(of_agents)

    def to_json(self) -> dict[str, Any]:
        """Return the comparison as plain data for JSON, with one object per agent under ``agents``."""
        return {
            "intervals": "paired" if self.unpaired_because is None else "unpaired",
            "unpaired_because": self.unpaired_because,
            **({"recordings": self.recordings} if self.recordings else {}),
            "agents": [difference.to_json() for difference in self.differences],
            "only_in_first": list(self.left_over[0]),
            "only_in_second": list(self.left_over[1]),
            "other_settings": {name: list(both) for name, both in self.other_settings.items()},
            "other_versions": {name: list(both) for name, both in self.other_versions.items()},
        }


def compare_results(first: Result, second: Result) -> Comparison:
    """Compare the mean harms of agents that have the same name in two results: second result minus first.

    If both results have a file with one row per world, the intervals are paired by world. Raises ``InvalidInput`` if
    the results differ in kind, worlds or scenario, or have no agent in common.
    """
    for key, what in SAME.items():
        value, value_second = (recorded_value(result.about, key) for result in (first, second))
        if value != value_second:
            raise InvalidInput(
                f"{second.path} and {first.path} cannot be compared: {what} ({key} is {value_second!s:.12} and"
                f" {value!s:.12})"
            )
    common = [agent for agent in first.rows if agent in second.rows]
    left_over = [tuple(agent for agent in one.rows if agent not in common) for one in (first, second)]
    if not common:
        agents = [", ".join(names) for names in left_over]
        raise InvalidInput(f"{first.path} ({agents[0]}) and {second.path} ({agents[1]}) have no agent in common")
    worlds, because = _worlds_of_both(first, second, common)
    recordings = int(recorded_value(first.about, "recordings") or 0)
    differences = []
    for agent in common:
        one, other = first.rows[agent], second.rows[agent]
        if worlds is None:
            sizes = [recordings or row["episodes"] for row in (other, one)]
            harms = {
                harm: unpaired_difference(second.estimate(agent, harm), sizes[0], first.estimate(agent, harm), sizes[1])
                for harm in COMPARED[first.about["kind"]]
            }
        else:
            before, after, by = worlds[agent]
            harms = {name: paired_difference(after[:, k], before[:, k], by) for k, name in enumerate(HARMS)}
        policies = one["policy_sha256"], other["policy_sha256"]
        same: Literal["same", "other"] = "same" if policies[0] == policies[1] else "other"
        exploits = Exploits.of_json(one), Exploits.of_json(other)
        differences.append(Difference(agent, same if any(policies) else "none", harms, exploits))
    changed = []
    for key in ("agent_settings", "versions"):
        one, other = (each if isinstance(each := of.about.get(key), dict) else {} for of in (first, second))
        names = [name for name in dict.fromkeys([*one, *other]) if one.get(name) != other.get(name)]
        changed.append({name: (one.get(name), other.get(name)) for name in names})
    return Comparison(tuple(differences), because, recordings, (left_over[0], left_over[1]), *changed)


# Agent -> harms [n, 2] of every world in the first and second result, and the worlds' clusters or None.
Worlds = dict[str, tuple[Floats, Floats, Texts | None]]


def _worlds_of_both(first: Result, second: Result, common: Sequence[str]) -> tuple[Worlds | None, str | None]:
    """Return (harms in each world of both results, None), or (None, reason why the worlds cannot be paired).

    ``common``: names of the agents that both results contain.
    """
    try:
        (one, named), (other, _) = first.harms(), second.harms()
    except InvalidInput as error:
        return None, f"both results need a file with one row per world; {error}"
    harms: Worlds = {}
    for agent in common:
        worlds = sorted(one.get(agent, {}))
        if len(worlds) != first.rows[agent]["episodes"] or worlds != sorted(other.get(agent, {})):
            return None, f"the two results do not list the same worlds for {agent}"
        harms_of_both = [np.array([side[agent][world] for world in worlds]) for side in (one, other)]
        kinds = {RECORDING: np.array([named[world] for world in worlds])} if named else {}
        harms[agent] = harms_of_both[0], harms_of_both[1], clusters_of(kinds, np.array(worlds))
        for result, columns in zip((first, second), harms_of_both, strict=True):
            for name, mean in zip(HARMS, columns.mean(axis=0), strict=True):
                stated = result.rows[agent].get(name)
                if stated is not None and not math.isclose(stated, mean, rel_tol=1e-9, abs_tol=1e-9):
                    raise InvalidInput(
                        f"{result.path}: {agent}: {name} = {stated:g}, but its mean over the file with one row per"
                        f" world is {mean:g}; one of the two files was changed, so evaluate again"
                    )
    return harms, None
