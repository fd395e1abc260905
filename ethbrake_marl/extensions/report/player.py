"""The episode player: what a page holds of each episode, exact between events, and the script that plays it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ethbrake_marl.agents.protocol import Driver
from ethbrake_marl.evaluation.motion import EpisodeMotion, follow_episodes
from ethbrake_marl.physics.state import Worlds
from ethbrake_marl.scenario.schema import Scenario

PLAYER_SCRIPTS = ("player-motion.js", "player-view.js", "player.js")

DATA = "episode_data"  # the name of its data in a page, which no section has

_BIN_S = 1e-3  # of the later impacts of a pair in so short a time the last one is drawn; all are counted


@dataclass(frozen=True, slots=True)
class Played:
    """One world, driven by every agent."""

    number: int  # in the list
    kind: str  # why it was chosen, as a heading
    why: str  # what is special about it, in a few words
    motions: dict[str, EpisodeMotion] = field(default_factory=dict)  # by agent
    title: str = ""  # what the world is called; empty: World and its number

    @staticmethod
    def drive(played: Sequence[Played], worlds: Worlds, name: str, agent: Driver, scenario: Scenario) -> None:
        """Let one agent drive the worlds of ``played`` and keep each motion there, by the agent's name.

        Args:
            played: one for each world.
            worlds: at the alert, in the same order.
            name: of the agent on the page.
            agent: is left as it is.
            scenario: of the worlds, with the vehicles that are driven as its learners.

        """
        for one, motion in zip(played, follow_episodes(worlds, agent, scenario), strict=True):
            one.motions[name] = motion

    @staticmethod
    def episode(motion: EpisodeMotion, driven: Sequence[int]) -> dict[str, Any]:
        """What the player needs of one episode, in which an agent drove these vehicles."""
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
