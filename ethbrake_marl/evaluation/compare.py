"""Two results compared: the same worlds of the same scenario, or no comparison."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.evaluation.results_file import HARMS, SAME, Result, told_of
from ethbrake_marl.evaluation.statistics import Estimate, estimates_to_json, paired_difference, unpaired_difference
from ethbrake_marl.physics import Floats


@dataclass(frozen=True, slots=True)
class Difference:
    """What one agent does more in the second result than in the first, mean per world (m2/s2)."""

    agent: str
    policy: Literal["same", "other", "none"]  # whether both drove by the same one
    harms: Mapping[str, Estimate]  # by the name of the harm

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON."""
        harms = {f"{name}_difference": estimate for name, estimate in self.harms.items()}
        return {"agent": self.agent, "policy": self.policy, **estimates_to_json(harms)}


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two results on the same worlds, the second minus the first, agent by agent."""

    differences: tuple[Difference, ...]
    unpaired_because: str | None  # None: intervals are paired by world
    left_over: tuple[tuple[str, ...], tuple[str, ...]]  # agents of the first alone, and of the second
    other_settings: Mapping[
        str, tuple[str | None, str | None]
    ]  # of the agents of the first and of the second, likewise
    other_versions: Mapping[str, tuple[str | None, str | None]]  # of the first and of the second, where they differ

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "intervals": "paired" if self.unpaired_because is None else "unpaired",
            "unpaired_because": self.unpaired_because,
            "agents": [difference.to_json() for difference in self.differences],
            "only_in_first": list(self.left_over[0]),
            "only_in_second": list(self.left_over[1]),
            "other_settings": {name: list(both) for name, both in self.other_settings.items()},
            "other_versions": {name: list(both) for name, both in self.other_versions.items()},
        }


def compare_results(first: Result, second: Result) -> Comparison:
    """What agents of the same name did in both, the second minus the first.

    Paired by world where both have every world beside them. Raises ``InvalidInput`` for results of different kinds, on
    different worlds or scenarios, or without a common agent.
    """
    for key, what in SAME.items():
        one, other = (told_of(result.about, key) for result in (first, second))
        if one != other:
            raise InvalidInput(
                f"{second.path}: is about {what} than {first.path} ({key} {other!s:.12} and {one!s:.12}): no comparison"
            )
    common = [agent for agent in first.rows if agent in second.rows]
    left_over = [tuple(agent for agent in one.rows if agent not in common) for one in (first, second)]
    if not common:
        agents = " and ".join(f"{', '.join(names)}" for names in left_over)
        raise InvalidInput(f"{first.path} and {second.path} have no agent in common: {agents}")
    worlds, because = _worlds_of_both(first, second, common)
    differences = tuple(
        Difference(agent, _policies(first, second, agent), _differences(first, second, agent, worlds))
        for agent in common
    )
    return Comparison(differences, because, (left_over[0], left_over[1]), *_others(first, second))


Worlds = dict[str, tuple[Floats, Floats]]  # agent -> harms [n, 2] of the first and of the second, world by world


def _worlds_of_both(first: Result, second: Result, common: Sequence[str]) -> tuple[Worlds | None, str | None]:
    """The harms to pair, or why there are none."""
    try:
        one, other = first.harms(), second.harms()
    except InvalidInput as error:
        return None, f"one row per world is needed of both; {error}"
    found = {}
    for agent in common:
        worlds = sorted(one.get(agent, {}))
        if len(worlds) != first.rows[agent]["episodes"] or worlds != sorted(other.get(agent, {})):
            return None, f"the rows per world of {agent} are not those of {count_of(len(worlds), 'same world')}"
        found[agent] = tuple(np.array([side[agent][world] for world in worlds]) for side in (one, other))
        for result, harms in zip((first, second), found[agent], strict=True):
            _check_means(result, agent, harms)
    return found, None  # type: ignore[return-value]  # two of them each


def _check_means(result: Result, agent: str, harms: Floats) -> None:
    """Refuse means that are not those of the file with every world [n, 2]."""
    for name, mean in zip(HARMS, harms.mean(axis=0), strict=True):
        told = result.rows[agent].get(name)
        if told is not None and not math.isclose(told, mean, rel_tol=1e-9, abs_tol=1e-9):
            raise InvalidInput(f"{result.path}: {agent}: {name} = {told:g}, but the mean of its worlds is {mean:g}")


def _differences(first: Result, second: Result, agent: str, worlds: Worlds | None) -> dict[str, Estimate]:
    """The second minus the first, by the name of the harm."""
    if worlds is not None:
        before, after = worlds[agent]
        return {name: paired_difference(after[:, k], before[:, k]) for k, name in enumerate(HARMS)}
    sizes = second.rows[agent]["episodes"], first.rows[agent]["episodes"]
    return {
        harm: unpaired_difference(second.estimate(agent, harm), sizes[0], first.estimate(agent, harm), sizes[1])
        for harm in first.harm_names
    }


def _policies(first: Result, second: Result, agent: str) -> Literal["same", "other", "none"]:
    one, other = (result.rows[agent]["policy_sha256"] for result in (first, second))
    if not one and not other:
        return "none"
    return "same" if one == other else "other"


def _others(first: Result, second: Result) -> list[dict[str, tuple[str | None, str | None]]]:
    """Settings of the agents, and versions, that are not the same in both."""
    found = []
    for key in ("agent_settings", "versions"):
        one, other = (each if isinstance(each := result.about.get(key), dict) else {} for result in (first, second))
        names = dict.fromkeys([*one, *other])
        found.append({name: (one.get(name), other.get(name)) for name in names if one.get(name) != other.get(name)})
    return found
