"""Who knows what, and when.

A message carries its sender's state, capacities and latency. Vehicle i has the messages of its whole line from the
moment its own latency has elapsed (the paper: the latency covers transmission, processing and actuation); before it,
it knows only itself.
"""

from __future__ import annotations

from ethbrake_marl.physics import Bools, Worlds


def informed(worlds: Worlds, vehicle: int) -> Bools:
    """Whether ``vehicle`` has received the news of the other vehicles, [n]."""
    known: Bools = worlds.time_s >= worlds.vehicles.latency_s[:, vehicle]
    return known
