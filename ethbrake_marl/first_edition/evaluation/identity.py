"""Identity of a result: hashes of worlds, scenario and policies, and the software versions that computed the result.

Two results can be compared if the hashes of their worlds and scenarios are equal. Different software versions are
reported, but do not prevent a comparison.
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

from ethbrake_marl.files.python_file import files_run
from ethbrake_marl.first_edition.agents.protocol import policy_sha256
from ethbrake_marl.first_edition.physics.state import Ints, Worlds
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.registry import versions_used

Kind = Literal["evaluate", "shield", "best-harm", "ablate", "learning-curves"]

_PACKAGES = ("ethbrake-marl", "numba", "numpy")

_WORDS = {"name", "title", "description", "source"}  # keys of a scenario that do not affect an episode

_BLOCK = 50_000  # number of worlds hashed at once; copies of all arrays of messages would take much memory

CHUNK = 2_500  # number of worlds simulated together, to limit memory; ``worlds_sha256`` of long lists depends on it

EPISODES, LIST_SEED = 10_000, 7  # length and seed of the standard evaluation list; trainings use other seeds

HELD = 100_000  # length of the longest evaluation list whose worlds are all held in memory

HASHES = 1 << 256  # sums of hashes are taken modulo this number


def worlds_sha256(worlds: Worlds, index: Ints) -> str:
    """Return a hash of worlds as 64 hexadecimal digits. Equal worlds have equal hashes on every machine.

    The hash is the SHA-256 of all arrays of ``worlds`` at the alert (little-endian, with their names) and of ``index``,
    the number of each world in its evaluation list, [n]. For more than 100,000 worlds, ``hash_of_chunks`` computes
    another hash, which needs less memory.
    """
    if worlds.n > HELD:
        return f"{hash_of_chunks(worlds, index):064x}"
    return _hash_at_once(worlds, index)


def _hash_at_once(worlds: Worlds, index: Ints) -> str:
    return _arrays_sha256({"index": index, **_arrays(worlds)})


def hash_of_chunks(worlds: Worlds, index: Ints) -> int:
    """Return a hash of worlds: the sum, modulo 2^256, of the SHA-256 of all chunks of 2,500 worlds.

    The first chunk contains the worlds with numbers (``index``) 0 to 2,499, and so on.
    """
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
    """Return the arrays in the dataclass ``value`` and in the dataclasses inside it, by the field's name.

    Some arrays are omitted if they have no effect: messages and braking profiles if the worlds have none, build-up
    rates of brakes if all are infinite, and weights of harm if all are 1.
    """
    arrays: dict[str, np.ndarray] = {}
    usual = {"brake_rate_mps3": np.inf, "release_rate_mps3": np.inf, "harm_weight": 1.0}
    for field in fields(value):
        part = getattr(value, field.name)
        if is_dataclass(part):
            arrays |= _arrays(part)
        elif 0 not in part.shape[1:] and not (field.name in usual and (part == usual[field.name]).all()):
            arrays[field.name] = part
    return arrays


def scenario_sha256(scenario: Scenario) -> str:
    """Return the SHA-256 of a scenario, including default values, without its name, title, description and source."""
    content = scenario.content(without=_WORDS)
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def policies_of(drivers: Mapping[int, object]) -> dict[str, str]:
    """Return the SHA-256 of each vehicle's trained policy, such as ``{"vehicle_2": "3f..."}``.

    ``drivers`` maps the index of a vehicle (0 = front) to its agent. Vehicles without a trained policy are omitted.
    """
    return {f"vehicle_{i + 1}": sha for i, agent in drivers.items() if (sha := policy_sha256(agent)) is not None}


def result_versions() -> dict[str, str]:
    """Return the versions of Python and of every package on which the numbers of a result depend, by name.

    These include the extension packages that this process used, and the SHA-256 of each Python file of the user that
    this process ran.
    """
    return own_versions() | versions_used() | {name: f"SHA-256 {sha256}" for name, sha256 in files_run().items()}


def own_versions() -> dict[str, str]:
    """Return the versions of Python, this package, numba and numpy, by name."""
    return {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}


def result_identity(
    kind: Kind, scenario: Scenario, sample: Sample | None, left_out: Collection[int] = ()
) -> dict[str, Any]:
    """Return ``kind``, ``scenario_sha256``, ``worlds_sha256`` and ``versions`` for a JSON results file.

    The rows ``left_out`` of ``sample`` do not affect ``worlds_sha256``. If the file contains results of several
    samples of worlds, pass None as ``sample``; the result then has no ``worlds_sha256``.
    """
    identity: dict[str, Any] = {
        "kind": kind,
        "scenario_sha256": scenario_sha256(scenario),
        "versions": result_versions(),
    }
    if sample is not None:
        worlds, index = sample.worlds, sample.index
        if left_out:
            rows = np.setdiff1d(np.arange(worlds.n), list(left_out))
            worlds, index = worlds.take(rows), index[rows]
        identity["worlds_sha256"] = worlds_sha256(worlds, index)
    return identity
