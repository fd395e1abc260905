"""The episode player: what a page holds of each episode, exact between events, and the script that plays it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.envs.drawing.scene import BODY_M
from ethbrake_marl.evaluation.conditions import quantities, quantity_line
from ethbrake_marl.evaluation.motion import EpisodeMotion
from ethbrake_marl.pages.frame import Part, render, shown
from ethbrake_marl.pages.parts import data
from ethbrake_marl.physics import Worlds

_STYLES = ("player.css",)
_SCRIPTS = ("player-motion.js", "player-view.js", "player.js")
_BIN_S = 1e-3  # of the later impacts of a pair in so short a time the last one is drawn; all are counted


class Played(NamedTuple):
    """One world, driven by every agent."""

    number: int  # in the list
    kind: str  # why it was chosen, as a heading
    why: str  # what is special about it, in a few words
    motions: dict[str, EpisodeMotion]  # by agent
    passports: dict[str, str]  # by agent


def player(worlds: Sequence[Played], driven: Sequence[int], *, focus: str = "") -> Part:
    """The player of these worlds, all driven by the same agents.

    Args:
        worlds: at least one.
        driven: indices (0 = front) of the vehicles that the agents drive.
        focus: the agent that is shown from the beginning, between the first and the last.

    """
    first = worlds[0]
    motions = [motion for world in worlds for motion in world.motions.values()]
    vehicles = motions[0].world.N
    content = {
        "vehicles": vehicles,
        "driven": list(driven),
        "agents": [shown(agent) for agent in first.motions],
        "shown": _shown_first(list(first.motions), focus),
        "worlds": [_world(world) for world in worlds],
    }
    name = "episode_data"  # no section is called so
    html = render(
        "player.html.j2",
        name=name,
        vehicles=vehicles,
        body=BODY_M,
        shielded=any(len(motion.stepped_in_s) for motion in motions),
        episodes=data(name, content),
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
    obstacle = float(alert.obstacle_gap_m[0])
    return {
        "conditions": quantity_line(quantities(alert)),
        "obstacle": obstacle if np.isfinite(obstacle) else None,
        "episodes": list(episodes),
    }


def played_episode(motion: EpisodeMotion) -> dict[str, Any]:
    """What the player needs of one episode."""
    pieces = np.ascontiguousarray(motion.pieces, np.dtype("<f8"))
    return {
        "pieces": base64.b64encode(pieces.tobytes()).decode("ascii"),
        "end": motion.end_s,
        "impacts": _impacts(motion),
        "stepped": motion.stepped_in_s.tolist(),
    }


def _world(world: Played) -> dict[str, Any]:
    alert = next(iter(world.motions.values())).world
    passports = world.passports
    told = played_world(
        alert,
        [played_episode(motion) | {"passport": shown(passports[agent])} for agent, motion in world.motions.items()],
    )
    return told | {
        "number": world.number,
        "kind": shown(world.kind),
        "why": shown(world.why),
        "conditions": f"World {world.number}: {told['conditions']}.",
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
