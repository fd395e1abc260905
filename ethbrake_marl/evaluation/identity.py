"""The identity of a result: the worlds, the scenario and the policies that it is about, and what computed it.

Two results can be compared where worlds and scenario have the same hashes. Versions are told, and no reason to
refuse.
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

from ethbrake_marl.agents.protocol import policy_sha256
from ethbrake_marl.files.python_file import files_run
from ethbrake_marl.physics.state import Ints, Worlds
from ethbrake_marl.registry import versions_used
from ethbrake_marl.scenario.sample import Sample
from ethbrake_marl.scenario.schema import Scenario

Kind = Literal["evaluate", "shield", "best-harm", "ablate", "learning-curves"]

_PACKAGES = ("ethbrake-marl", "numba", "numpy")

_WORDS = {"name", "title", "description", "source"}  # what a scenario is called changes nothing

_BLOCK = 50_000  # worlds hashed at once: news of a world may be a view that takes no memory

CHUNK = 2_500  # worlds advanced together: bounds memory; of results only ``worlds_sha256`` of a long list has it

EPISODES, LIST_SEED = 10_000, 7  # of the list on which everything is measured; a training has a seed of its own

HELD = 100_000  # worlds of a list that is held in memory as a whole, unless each of its worlds is asked for

HASHES = 1 << 256  # sums of hashes are kept modulo this


def worlds_sha256(worlds: Worlds, index: Ints) -> str:
    """SHA-256 of a list of worlds: of every array (little-endian, by name) and the worlds' numbers in the list.

    Of more than ``HELD`` worlds it is ``hash_of_chunks``, which needs no more than one chunk of them at once.
    """
    if worlds.n > HELD:
        return f"{hash_of_chunks(worlds, index):064x}"
    return _hash_at_once(worlds, index)


def _hash_at_once(worlds: Worlds, index: Ints) -> str:
    return _arrays_sha256({"index": index, **_arrays(worlds)})


def hash_of_chunks(worlds: Worlds, index: Ints) -> int:
    """Sum modulo 2^256 of the SHA-256 of the worlds of each chunk: those numbered 0 to 2,499, 2,500 to 4,999, ..."""
    chunks = [np.flatnonzero(index // CHUNK == number) for number in np.unique(index // CHUNK)]
    return sum(int(_hash_at_once(worlds.take(chunk), index[chunk]), 16) for chunk in chunks) % HASHES


def _arrays_sha256(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name, array in arrays.items():
        digest.update(f"{name} {array.dtype.kind} {array.shape}\n".encode())
        for first in range(0, len(array), _BLOCK):
            part = array[first : first + _BLOCK]
            digest.update(np.ascontiguousarray(part, part.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()


def _arrays(value: Any) -> dict[str, np.ndarray]:
    """The arrays of a dataclass and of those inside it, by name; not those that say nothing.

    These are messages that none sends and pieces that nobody brakes in, and rates of brakes that are there at once.
    """
    found: dict[str, np.ndarray] = {}
    for field in fields(value):
        part = getattr(value, field.name)
        if is_dataclass(part):
            found |= _arrays(part)
        elif 0 not in part.shape[1:] and not (field.name.endswith("_rate_mps3") and np.isinf(part).all()):
            found[field.name] = part
    return found


def scenario_sha256(scenario: Scenario) -> str:
    """SHA-256 of all that shapes an episode: every value of the scenario, defaults too, but neither name nor texts."""
    content = scenario.content(without=_WORDS)
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def policies_of(drivers: Mapping[int, object]) -> dict[str, str]:
    """Vehicle's name -> SHA-256 of the policy that drives it; none of who has no policy."""
    return {f"vehicle_{i + 1}": sha for i, agent in drivers.items() if (sha := policy_sha256(agent)) is not None}


def result_versions() -> dict[str, str]:
    """Name -> version of Python and of every package that a result's numbers depend on.

    Packages that gave a part to this process are among them; of the user's own files that it ran the SHA-256 is told.
    """
    return own_versions() | versions_used() | {name: f"SHA-256 {sha256}" for name, sha256 in files_run().items()}


def own_versions() -> dict[str, str]:
    """Those of them that every process has, whatever else it loaded."""
    return {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}


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
