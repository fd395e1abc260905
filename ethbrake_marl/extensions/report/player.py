"""Data of the episode player: the motion of each episode, from which the player computes exact positions."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ethbrake_marl.first_edition.agents.protocol import Driver
from ethbrake_marl.first_edition.evaluation.motion import EpisodeMotion, follow_episodes
from ethbrake_marl.first_edition.physics.state import Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario

PLAYER_SCRIPTS = ("player-motion.js", "player-view.js", "player.js")

DATA = "episode_data"  # id of the data in a page; no section has it

_BIN_S = 1e-3  # s; if a pair has several impacts within this time, only the last one is drawn, but all are counted


@dataclass(frozen=True, slots=True)
class Played:
    """One world of the episode player, with the motion of the vehicles under every agent."""

    number: int  # number of the world in its list
    kind: str  # heading of the group of worlds, which says why the world is shown
    why: str  # special property of the world, in a few words
    motions: dict[str, EpisodeMotion] = field(default_factory=dict)  # motion of the vehicles, by name of the agent
    title: str = ""  # title of the world; empty: "World" and its number

    @staticmethod
    def drive(played: Sequence[Played], worlds: Worlds, name: str, agent: Driver, scenario: Scenario) -> None:
        """Let one agent drive the worlds (at the alert), and store the motion in each world as ``motions[name]``.

        ``played`` has one object for each world. The agent is not changed. The scenario's learners are the controlled
        vehicles.
        """
        for one, motion in zip(played, follow_episodes(worlds, agent, scenario), strict=True):
            one.motions[name] = motion

    @staticmethod
    def episode(motion: EpisodeMotion, driven: Sequence[int]) -> dict[str, Any]:
        """Return the data of one episode for the script of the player.

        ``driven`` are the indices of the controlled vehicles.
        """
        obstacle = float(motion.world.obstacle_gap_m[0])
        without = 1 + 3 * motion.world.N
        jerks = bool(motion.pieces[:, without:].any())
        pieces = np.ascontiguousarray(motion.pieces if jerks else motion.pieces[:, :without], np.dtype("<f8"))
        return {
            **({"jerks": True} if jerks else {}),
            "pieces": base64.b64encode(pieces.tobytes()).decode("ascii"),
            "end": motion.end_s,
            "impacts": _impacts(motion),
            "stepped": motion.stepped_in_s.tolist(),
            "driven": list(driven),
            "rest": motion.at_rest,
            "obstacle": obstacle if np.isfinite(obstacle) else None,
        }


def _impacts(motion: EpisodeMotion) -> list[list[float]]:
    """Return a list of seven numbers for each impact of an episode, earlier impacts first.

    The numbers are the time (s), the index of the pair, the closing speed (m/s), 1 for the first impact of the pair and
    0 for a later impact, the number of the impact in the episode (from 1), the first-impact harm so far, and the total
    harm so far (m2/s2). If a pair has several later impacts within the same 1 ms (``_BIN_S``), only the last is
    returned. The two harms so far at the last impact equal the recorded harms of the episode exactly.
    """
    rows = motion.impacts
    order = np.argsort(rows.time_s, kind="stable")
    harm = rows.closing_speed_mps[order] ** 2
    first, total = np.cumsum(harm * rows.first[order]), np.cumsum(harm)
    if len(harm):
        first[np.flatnonzero(rows.first[order])[-1] :], total[-1] = motion.harm
    by_key: dict[tuple[int, int, bool], list[float]] = {}
    for number, k in enumerate(order.tolist()):
        time, pair, is_first = float(rows.time_s[k]), int(rows.pair[k]), bool(rows.first[k])
        entry = [time, pair, float(rows.closing_speed_mps[k]), int(is_first), number + 1]
        by_key[pair, int(time / _BIN_S), is_first] = [*entry, float(first[number]), float(total[number])]
    return sorted(by_key.values(), key=lambda entry: (entry[0], entry[4]))
