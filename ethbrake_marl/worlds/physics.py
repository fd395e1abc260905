"""Kinds of physics other than exact impacts, chosen by the key ``physics`` of a scenario."""

from __future__ import annotations

from ethbrake_marl.episode.departures import departures_of
from ethbrake_marl.episode.game import Physics
from ethbrake_marl.registry import Registry


def register_physics(name: str, physics: Physics) -> None:
    """Entry points: ``ethbrake_marl.physics``."""
    PHYSICS.add(name, physics, lambda registered: registered is physics)


PHYSICS: Registry[Physics] = Registry("physics", "physics", register_physics)


def departures_by(physics: str | None) -> frozenset[str]:
    """As in ``episode.departures``."""
    return departures_of(None if physics is None else PHYSICS[physics])
