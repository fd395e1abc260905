"""Speeds outside their range: how often vehicles roll backward or are above their limit when a decision is due.

``.venv/bin/python docs/studies/speeds.py`` prints the block of docs/paper-motion.md: the first 2,000 worlds of seed 7.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ethbrake_marl.agents.registry import drive
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.physics import Bools, Floats, Worlds
from ethbrake_marl.scenario import load_scenario

CASES = (
    ("paper-random", "full_brake"),
    ("paper-random", "ppo@shipped"),
    ("stress-wide", "full_brake"),
    ("stress-wide", "universal@shipped"),
)
WORLDS, SEED = 2_000, 7


@dataclass
class Speeds:
    """Watches the speeds of running worlds at every decision."""

    backward: Bools
    above: Bools
    extremes: list[float] = field(default_factory=lambda: [0.0, 0.0])

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """One step of the batch; the first one begins at the alert, where nothing is decided."""
        running = (until_s > before.time_s) & (before.time_s > 0.0)
        excess = before.speeds_mps - before.vehicles.speed_limit_mps
        for found, values in ((self.backward, -before.speeds_mps), (self.above, excess)):
            found |= running & (values > 1e-9).any(axis=1)
        if running.any():
            self.extremes[0] = min(self.extremes[0], float(before.speeds_mps[running].min()))
            self.extremes[1] = max(self.extremes[1], float(excess[running].max()))


def line(name: str, spec: str) -> str:
    """One line of the block."""
    scenario = load_scenario(name)
    worlds = scenario.sample(WORLDS, SEED).worlds
    (agent,) = make_lineup([spec], scenario).values()
    seen = Speeds(np.zeros(worlds.n, bool), np.zeros(worlds.n, bool))
    drive(worlds, agent, scenario, scenario.learners[0], watched_by=[seen])
    back, above = 100 * seen.backward.mean(), 100 * seen.above.mean()
    least, most = seen.extremes
    return (
        f"{name:12} {spec:17} backward in {back:.1f}% (to {least:.2f} m/s),"
        f" above the limit in {above:.1f}% (by up to {most:.2f} m/s)"
    )


if __name__ == "__main__":
    print("\n".join(line(*case) for case in CASES))
