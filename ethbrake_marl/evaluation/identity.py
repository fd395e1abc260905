"""The identity of a result: the worlds, the scenario and the policies that it is about, and what computed it.

Two results can be compared where worlds and scenario have the same hashes. Versions are told, and no reason to refuse.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Collection, Mapping
from dataclasses import fields, is_dataclass
from importlib.metadata import version
from typing import Any, Literal

import numpy as np

from ethbrake_marl.agents.learned import LearnedAgent
from ethbrake_marl.agents.policy_agent import PolicyAgent
from ethbrake_marl.agents.protocol import AgentAround
from ethbrake_marl.files.plugins import files_run
from ethbrake_marl.physics import Ints, Worlds
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.scenario import Sample, Scenario

Kind = Literal[
    "evaluate",
    "evaluate-shards",
    "shield",
    "best-harm",
    "ablate",
    "generalise",
    "learning-curves",
    "robustness",
]
_PACKAGES = ("ethbrake-marl", "numba", "numpy")
_WORDS = {"name", "title", "description", "source"}  # what a scenario is called changes nothing
_BLOCK = 50_000  # worlds hashed at once: news of a world may be a view that takes no memory


def worlds_sha256(worlds: Worlds, index: Ints) -> str:
    """SHA-256 of a list of worlds: of every array (little-endian, by name) and the worlds' numbers in the list."""
    return _arrays_sha256({"index": index, **_arrays(worlds)})


def content_sha256(*parts: Any) -> str:
    """SHA-256 of every array of some dataclasses, one after the other."""
    return _arrays_sha256(
        {f"{k} {name}": array for k, part in enumerate(parts) for name, array in _arrays(part).items()}
    )


def _arrays_sha256(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name, array in arrays.items():
        digest.update(f"{name} {array.dtype.kind} {array.shape}\n".encode())
        for first in range(0, len(array), _BLOCK):
            part = array[first : first + _BLOCK]
            digest.update(np.ascontiguousarray(part, part.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()


def _arrays(value: Any) -> dict[str, np.ndarray]:
    """The arrays of a dataclass and of those inside it, by name; not one without columns: messages that none sends."""
    found: dict[str, np.ndarray] = {}
    for field in fields(value):
        part = getattr(value, field.name)
        found |= _arrays(part) if is_dataclass(part) else {} if part.shape[1:] == (0,) else {field.name: part}
    return found


def scenario_sha256(scenario: Scenario) -> str:
    """SHA-256 of all that shapes an episode: every value of the scenario, defaults too, but neither name nor texts."""
    content = scenario.content(without=_WORDS)
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def driving_policy(agent: object) -> object:
    """What is inside everything that is around an agent: the policy that it drives by, or the agent itself."""
    while isinstance(agent, AgentAround | LearnedAgent):
        agent = agent.policy
    return agent


def policy_sha256(agent: object) -> str | None:
    """The hash of the policy that an agent drives by, inside whatever is around it; None without one.

    Of a bundle it is that in its manifest, which binds names, network and weights (``Manifest.manifest_sha256``); of
    another library's, that of its weights (``agents.foreign.weights_sha256``).
    """
    agent = driving_policy(agent)
    if isinstance(agent, PolicyAgent):
        return agent.weights_sha256()
    return agent.manifest.manifest_sha256 if isinstance(agent, Policy) else None


def result_versions() -> dict[str, str]:
    """Name -> version of Python and of every package that a result's numbers depend on.

    Of the user's own files that this process ran (plug-ins, agents) the SHA-256 is told in its place.
    """
    versions = {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}
    return versions | {name: f"SHA-256 {sha256}" for name, sha256 in files_run().items()}


def identity_line(scenario: Scenario, sample: Sample) -> str:
    """One line for results that are a text: the hashes of worlds and scenario, and versions."""
    worlds, versions = worlds_sha256(sample.worlds, sample.index), result_versions()
    told = ", ".join(f"{name} {number}" for name, number in versions.items())
    return f"Worlds: SHA-256 {worlds}; scenario: SHA-256 {scenario_sha256(scenario)}; {told}."


def policies_by_name(policies: Mapping[int, str], scenario: Scenario) -> dict[str, str]:
    """Vehicle's name -> SHA-256 of its policy, from that by index."""
    return {scenario.vehicle_names[vehicle]: sha256 for vehicle, sha256 in policies.items()}


def result_identity(
    kind: Kind, scenario: Scenario, sample: Sample | None, left_out: Collection[int] = ()
) -> dict[str, Any]:
    """What a results file of this kind says of itself: ``kind``, hashes of worlds and scenario, ``versions``.

    ``left_out`` are rows of the sample that no figure counts. Without a sample nothing is said of worlds: they differ
    inside the file, which says it there.
    """
    found: dict[str, Any] = {"kind": kind, "scenario_sha256": scenario_sha256(scenario), "versions": result_versions()}
    if sample is not None:
        worlds, index = sample.worlds, sample.index
        if left_out:
            rows = np.setdiff1d(np.arange(worlds.n), list(left_out))
            worlds, index = worlds.take(rows), index[rows]
        found["worlds_sha256"] = worlds_sha256(worlds, index)
    return found
