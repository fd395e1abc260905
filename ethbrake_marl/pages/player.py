"""The episode player: what a page holds of each episode, exact between events, and the script that plays it."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.envs.drawing.scene import BODY_M
from ethbrake_marl.evaluation.episodes import EpisodeMotion
from ethbrake_marl.evaluation.outcome import quantities, quantity_line
from ethbrake_marl.pages.frame import Part, data, render, shown
from ethbrake_marl.physics import Worlds

_STYLES = ("player.css",)
_SCRIPTS = ("player-motion.js", "player-view.js", "player.js")
DATA = "episode_data"  # the name of its data in a page, which no section has
_BIN_S = 1e-3  # of the later impacts of a pair in so short a time the last one is drawn; all are counted


class Played(NamedTuple):
    """One world, driven by every agent."""

    number: int  # in the list
    kind: str  # why it was chosen, as a heading
    why: str  # what is special about it, in a few words
    motions: dict[str, EpisodeMotion]  # by agent
    passports: dict[str, str]  # by agent
    title: str = ""  # what the world is called; empty: World and its number


def player(worlds: Sequence[Played], driven: Sequence[int] | Mapping[str, Sequence[int]], *, focus: str = "") -> Part:
    """The player of these worlds, all driven by the same agents.

    Args:
        worlds: at least one.
        driven: indices (0 = front) of the vehicles that the agents drive; by agent where they drive others.
        focus: the agent that is shown from the beginning, between the first and the last.

    """
    return player_of(player_content(worlds, driven, focus=focus))


def player_content(
    worlds: Sequence[Played], driven: Sequence[int] | Mapping[str, Sequence[int]], *, focus: str = ""
) -> dict[str, Any]:
    """What the player of these worlds holds, as plain data for ``player_of``; the arguments are those of ``player``."""
    agents = list(worlds[0].motions)
    by_agent = driven if isinstance(driven, Mapping) else dict.fromkeys(agents, driven)
    return {
        "vehicles": worlds[0].motions[agents[0]].world.N,
        "agents": [shown(agent) for agent in agents],
        "shown": _shown_first(agents, focus),
        "worlds": [_world(world, by_agent) for world in worlds],
    }


def player_of(content: Mapping[str, Any]) -> Part:
    """The player of what ``player_content`` gave."""
    html = render(
        "player.html.j2",
        name=DATA,
        vehicles=content["vehicles"],
        body=BODY_M,
        shielded=any(episode["stepped"] for world in content["worlds"] for episode in world["episodes"]),
        episodes=data(DATA, content),
    )
    return Part(html, _STYLES, _SCRIPTS)


def _shown_first(agents: Sequence[str], focus: str) -> list[int]:
    """Up to three agents: the first, the focus, and as many of the last as there is room for."""
    middle = [agents.index(focus)] if focus in agents else []
    order = dict.fromkeys([*middle, 0, *reversed(range(len(agents)))])
    return sorted(list(order)[:3])


def live_player(vehicles: int, *, shielded: bool) -> Part:
    """A player without episodes, for a page whose own script gives it one world after another."""
    html = render("player.html.j2", name=None, vehicles=vehicles, body=BODY_M, shielded=shielded, episodes="")
    return Part(html, _STYLES, _SCRIPTS)


def played_world(alert: Worlds, episodes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What the player needs of one world (n = 1, at the alert) and its episodes."""
    return {"conditions": quantity_line(quantities(alert)), "episodes": list(episodes)}


def played_episode(motion: EpisodeMotion, driven: Sequence[int]) -> dict[str, Any]:
    """What the player needs of one episode, in which an agent drove these vehicles."""
    obstacle = float(motion.world.obstacle_gap_m[0])
    pieces = np.ascontiguousarray(motion.pieces, np.dtype("<f8"))
    return {
        "pieces": base64.b64encode(pieces.tobytes()).decode("ascii"),
        "end": motion.end_s,
        "impacts": _impacts(motion),
        "stepped": motion.stepped_in_s.tolist(),
        "driven": list(driven),
        "rest": motion.at_rest,
        "obstacle": obstacle if np.isfinite(obstacle) else None,
    }


def _world(world: Played, driven: Mapping[str, Sequence[int]]) -> dict[str, Any]:
    alert = next(iter(world.motions.values())).world
    title = shown(world.title or f"World {world.number}")
    episodes = [
        played_episode(motion, driven[agent]) | {"passport": shown(world.passports[agent])}
        for agent, motion in world.motions.items()
    ]
    told = played_world(alert, episodes)
    return told | {
        "number": world.number,
        "title": title,
        "kind": shown(world.kind),
        "why": shown(world.why),
        "conditions": f"{title}: {told['conditions']}.",
    }


def _impacts(motion: EpisodeMotion) -> list[list[float]]:
    """Each impact with what has been counted by then; at the last one, that is the ledger to the bit."""
    rows = motion.impacts
    order = np.argsort(rows.time_s, kind="stable")
    harm = rows.closing_speed_mps[order] ** 2
    first, total = np.cumsum(harm * rows.first[order]), np.cumsum(harm)
    if len(harm):
        first[np.flatnonzero(rows.first[order])[-1] :], total[-1] = motion.harm
    told: dict[tuple[int, int, bool], list[float]] = {}
    for number, k in enumerate(order.tolist()):
        time, pair, is_first = float(rows.time_s[k]), int(rows.pair[k]), bool(rows.first[k])
        entry = [time, pair, float(rows.closing_speed_mps[k]), int(is_first), number + 1]
        told[pair, int(time / _BIN_S), is_first] = [*entry, float(first[number]), float(total[number])]
    return sorted(told.values(), key=lambda entry: (entry[0], entry[4]))
