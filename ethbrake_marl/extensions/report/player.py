"""The episode player of a page. Its data are pieces of constant acceleration."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from markupsafe import Markup

from ethbrake_marl.episode.counts import HARM
from ethbrake_marl.evaluation.compared import Compared
from ethbrake_marl.evaluation.record import EpisodeRecord
from ethbrake_marl.extensions.rendering.scene import BODY_M
from ethbrake_marl.extensions.report.page import data, fill, shown
from ethbrake_marl.extensions.report.style import quantities
from ethbrake_marl.motion.layout import Floats

DATA = "episode_data"  # id of the data in a page; no section has it
SAMPLE_S = 0.005  # time between two samples of the motion
SAME = 1e-8  # a sample is left out if the one before it, continued, is this close to it (m, m/s, m/s2)
MOST_SHOWN = 3  # agents that are shown at the start


def player(
    compared: Compared, focus: str, kinds: Mapping[int, str], records: Mapping[str, Sequence[EpisodeRecord]]
) -> Markup:
    """Return the player of some worlds. It shows ``focus``, the agent that the page is about, and the last agent first.

    ``kinds``: row of a world -> heading of its group. ``records``: agent -> episode in each of these worlds, with
    samples ``SAMPLE_S`` apart.
    """
    result, agents, worlds = compared.result, list(records), list[dict[str, Any]]()
    for (row, kind), *episodes in zip(kinds.items(), *records.values(), strict=True):
        first, total = (result[focus][harm][row] for harm in HARM.values())
        worlds.append(
            {
                "number": int(result.worlds["world"][row]),
                "kind": shown(kind),
                "why": shown(f"{focus}: harm {first:.2f} first-impact, {total:.2f} total"),
                "conditions": quantities(episodes[0].initial),
                "episodes": [episode_data(record) for record in episodes],
            }
        )
    order = dict.fromkeys([agents.index(focus), 0, *reversed(range(len(agents)))])
    content = {
        "vehicles": compared.scenario.vehicles,
        "agents": [shown(agent) for agent in agents],
        "shown": sorted([*order][:MOST_SHOWN]),
        "worlds": worlds,
    }
    return fill(
        "player.html.j2",
        vehicles=compared.scenario.vehicles,
        shielded=any(episode["stepped"] for world in worlds for episode in world["episodes"]),
        name=DATA,
        episodes=data(DATA, content),
        body=BODY_M,
    )


def episode_data(record: EpisodeRecord) -> dict[str, Any]:
    obstacle = float(record.initial.obstacle_gap_m[0])
    return {
        "pieces": base64.b64encode(np.asarray(pieces_of(record), "<f8").tobytes()).decode("ascii"),
        "end": float(record.time_s[-1]),
        "impacts": _impacts(record),
        "stepped": replaced_at_s(record),
        "driven": [body - 1 for body in record.vehicles],
        "rest": record.at_rest,
        "obstacle": obstacle if np.isfinite(obstacle) else None,
    }


def pieces_of(record: EpisodeRecord) -> Floats:
    """Return the motion as pieces of constant acceleration, [k, 1 + 3 N].

    The columns of a piece: the time at which it begins (s), place of Vehicle 1 (m), N - 1 gaps (m), N speeds (m/s), N
    accelerations (m/s2). An impact between two samples ends a piece; the next one leads from there to the second
    sample. If something else happens there as well, such as another impact, places are wrong by millimetres until the
    second sample.
    """
    time_s, speeds, N = record.time_s, record.speeds_mps, record.speeds_mps.shape[1]
    rates = np.zeros_like(speeds)
    rates[:-1] = np.diff(speeds, axis=0) / np.diff(time_s)[:, np.newaxis]
    struck_s = np.array(sorted({*record.impacts.time_s.tolist()}))
    struck = np.clip(np.searchsorted(time_s, struck_s, "right") - 1, 0, len(time_s) - 2)
    for k in np.unique(struck).tolist():
        rates[k] = rates[k - 1] if k else 0.0
    rows = np.column_stack([time_s, record.positions_m[:, 0], record.gaps_m, speeds, rates])
    goes_on = (np.abs(moved(rows[:-1], np.diff(time_s), N) - rows[1:, 1:]) <= SAME).all(axis=1)
    later = rows[struck + 1]
    begun = np.column_stack([struck_s, moved(later, struck_s - later[:, 0], N)])
    pieces: Floats = np.concatenate([rows[np.append(True, ~goes_on)], begun])
    return pieces[np.argsort(pieces[:, 0], kind="stable")]


def moved(pieces: Floats, t: Floats, N: int) -> Floats:
    """Return pieces of motion of N vehicles (``pieces_of``), without times, ``t`` [k] seconds after they begin."""
    speeds, rates, t = pieces[:, 1 + N : 1 + 2 * N], pieces[:, 1 + 2 * N :], t[:, np.newaxis]
    ways = (speeds + 0.5 * rates * t) * t
    gaps = pieces[:, 2 : 1 + N] + ways[:, :-1] - ways[:, 1:]
    return np.column_stack([pieces[:, 1] + ways[:, 0], gaps, speeds + rates * t, rates])


def replaced_at_s(record: EpisodeRecord) -> list[float]:
    shields = [(before.time_s, after.memories.get("shield")) for before, after in pairwise(record.states[1:])]
    return [float(time_s[0]) for time_s, memory in shields if memory is not None and memory.intervened.any()]


def _impacts(record: EpisodeRecord) -> list[list[float]]:
    """Return seven numbers of each impact, in order of time.

    The time (s), the pair (-1: the obstacle), the closing speed (m/s), whether it is the pair's first impact, the
    number of impacts so far, and both harms so far (m2/s2), which end with those of the episode.
    """
    rows, last = record.impacts, record.last
    number, first, total = np.cumsum(rows.number), np.cumsum(rows.first_impact_harm), np.cumsum(rows.total_harm)
    if len(number):
        first[np.flatnonzero(rows.first_impact_harm)[-1] :], total[-1] = last.harm("first")[0], last.harm("total")[0]
    is_first = rows.first_impact_harm > 0.0
    columns = (rows.time_s, rows.pair - 1, rows.closing_speed_mps, is_first, number, first, total)
    return [list(map(float, row)) for row in zip(*columns, strict=True)]
