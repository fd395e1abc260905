"""Warnings about policies that drive in worlds unlike those of their training."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from ethbrake_marl.agents.drive import Team
from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, Unfamiliar
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.describe import quantities_of
from ethbrake_marl.worlds.scenario import Scenario

MOST_BEYOND = 0.05  # largest share of worlds outside the range of the training that causes no warning
TRAINED = 2_000  # worlds of the training from which this range is taken


def warn_unfamiliar(teams: Mapping[str, Team], worlds: State) -> None:
    """Warn (``Unfamiliar``) of each policy of ours that was not trained in worlds like these, which are at the alert.

    There is no warning where this installation cannot draw the worlds of the training.
    """
    seen: set[tuple[str, int]] = set()
    for name, team in teams.items():
        for body, agent in team.drivers.items():
            manifest = agent.policy.manifest if isinstance(agent, LearnedAgent) else None
            if manifest is None or (manifest.manifest_sha256, body) in seen:
                continue
            seen.add((manifest.manifest_sha256, body))
            unlike = [] if f"vehicle_{body}" in manifest.learners else [f"vehicle_{body} is new to it"]
            ranges = ranges_of(json.dumps(manifest.scenario))
            unlike += [] if ranges is None else beyond(ranges, quantities_of(worlds))
            if unlike:
                scenario = manifest.scenario.get("name")
                warnings.warn(f"{name}: was trained in {scenario}: {', '.join(unlike)}", Unfamiliar, stacklevel=3)


@lru_cache(maxsize=64)
def ranges_of(scenario: str) -> dict[str, tuple[float, float]] | None:
    """Return the range of each quantity in worlds of a scenario, given as JSON; None if they cannot be drawn."""
    try:
        columns = quantities_of(Scenario(**declared(json.loads(scenario))).sample(TRAINED, 0))
    except InvalidInput:
        return None
    return {name: (np.nanmin(column), np.nanmax(column)) for name, column in columns.items()}


def declared(content: Any) -> Any:
    """Return what a manifest declares of its scenario, without values that nobody has declared."""
    if isinstance(content, list):
        return [declared(each) for each in content]
    if not isinstance(content, Mapping):
        return content
    kept = {key: declared(each) for key, each in content.items() if each is not None}
    if kept.get("speed_deviations_mps") == 0.0:
        del kept["speed_deviations_mps"]
    return kept


def beyond(ranges: Mapping[str, tuple[float, float]], columns: Mapping[str, Floats]) -> list[str]:
    """Return how worlds differ from those of a training, such as ``latency_2_s is new in 40 % of these worlds``."""
    vehicles, then = (sum(name.startswith("mass_") for name in names) for names in (columns, ranges))
    if vehicles != then:
        return [f"{vehicles} vehicles are new to it"]
    unlike = []
    for name in {**ranges, **columns}:
        if name.startswith("harm_weight"):  # motion does not depend on it
            continue
        if name not in columns or name not in ranges:
            unlike.append(f"{name} is {'new' if name in columns else 'missing'}")
            continue
        (low, high), values = ranges[name], columns[name]
        margin = 0.01 * (high - low) + 1e-9 * abs(high)
        share = float(((values < low - margin) | (values > high + margin)).mean())
        if share > MOST_BEYOND:
            unlike.append(f"{name} is new in {100.0 * share:.0f} % of these worlds")
    return unlike
