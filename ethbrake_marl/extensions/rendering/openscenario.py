"""An emergency as ASAM OpenSCENARIO XML 1.3: each vehicle follows its trajectory, on a straight road in OpenDRIVE 1.7.

The trajectories have a vertex at each sample of a record and at each impact. Vehicles have no length in this package;
here each is ``LENGTH_M`` long, so that gaps from bumper to bumper are those of the record.
"""

from __future__ import annotations

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from ethbrake_marl.evaluation.record import EpisodeRecord, advance_worlds, with_post
from ethbrake_marl.motion.layout import GAP, Floats, scratch_for

LENGTH_M = 4.5
TO_FRONT_M = 3.7  # from the rear axle, which is a vehicle's position in OpenSCENARIO, to the front bumper
AROUND_M = 100.0  # road behind the line, and beyond its last place


def impact_positions(record: EpisodeRecord) -> Floats:
    """Positions of the vehicles at the k impacts, as in ``EpisodeRecord.positions_m``, [k, N] m."""
    decisions_s = np.array([state.time_s[0] for state in record.states[:-1]])
    positions = np.empty((len(record.impacts.time_s), record.positions_m.shape[1]))
    for row, time in enumerate(record.impacts.time_s):
        k = int(np.searchsorted(decisions_s, time, "right")) - 1
        before, after = record.states[k : k + 2]
        line, scratch = with_post(before), scratch_for(before.vehicles + 1)
        post_m = line[0, GAP, 0] + record.positions_m[np.searchsorted(record.time_s, decisions_s[k]), 0]
        advance_worlds(line, before.car, before.time_s, np.array([time]), after.wanted, scratch)
        positions[row] = post_m - np.cumsum(line[0, GAP, :-1])
    return positions


def to_openscenario(record: EpisodeRecord, road: str) -> tuple[bytes, ...]:
    """Contents of two files: the scenario, and its road, which the scenario finds under the name ``road``.

    The properties of a vehicle name each of its impacts, with its time and closing speed.
    """
    state, impacts = record.initial, record.impacts
    times_s, rows = np.unique(np.append(record.time_s, impacts.time_s), return_index=True)
    fronts_m = np.concatenate([record.positions_m, impact_positions(record)])[rows]
    places_m = fronts_m - LENGTH_M * np.arange(fronts_m.shape[1]) - TO_FRONT_M
    shift_m = AROUND_M - places_m.min()
    obstacle_m = [float(shift_m + gap_m) for gap_m in state.obstacle_gap_m if np.isfinite(gap_m)]
    quantities = {
        "mass_kg": 1000.0 * state.mass_t[0], "driving": state.driving_capacity_mps2[0],
        "braking": state.braking_capacity_mps2[0], "speed_mps": state.speeds_mps[0],
        "places_m": (places_m + shift_m).T,
    }  # fmt: skip
    values = {
        "title": f"{record.scenario}, {record.agent}", "road": road, "times_s": times_s.tolist(),
        "vehicles": [{name: each[i].tolist() for name, each in quantities.items()} for i in range(state.vehicles)],
        "pairs": impacts.pair.tolist(),
        "impacts": np.column_stack([impacts.time_s, impacts.closing_speed_mps]).tolist(),
        "obstacle_m": obstacle_m,
        "length_m": max([float(places_m.max() + shift_m), *obstacle_m]) + AROUND_M,
    }  # fmt: skip
    templates = Environment(
        loader=PackageLoader("ethbrake_marl.extensions.rendering", "."), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    return tuple(templates.get_template(name).render(values).encode() for name in ("emergency.xosc.j2", "line.xodr.j2"))
