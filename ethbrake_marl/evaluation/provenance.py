"""Identity of a result: digests of worlds, scenario, physics and policies, and versions of software."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import numpy as np

from ethbrake_marl.episode.departures import PLAIN_ROWS
from ethbrake_marl.episode.state import State
from ethbrake_marl.files.python_file import files_run
from ethbrake_marl.motion.layout import (
    CAR_NAMES,
    FIRST,
    FORCE,
    GAP,
    HIT,
    IMPACTS,
    RESTITUTION,
    SCRIPTED,
    SPEED,
    TOTAL,
    Floats,
)
from ethbrake_marl.registry import versions_used

EVALUATION_PACKAGES = ("ethbrake-marl", "numba", "numpy")
# Rows of `line` with what vehicles do at the alert, in the order in which they are hashed
MOTION = [SPEED, FORCE, GAP, HIT, FIRST, TOTAL, IMPACTS]
KEYS_WITHOUT_EFFECT = ("name", "title", "description", "source")  # keys of a scenario that do not affect an episode


def worlds_sha256(worlds: State) -> str:
    """SHA-256 of worlds at the alert: of the quantities ``MOTION`` and ``plain_car``, of ``know`` and of ``wanted``.

    Numbers are little-endian floats. Another quantity of vehicles (row of ``car``) is hashed with its name, unless 0.
    """
    digest, arrays = hashlib.sha256(), [worlds.line[:, MOTION], plain_car(worlds), worlds.know, worlds.wanted]
    for name in sorted(CAR_NAMES):
        further = worlds.car[:, CAR_NAMES.index(name)]
        if CAR_NAMES.index(name) not in (*PLAIN_ROWS, SCRIPTED) and further.any():
            digest.update(name.encode())
            arrays.append(further)
    for array in arrays:
        digest.update(f"{array.shape}".encode())
        digest.update(np.ascontiguousarray(array, "<f8").data)
    return digest.hexdigest()


def plain_car(worlds: State) -> Floats:
    """``PLAIN_ROWS`` of the parameters, and a row of 1 for each vehicle, which published digests contain."""
    is_vehicle = np.arange(worlds.vehicles + 1) > 0
    return np.insert(worlds.car[:, PLAIN_ROWS], PLAIN_ROWS.index(RESTITUTION), is_vehicle, axis=1)


def about_scenario(scenario: Any, seed: int | None = None) -> dict[str, Any]:
    """Entries for ``Result.about``: seed of the worlds; scripts, SHA-256 and physics of the scenario."""
    content = json.dumps(scenario.content(without=KEYS_WITHOUT_EFFECT), sort_keys=True, separators=(",", ":"))
    scripts = {name: role for name, role in scenario.roles.items() if role != "learner"}
    about = {"seed": seed, "scripts": scripts, "scenario_sha256": hashlib.sha256(content.encode()).hexdigest()}
    return about if scenario.physics is None else {**about, "physics": scenario.physics}


def versions() -> dict[str, str]:
    """Name -> version of Python and of every package that affects a result; of a user's Python file its SHA-256."""
    core_versions = {"python": platform.python_version()} | {name: version(name) for name in EVALUATION_PACKAGES}
    return core_versions | versions_used() | {name: f"SHA-256 {sha256}" for name, sha256 in files_run().items()}


def policy_digests(drivers: Mapping[int, object]) -> dict[str, str]:
    """Vehicle -> SHA-256 of the manifest of its policy, if it has one. ``drivers``: vehicle number -> agent."""
    manifests = {body: getattr(getattr(agent, "policy", None), "manifest", None) for body, agent in drivers.items()}
    return {f"vehicle_{body}": manifest.manifest_sha256 for body, manifest in manifests.items() if manifest is not None}
