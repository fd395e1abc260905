"""Warnings about trained policies that drive in worlds unlike their training worlds."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from ethbrake_marl.errors import Unfamiliar
from ethbrake_marl.first_edition.agents.protocol import Driver, Team
from ethbrake_marl.first_edition.physics.messages import PIECES, USUAL_PIECES
from ethbrake_marl.first_edition.physics.state import Worlds
from ethbrake_marl.first_edition.policies.manifest import Manifest
from ethbrake_marl.first_edition.scenario.fields import QUANTITY
from ethbrake_marl.first_edition.scenario.schema import Scenario

_MOST_BEYOND = 0.05  # largest fraction of worlds outside the training range that causes no warning

_TRAINED = 2_000  # number of worlds drawn from the training scenario to find the range of each quantity


def warn_unfamiliar(agents: Mapping[str, Driver], worlds: Worlds, scenario: Scenario, vehicles: Sequence[int]) -> None:
    """Warn (``Unfamiliar``) about each trained policy that is to drive in worlds unlike its training worlds.

    A policy's manifest contains its training scenario; ``worlds`` (at the alert) are compared with worlds drawn from
    this scenario. If no worlds of the training scenario can be drawn on this machine, there is no warning. The
    comparison considers only two features of the V2X channel: the latencies and the contents of messages. ``vehicles``
    are the indices (0 = front) of the vehicles that each agent drives.
    """
    drives: dict[str, tuple[str, Manifest, dict[str, None]]] = {}  # by hash: the first agent, vehicles in order
    for name, agent in agents.items():
        for vehicle, driver in Team.of(agent, vehicles).drivers.items():
            if isinstance(manifest := getattr(driver, "manifest", None), Manifest):
                drives.setdefault(manifest.manifest_sha256, (name, manifest, {}))[2][f"vehicle_{vehicle + 1}"] = None
    for name, manifest, vehicles_driven in drives.values():
        try:
            trained = Scenario.of_dump(manifest.scenario)
            before = trained.sample(_TRAINED, 0).worlds
        except ValueError:
            continue
        unfamiliar = [each for each in vehicles_driven if each not in manifest.learners]
        if not np.isclose(trained.time_step_s, scenario.time_step_s):
            unfamiliar.append("time_step_s")
        unfamiliar += [f"{worlds.N} vehicles"] if worlds.N != before.N else _beyond(before, worlds)
        unfamiliar += _contents(trained, scenario) if worlds.N == before.N else []
        for i, script in scenario.scripts.items():
            if str(trained.scripts.get(i, script)) != str(script):
                unfamiliar.append(f"{scenario.vehicle_names[i]} by {script}")
        if unfamiliar:
            beyond = f"trained on {trained.name}, but {scenario.name} differs from it: {', '.join(unfamiliar)}"
            warnings.warn(f"{name}: {beyond}", Unfamiliar, stacklevel=2)


def _beyond(before: Worlds, worlds: Worlds) -> list[str]:
    """Return descriptions of quantities of ``worlds`` that lie outside the range of the training worlds ``before``.

    For instance, ``["latency_s in 40 % of the worlds", "no friction"]`` means: a latency lies outside the training
    range in 40 % of the worlds, and friction limits the brakes in the training worlds only.
    """
    unfamiliar, known, here = [], QUANTITY.of(before), QUANTITY.of(worlds)
    for key, rule in here.items():
        if key == "harm_weight":  # motion does not depend on it, and policies observe it scaled to the range 0 to 1
            continue
        if key not in known:
            unfamiliar.append(key)
            continue
        values, seen = rule.of(worlds), rule.of(before)
        low, high = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
        margin = 0.01 * (high - low) + 1e-9 * np.abs(high)
        share = ((values < low - margin) | (values > high + margin)).any(axis=1).mean()
        none = np.isnan(values).any(axis=1).mean()
        if none > _MOST_BEYOND and not np.isnan(seen).any():
            unfamiliar.append(f"no {key} in {100.0 * none:.0f} % of the worlds")
        if share > _MOST_BEYOND:
            unfamiliar.append(f"{key} in {100.0 * share:.0f} % of the worlds")
    absent = [key for key in known if key not in here and key != "harm_weight"]
    gone = {key: known[key].of(before) < known[key].high for key in absent}
    return unfamiliar + [f"no {key}" for key, there in gone.items() if there.any(axis=1).all()]


def _contents(trained: Scenario, scenario: Scenario) -> list[str]:
    """Return how the contents of messages differ between two scenarios, such as ``messages without mass``."""
    usual = np.array([piece in USUAL_PIECES for piece in PIECES])
    contents = [each.v2x.channel.contents(scenario.vehicles) for each in (trained, scenario)]
    before, here = (np.tile(usual, (scenario.vehicles, 1)) if each is None else each for each in contents)
    lost = [f"messages without {piece}" for k, piece in enumerate(PIECES) if (before & ~here)[:, k].any()]
    return lost + [f"messages with {piece}" for k, piece in enumerate(PIECES) if (here & ~before)[:, k].any()]
