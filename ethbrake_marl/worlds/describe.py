"""Drawn worlds as columns of a table: quantities, vehicle types, scenario, recording."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.episode.state import NUMBER, ORIGIN, State, arrays_of
from ethbrake_marl.motion.layout import Floats, Ints
from ethbrake_marl.worlds.quantities import CAR_QUANTITIES, QUANTITIES, RECORDING, USUAL
from ethbrake_marl.worlds.sampling import DrawnWorlds, Texts

if TYPE_CHECKING:
    from ethbrake_marl.worlds.scenario import Scenario


LABELS = "labels"  # memory of worlds from a table of the user: name of a column of texts -> [n]
# column of results, in which worlds are equal or from one row of a table (``first_alike``) -> what there are how many
ALIKE = {"same_as": "different_worlds", "same_row_as": "different_rows"}
# columns of results, which no label may be called
OF_RESULTS = ("agent", "knows", "world", "hidden", "scenario", *ALIKE)


def columns_of(drawn_worlds: DrawnWorlds) -> dict[str, NDArray[np.generic]]:
    worlds = drawn_worlds.worlds
    kinds = {**worlds.memories.get(LABELS, {}), **kinds_of(drawn_worlds)}
    return {"world": worlds.clock[:, NUMBER].astype(np.int64), **kinds, **quantities_of(worlds, drawn_worlds.road)}


def quantities_of(worlds: State, road: Mapping[str, Floats] = MappingProxyType({})) -> dict[str, Floats]:
    """Quantities of worlds at the alert, column -> [n], as ``worlds_from_table`` reads them.

    Capacities include the limit of the ``road`` (``DrawnWorlds.road``). The distance to an obstacle is NaN in a world
    without one. An infinite rate becomes the largest valid number.
    """
    values = {"gaps_m": worlds.gaps_m, "speeds_mps": worlds.speeds_mps}
    values |= {key: worlds.car[:, row, 1:] for key, row in CAR_QUANTITIES.items()}
    gap = worlds.obstacle_gap_m[:, np.newaxis]
    values["obstacle_gap_m"] = np.where(np.isfinite(gap), gap, np.nan)
    values |= road
    is_present = {
        key: np.isfinite(values[key]).any() for key in ("obstacle_gap_m", "brake_rate_mps3", "release_rate_mps3")
    }
    return {
        QUANTITIES[key].column_of(i): np.minimum(column, QUANTITIES[key].high)
        for key in QUANTITIES
        if key in USUAL or is_present.get(key, key in values)
        for i, column in enumerate(values[key].T[: QUANTITIES[key].count(worlds.vehicles)])
    }


def fixed_columns(scenario: Scenario) -> set[str]:
    """Columns of ``quantities_of``, except gaps and speeds, that have one value in all worlds of a scenario."""
    keys = [key for key in CAR_QUANTITIES if key in USUAL or key in scenario.sources]
    ends = {QUANTITIES[key].column_of(i): bounds for key in keys for i, bounds in enumerate(scenario.bounds(key))}
    return {name for name, (low, high) in ends.items() if low == high}


def kinds_of(drawn_worlds: DrawnWorlds) -> dict[str, Texts]:
    """``scenario``, ``recording``, ``vehicle_1_type`` and so on, column -> [n]; without columns that have no text."""
    columns = {"scenario": drawn_worlds.scenarios, RECORDING: drawn_worlds.recordings}
    types = drawn_worlds.types.T if (drawn_worlds.types != "").any() else ()
    columns = {name: column for name, column in columns.items() if (column != "").any()}
    return columns | {f"vehicle_{i + 1}_type": column for i, column in enumerate(types)}


def first_alike(worlds: State) -> Ints:
    """For each world the first one from the same row of a table or, without a table, the first equal one, [n].

    Equal worlds have equal vehicles, and the same luck with messages.
    """
    origins, seen = worlds.clock[:, ORIGIN].tolist(), dict[Any, int]()
    memories = {name: memory for name, memory in worlds.memories.items() if name != LABELS}
    arrays = arrays_of((worlds.line, worlds.car, worlds.know, worlds.wanted, memories))

    def key(k: int) -> Any:
        return origins[k] or hash(tuple(array[k].tobytes() for array in arrays))

    return np.array([seen.setdefault(key(k), k) for k in range(worlds.n)])


def clusters_of(columns: Mapping[str, NDArray[Any]]) -> NDArray[Any] | None:
    """Name or number of the cluster to which each world belongs, [n]; None if all worlds are independent.

    Worlds of one recording, of one row of a table, and equal worlds form a cluster. The text before the last ": " in
    the column ``recording`` is the name of the recording.
    """
    alike = next((columns[name] for name in ALIKE if name in columns), columns["world"])
    if RECORDING in columns:
        before, _, after = np.char.rpartition(columns[RECORDING], ": ").T
        recording = np.where(before == "", after, before)
        return np.where(recording == "", np.char.add(" ", alike.astype(str)), recording)
    is_clustered = not ALIKE.keys().isdisjoint(columns) and len(np.unique(alike)) < len(alike)
    return alike if is_clustered else None
