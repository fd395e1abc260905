"""Worlds in which a vehicle does not know the others, and drivers behind a shield that certifies what it received.

Every quantity of another vehicle that is open is one of two numbers, so each world of the lists is a member of what
is certified at its first decision. None of the numbers are round: in a world of equal gaps and equal speeds two
impacts fall on one moment, and the last bit decides which of them is first.
"""

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from tests.first_edition.shield.attacks import Hostile

WAYS = ("coast", "drive", "chance")
ABOVE = 1e-6  # m2/s2; what is told is moved on with rounding

_BASE = eb.load_scenario("cooperation-2-paper").replace(early_impacts="keep")
NEVER_HEARD = _BASE.replace(
    gaps_m=[{"choice": [5.13, 9.71]}, {"choice": [5.37, 9.58]}],
    speeds_mps=[{"choice": [18.23, 21.87]}, {"choice": [18.11, 21.93]}, {"choice": [18.41, 22.19]}],
    v2x={"preset": "paper", "hears": "front"},
    mass_t=[4.5, 5.5, {"choice": [3.0, 9.0]}],
)
HEARD_LATE = NEVER_HEARD.replace(  # a while after the first decision, by messages 0.6 to 0.9 s old
    v2x={"preset": "paper", "link_latency_s": 0.6, "persistence": "periodic", "senses": "front", "sensing_s": [3, 3]},
    latency_s=[0.0, 0.2, 0.6],
)
LISTS = {"never heard": NEVER_HEARD, "heard late": HEARD_LATE}


def shielded(way: str, scenario: eb.Scenario, n: int, seed: int, *, robust: bool = True) -> tuple[Floats, Floats, int]:
    """Harm realised and first bound of ``n`` worlds [n] m2/s2, and how many proposals were replaced."""
    mode = "robust" if robust else "step"
    driver = ShieldedDriver(Hostile(way, seed), scenario, estimated=True, mode=mode)
    episodes = drive(scenario.sample(n, seed).worlds, driver, scenario, 1)
    shield = episodes.guarded.shield
    return episodes.ledger.world_harm("first"), shield.predicted_harm, int(shield.interventions.sum())
