"""The page's section of episodes to watch: worst, avoidable, typical and random worlds."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ethbrake_marl.episode.counts import COLUMN, HARM
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.compared import Compared
from ethbrake_marl.evaluation.record import record_episodes
from ethbrake_marl.evaluation.summary import BASELINE
from ethbrake_marl.extensions.report.best_known import BestKnown
from ethbrake_marl.extensions.report.page import Section, part
from ethbrake_marl.extensions.report.player import SAMPLE_S, player
from ethbrake_marl.motion.layout import Bools, Floats, Ints
from ethbrake_marl.names import open_game

MOST_WORLDS = 50
WORST = 10
EACH = 5  # worlds of every kind except the worst and the random ones
TYPICAL = (0.5, 0.6, 0.7, 0.8, 0.9)  # quantiles of the harm


def shown_worlds(compared: Compared, focus: str) -> dict[int, str]:
    """Choose at most ``MOST_WORLDS`` worlds in which to show the agent ``focus``; return row -> why it is shown."""
    result, column = compared.result, COLUMN[compared.harm_count]
    cost, known, chosen = result[focus][column], BestKnown.of(result), dict[int, str]()

    def add(kind: str, rows: Iterable[int] | Ints, most: int = EACH) -> None:
        fresh = [int(row) for row in rows if int(row) not in chosen]
        chosen.update(dict.fromkeys(fresh[: min(most, MOST_WORLDS - len(chosen))], kind))

    add(f"Where {focus} did worst", worst_rows(compared, focus), WORST)
    if known is not None and known.avoidable is not None:
        avoidable = result[focus]["collided"] & known.avoidable
        add(f"Avoidable, and {focus} collided", largest(cost, avoidable))
    if BASELINE in result.columns and focus != BASELINE:
        saved = result[BASELINE][column] - cost
        add(f"Where {focus} saved most against {BASELINE}", largest(saved, saved > 0.0))
        add(f"Where {focus} did worse than {BASELINE}", largest(-saved, saved < 0.0))
    order = np.argsort(cost, kind="stable")
    add(f"Typical of {focus}", [order[int(q * (result.n - 1))] for q in TYPICAL])
    add("Drawn at random", np.random.default_rng(0).permutation(result.n), MOST_WORLDS)
    return chosen


def worst_rows(compared: Compared, focus: str) -> Ints:
    """Return at most ten rows in which ``focus`` did worst, by what agents minimise, minus the best known if any."""
    result, count, known = compared.result, compared.harm_count, BestKnown.of(compared.result)
    best = 0.0 if known is None else known.harm.get(count, 0.0)
    value = result[focus][COLUMN[count]] - best
    return largest(value, value > 0.0)[:WORST]


def largest(value: Floats, among: Bools) -> Ints:
    order: Ints = np.argsort(-value, kind="stable")
    return order[among[order]]


def episodes_section(compared: Compared, focus: str, kinds: dict[int, str]) -> Section:
    """Let every team drive the worlds ``kinds`` (row -> why it is shown) again, and return a player of these episodes.

    ``focus``: the agent that the page is about. A note names each agent that drove differently in these episodes than
    in the evaluation.
    """
    rows, worlds, (_, game) = [*kinds], compared.worlds(kinds), open_game(compared.scenario)
    records = {agent: record_episodes(worlds, team, game, SAMPLE_S) for agent, team in compared.teams.items()}
    moving = sum(not all(record.at_rest for record in world) for world in zip(*records.values(), strict=True))
    until = "from the alert until all vehicles are at rest"
    if moving:
        until += (
            f", or until the horizon of {compared.scenario.horizon_s:g} s. In {count_of(moving, 'world')}, vehicles"
            " still moved at the horizon under some agent; the player names this agent"
        )
    n = compared.result.n
    body: list[str] = [f"{f'{len(rows)} of the {n:,}' if len(rows) < n else f'All {n}'} worlds, {until}."]
    for agent, own in records.items():
        again = np.array([[record.last.harm(count)[0] for count in HARM] for record in own])
        before = np.column_stack([compared.result[agent][harm][rows] for harm in HARM.values()])
        if other := int((again != before).any(axis=1).sum()):
            text = f"In {count_of(other, 'world')} of these, {agent} drove differently the second time: the player"
            body.append(part("paragraph", f"{text} shows another episode than the tables.", "note"))
    return Section("Episodes", [*body, player(compared, focus, kinds, records)])
