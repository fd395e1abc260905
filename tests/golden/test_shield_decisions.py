"""Every decision of the single shield, to the last bit: joint plans for several vehicles must not change it."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.shield import StepShield, parse_uncertainty
from tests.shield.attacks import line

GOLDEN = {
    "paper": "e588aa78dd473755",
    "five vehicles": "ce8815bf25435b2b",
    "robust": "8845d4c2238eac5c",
    "obstacle": "e97447f43f026090",
}
SHIELDS = {
    "paper": lambda: (StepShield(load_scenario("paper-random"), 1), 60),
    "five vehicles": lambda: (StepShield(line(5), 2, harm_count="total"), 40),
    "robust": lambda: (StepShield(load_scenario("paper-random"), 1, uncertainty=parse_uncertainty("gaps_m=0.5")), 10),
    "obstacle": lambda: (StepShield(load_scenario("paper-random-obstacle"), 1, harm_count="total"), 40),
}


def decisions_hash(shield: StepShield, worlds: int) -> str:
    """A hash of all that is decided about random proposals, some of them beyond the range or no number."""
    shield.begin(shield.scenario.sample(worlds, 3).worlds, np.arange(worlds))
    rng, digest = np.random.default_rng(0), hashlib.sha256(shield.first_bound.tobytes())
    while not shield.running.finished.all():
        proposed = np.where(rng.random(worlds) < 0.05, np.nan, rng.uniform(-1.2, 1.2, worlds))
        decision = shield.decide(proposed)
        for column in (decision.applied, decision.reason, decision.bound, decision.margin, decision.intervened):
            digest.update(np.ascontiguousarray(column).tobytes())
        digest.update(decision.after.states.tobytes())
    return digest.hexdigest()[:16]


@pytest.mark.parametrize("name", SHIELDS)
def test_decisions__have_the_committed_bits(name):
    assert decisions_hash(*SHIELDS[name]()) == GOLDEN[name]
