"""Who knows what, and when.

A message carries its sender's state, capacities and latency. Vehicle i has the messages of its whole line from the
moment its own latency has elapsed (the paper: the latency covers transmission, processing and actuation); before it,
it knows only itself.
"""

from __future__ import annotations

from ethbrake_marl.physics.compiled import compiled


@compiled
def knows(time_s: float, own_latency_s: float) -> bool:
    """Whether a vehicle with this latency has the news of the other vehicles at this time."""
    return time_s >= own_latency_s
