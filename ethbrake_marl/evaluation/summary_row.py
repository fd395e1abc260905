"""The results of one team over all worlds: a row of the table of results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ethbrake_marl.episode.layer import MODEL, STATE
from ethbrake_marl.errors import unknown_name
from ethbrake_marl.files.sheet import Estimate

SEES_THROUGH, EXPLOITS = "†", "‡"  # marks of teams
PUSHED_FAR_M = 5.0  # Vehicle 1 counts as pushed far above this distance; a mean above it is an exploit
OUTSIDE_SHARE = 0.1  # a policy drives elsewhere if a larger share of its decisions is outside its training's range
MOVING_SHARE = 0.05  # an exploit if a vehicle still moves at the horizon in a larger share of worlds


@dataclass(frozen=True)
class SummaryRow:
    """Results of one team. ``row["total_harm"]`` is the estimate with this key in JSON, or None if it is not defined.

    >>> import ethbrake_marl as eb
    >>> (row,) = eb.summarise(eb.evaluate("paper-random", "full_brake", episodes=3))
    >>> row.agent, row.knows, row.collisions, round(row["total_harm"].value, 2)
    ('full_brake', 'own sensors', 2, 36.99)

    """

    agent: str
    knows: str  # what the team has to know
    estimates: Mapping[str, Estimate | None]
    collisions: int  # number of worlds with an impact
    horizon_ends: int  # number of worlds in which a vehicle still moves at the horizon
    episodes: int  # number of worlds
    hidden_share: float  # share of worlds in which the V2X channel hides something from a controlled vehicle
    drivers: Mapping[str, str]  # vehicle -> name of its agent
    policies: Mapping[str, str]  # vehicle -> SHA-256 of its policy

    def __getitem__(self, key: str) -> Estimate | None:
        if key not in self.estimates:
            raise unknown_name("estimate", key, self.estimates)
        return self.estimates[key]

    @property
    def sees_through(self) -> bool:
        """Whether the team is omniscient: it reads values that the V2X channel hides in these worlds."""
        return self.hidden_share > 0.0 and any(word in self.knows for word in (STATE, MODEL))

    @property
    def outside(self) -> float:
        """Share of the decisions of the team's policies outside the range of their training; 0 if it is unknown."""
        share = self.estimates.get("outside")
        return 0.0 if share is None else share.value

    @property
    def is_outside(self) -> bool:
        return self.outside > OUTSIDE_SHARE

    @property
    def exploits(self) -> dict[str, str]:
        """Conduct of the team that harm does not count: name -> size in words.

        ``pushes``: the team pushes Vehicle 1 far. ``moving``: a vehicle often still moves at the horizon.
        """
        pushed, moving = self.estimates.get("pushed_m_1"), self.horizon_ends / self.episodes
        words = {}
        if pushed is not None and pushed.value > PUSHED_FAR_M:
            words["pushes"] = f"pushes Vehicle 1 by {pushed.value:.1f} m on average"
        if moving > MOVING_SHARE:
            words["moving"] = f"runs past the horizon in {100 * moving:.1f} % of worlds"
        return words

    @property
    def marked(self) -> str:
        """Name of the team, with ‡ if the team has ``exploits``."""
        return f"{self.agent} {EXPLOITS}" if self.exploits else self.agent

    @property
    def about(self) -> str:
        """What the team knows, with † if it is omniscient; and who drives which vehicle if its agents differ."""
        mixed = len({*self.drivers.values()}) > 1
        drivers = [f"{vehicle}: {agent}" for vehicle, agent in self.drivers.items() if mixed]
        return "; ".join([f"{SEES_THROUGH} " * self.sees_through + self.knows, *drivers])

    def to_json(self) -> dict[str, Any]:
        """Row as plain data: each estimate with interval, standard error and degrees of freedom; None if unknown."""
        plain: dict[str, Any] = {
            "agent": self.agent, "knows": self.knows, "sees_through_channel": self.sees_through,
            "hidden_share": self.hidden_share, "episodes": self.episodes, "collisions": self.collisions,
            "horizon_ends": self.horizon_ends, "exploits": list(self.exploits),
            "drivers": dict(self.drivers),
        }  # fmt: skip
        for key, estimate in self.estimates.items():
            plain |= Estimate.side_by_side({key: estimate})
            plain[f"{key}_error"] = None if estimate is None else estimate.error
            plain[f"{key}_freedom"] = None if estimate is None else estimate.freedom
        return plain | {"policy_sha256": dict(self.policies)}
