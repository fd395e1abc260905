"""Episodes in a report: choice of the worlds to show, and the player of their episodes."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from markupsafe import Markup

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.episode.counts import IMPACT_COUNTS
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.comparison import Comparison
from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.record import EpisodeRecord, record_episodes
from ethbrake_marl.evaluation.summary import BASELINE
from ethbrake_marl.extensions.rendering.scene import BODY_M
from ethbrake_marl.extensions.report.best_known import BestKnown
from ethbrake_marl.extensions.report.page import Section, data, fill, page_part, printable_text
from ethbrake_marl.extensions.report.style import quantities
from ethbrake_marl.motion.layout import Bools, Floats, Ints
from ethbrake_marl.worlds.describe import ALIKE

DATA = "episode_data"  # id of the data in a page; no section has it
MOTION_SAMPLE_S = 0.005  # time between two samples of the motion
SAME_SAMPLE = 1e-8  # a sample is left out if the one before it, continued, is this close to it (m, m/s, m/s2)
MOST_SHOWN = 3  # agents that are shown at the start


def player(
    compared: Comparison, focus: str, kinds: Mapping[int, str], records: Mapping[str, Sequence[EpisodeRecord]]
) -> Markup:
    """Player of all agents' episodes in some worlds, as HTML; ``focus``, the first and the last agent are shown first.

    ``kinds``: row of a world -> heading of its group. ``records``: agent -> episode in each of these worlds, sampled
    every ``MOTION_SAMPLE_S`` seconds.
    """
    result, agents, worlds = compared.result, list(records), list[dict[str, Any]]()
    for (row, kind), *episodes in zip(kinds.items(), *records.values(), strict=True):
        worlds.append(
            {
                "number": int(result.worlds["world"][row]),
                "kind": printable_text(kind),
                "value": float(result[focus][compared.harm_count.column][row]),
                "conditions": quantities(episodes[0].initial),
                "episodes": [episode_data(record) for record in episodes],
            }
        )
    order = dict.fromkeys([agents.index(focus), 0, *reversed(range(len(agents)))])
    content = {
        "vehicles": compared.scenario.vehicles,
        "agents": [printable_text(agent) for agent in agents],
        "shown": sorted([*order][:MOST_SHOWN]),
        "worlds": worlds,
    }
    return fill(
        "player.html.j2",
        vehicles=compared.scenario.vehicles,
        shielded=any(episode["stepped"] for world in worlds for episode in world["episodes"]),
        name=DATA,
        ranked_by=f"{compared.harm_count.words} of {focus} (m²/s²)",
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
    """Motion in an episode as k pieces of constant acceleration, [k, 1 + 3 N].

    Columns: time of the beginning (s), position of Vehicle 1 (m), N - 1 gaps (m), N speeds (m/s), N accelerations
    (m/s2). An impact between two samples begins a piece. With another event between them, positions are wrong by
    millimetres up to the second sample.
    """
    time_s, speeds, N = record.time_s, record.speeds_mps, record.speeds_mps.shape[1]
    rates = np.zeros_like(speeds)
    rates[:-1] = np.diff(speeds, axis=0) / np.diff(time_s)[:, np.newaxis]
    struck_s = np.array(sorted({*record.impacts.time_s.tolist()}))
    struck = np.clip(np.searchsorted(time_s, struck_s, "right") - 1, 0, len(time_s) - 2)
    for k in np.unique(struck).tolist():
        rates[k] = rates[k - 1] if k else 0.0
    rows = np.column_stack([time_s, record.positions_m[:, 0], record.gaps_m, speeds, rates])
    goes_on = (np.abs(extrapolate(rows[:-1], np.diff(time_s), N) - rows[1:, 1:]) <= SAME_SAMPLE).all(axis=1)
    later = rows[struck + 1]
    begun = np.column_stack([struck_s, extrapolate(later, struck_s - later[:, 0], N)])
    pieces: Floats = np.concatenate([rows[np.append(True, ~goes_on)], begun])
    return pieces[np.argsort(pieces[:, 0], kind="stable")]


def extrapolate(pieces: Floats, t: Floats, N: int) -> Floats:
    """Positions, gaps, speeds and accelerations ``t`` [k] seconds after k ``pieces`` of N vehicles begin, [k, 3 N]."""
    speeds, rates, t = pieces[:, 1 + N : 1 + 2 * N], pieces[:, 1 + 2 * N :], t[:, np.newaxis]
    ways = (speeds + 0.5 * rates * t) * t
    gaps = pieces[:, 2 : 1 + N] + ways[:, :-1] - ways[:, 1:]
    return np.column_stack([pieces[:, 1] + ways[:, 0], gaps, speeds + rates * t, rates])


def replaced_at_s(record: EpisodeRecord) -> list[float]:
    shields = [(before.time_s, after.memories.get("shield")) for before, after in pairwise(record.states[1:])]
    return [float(time_s[0]) for time_s, memory in shields if memory is not None and memory.intervened.any()]


def _impacts(record: EpisodeRecord) -> list[list[float]]:
    """Impacts of an episode in order of time, seven numbers each.

    Time (s), pair from 0 (-1: Vehicle 1 and the obstacle), closing speed (m/s), whether it is the pair's first impact,
    and the number of impacts, first-impact harm and total harm so far (m2/s2).
    """
    rows, last = record.impacts, record.last
    number, first, total = np.cumsum(rows.number), np.cumsum(rows.first_impact_harm), np.cumsum(rows.total_harm)
    if len(number):
        first[np.flatnonzero(rows.first_impact_harm)[-1] :], total[-1] = last.harm("first")[0], last.harm("total")[0]
    is_first = rows.first_impact_harm > 0.0
    columns = (rows.time_s, rows.pair - 1, rows.closing_speed_mps, is_first, number, first, total)
    return [list(map(float, row)) for row in zip(*columns, strict=True)]


MOST_WORLDS = 50
WORST_WORLDS = 10
WORLDS_PER_KIND = 5  # worlds of every kind except the worst and the random ones
TYPICAL = (0.5, 0.6, 0.7, 0.8, 0.9)  # quantiles of the harm


def shown_worlds(compared: Comparison, focus: str) -> dict[int, str]:
    """Worlds in which to show the agent ``focus``: row of the result -> why it is shown."""
    result, column = compared.result, compared.harm_count.column
    cost, best_known, chosen = result[focus][column], BestKnown.of(result), dict[int, str]()

    def add(kind: str, rows: Iterable[int] | Ints, most: int = WORLDS_PER_KIND) -> None:
        fresh = different_rows(result, [*chosen, *map(int, rows)])[len(chosen) :]
        chosen.update(dict.fromkeys(fresh[: min(most, MOST_WORLDS - len(chosen))], kind))

    add(f"Where {focus} did worst", worst_rows(compared, focus), WORST_WORLDS)
    if best_known is not None and best_known.contact_avoidable is not None:
        needless = result[focus]["collided"] & best_known.contact_avoidable
        add(f"Contact was avoidable, and {focus} collided", rows_by_value(cost, needless))
    if BASELINE in result.columns and focus != BASELINE:
        saved = result[BASELINE][column] - cost
        add(f"Where {focus} saved most against {BASELINE}", rows_by_value(saved, saved > 0.0))
        add(f"Where {focus} did worse than {BASELINE}", rows_by_value(-saved, saved < 0.0))
    order = np.argsort(cost, kind="stable")
    add(f"Typical of {focus}", [order[int(q * (result.n - 1))] for q in TYPICAL])
    add("Drawn at random", np.random.default_rng(0).permutation(result.n), MOST_WORLDS)
    return chosen


def worst_rows(compared: Comparison, focus: str) -> list[int]:
    """Rows of the worlds with the largest cost of ``focus`` above the best known one (above 0, if none is known), worst
    first.
    """
    result, count, best_known = compared.result, compared.harm_count, BestKnown.of(compared.result)
    best = 0.0 if best_known is None else best_known.harm.get(count, 0.0)
    value = result[focus][count.column] - best
    return different_rows(result, rows_by_value(value, value > 0.0).tolist())[:WORST_WORLDS]


def different_rows(result: Result, rows: Sequence[int]) -> list[int]:
    """Without rows whose world equals that of an earlier one, or is from the same row of a table."""
    alike = next((result.worlds[name] for name in ALIKE if name in result.worlds), np.arange(result.n))
    different = dict[int, int]()
    for row in rows:
        different.setdefault(int(alike[row]), row)
    return [*different.values()]


def rows_by_value(value: Floats, among: Bools) -> Ints:
    order: Ints = np.argsort(-value, kind="stable")
    return order[among[order]]


def episodes_section(compared: Comparison, focus: str, kinds: dict[int, str]) -> Section:
    """Section that plays back the worlds ``kinds`` (row -> why it is shown), in which every team drives once more.

    A note names every agent whose harm now differs from its harm in the evaluation.
    """
    rows, worlds = [*kinds], compared.worlds(kinds)
    _, game = open_game(compared.scenario, reward={"harm_count": compared.harm_count})
    records = {agent: record_episodes(worlds, team, game, MOTION_SAMPLE_S) for agent, team in compared.teams.items()}
    moving = sum(not all(record.at_rest for record in world) for world in zip(*records.values(), strict=True))
    until = "from the alert until all vehicles are at rest"
    if moving:
        until += (
            f", or until the horizon of {compared.scenario.horizon_s:g} s. In {count_of(moving, 'world')}, vehicles"
            " still moved at the horizon under some agent; the player names this agent"
        )
    n = compared.result.n
    body: list[str] = [f"{f'{len(rows)} of the {n:,}' if len(rows) < n else f'All {n}'} worlds, {until}."]
    for agent, episodes in records.items():
        repeated_harm = np.array([[record.last.harm(count)[0] for count in IMPACT_COUNTS] for record in episodes])
        evaluated_harm = np.column_stack([compared.result[agent][count.column][rows] for count in IMPACT_COUNTS])
        if changed_count := int((repeated_harm != evaluated_harm).any(axis=1).sum()):
            text = (
                f"In {count_of(changed_count, 'world')} of these, {agent} drove differently the second time: the player"
            )
            body.append(page_part("paragraph", f"{text} shows another episode than the tables.", "note"))
    return Section("Episodes", [*body, player(compared, focus, kinds, records)])
