"""Identity of a result: hashes of its worlds, scenario and policies, and the versions that computed it.

Two results can be compared if their worlds and scenarios have the same hashes. Different versions are reported, but do
not prevent a comparison.
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

_WORDS = {"name", "title", "description", "source"}  # texts of a scenario, which do not affect an episode

_BLOCK = 50_000  # worlds hashed at once; arrays of messages may be views that would take much memory when copied

CHUNK = 2_500  # worlds advanced together, to limit memory; affects no result but ``worlds_sha256`` of a long list

EPISODES, LIST_SEED = 10_000, 7  # size and seed of the standard evaluation list; trainings use other seeds

HELD = 100_000  # largest list that is held in memory as a whole

HASHES = 1 << 256  # modulus of sums of hashes


def worlds_sha256(worlds: Worlds, index: Ints) -> str:
    """Return a hash of a list of worlds, as 64 hexadecimal digits: equal lists have equal hashes on every machine.

    It is the SHA-256 of every array (little-endian, by name) and of the numbers of the worlds. For more than 100,000
    worlds it is ``hash_of_chunks``, which needs less memory.

    Args:
        worlds: the n worlds at the alert.
        index: [n] number of each world in its list.

    """
    if worlds.n > HELD:
        return f"{hash_of_chunks(worlds, index):064x}"
    return _hash_at_once(worlds, index)


def _hash_at_once(worlds: Worlds, index: Ints) -> str:
    return _arrays_sha256({"index": index, **_arrays(worlds)})


def hash_of_chunks(worlds: Worlds, index: Ints) -> int:
    """Return the sum modulo 2^256 of the SHA-256 of each chunk of 2,500 worlds.

    ``index`` [n] is the number of each world in its list; chunks are numbers 0 to 2,499, 2,500 to 4,999, and so on.
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
    """Return the arrays of the dataclass ``value`` and of the dataclasses inside it, by name.

    Arrays that say nothing are omitted: those of messages and braking profiles if the worlds have none, build-up rates
    of brakes that are all infinite, and weights of harm that are all 1.
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
    """Return the SHA-256 of everything in a scenario that affects an episode, including defaults, in hexadecimal.

    Name, title and other texts are excluded.
    """
    content = scenario.content(without=_WORDS)
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def policies_of(drivers: Mapping[int, object]) -> dict[str, str]:
    """Return the SHA-256 of each vehicle's trained policy: ``{"vehicle_2": "3f..."}``.

    ``drivers`` maps the index of a vehicle (0 = front) to its agent. Vehicles with an untrained agent are omitted.
    """
    return {f"vehicle_{i + 1}": sha for i, agent in drivers.items() if (sha := policy_sha256(agent)) is not None}


def result_versions() -> dict[str, str]:
    """Return name -> version of Python and of every package on which a result's numbers depend.

    This includes packages that provided a part in this process, and the SHA-256 of the user's own Python files that it
    ran.
    """
    return own_versions() | versions_used() | {name: f"SHA-256 {sha256}" for name, sha256 in files_run().items()}


def own_versions() -> dict[str, str]:
    """Return name -> version of Python, this package, numba and numpy, without other loaded packages."""
    return {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}


def result_identity(
    kind: Kind, scenario: Scenario, sample: Sample | None, left_out: Collection[int] = ()
) -> dict[str, Any]:
    """Return the entries that identify a result, for its JSON file: ``kind``, hashes and ``versions``.

    The hashes are ``scenario_sha256`` and ``worlds_sha256``.

    Args:
        kind: kind of results, such as ``evaluate`` or ``shield``.
        scenario: scenario of the worlds.
        sample: the worlds; None if parts of the file have different worlds: then there is no ``worlds_sha256``.
        left_out: rows of the sample that the results do not count; they are not hashed.

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
