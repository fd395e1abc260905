"""The evidence on shields: what interventions were good for."""

import numpy as np
import pytest

from ethbrake_marl.extensions.certified.uncertainty import parse_uncertainty
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from ethbrake_marl.first_edition.shields.evidence import review
from tests.first_edition.shield.test_step_shield import wavering

SCENARIO = load_scenario("paper-random")
WORLDS = SCENARIO.sample(60, 3).worlds


def logged(policy, worlds=WORLDS, driver=None, **settings):
    """The episodes of a driver that keeps a log."""
    driver = driver or ShieldedDriver(policy, SCENARIO, logging=True, **settings)
    return drive(worlds, driver, SCENARIO, 1)


def test_log__holds_every_intervention_and_forensics_says_what_it_was_good_for():
    shield = logged(make_agent("coast")).guarded.shield
    log = shield.log
    assert len(log) == shield.interventions.sum() > 0
    assert all(entry.margin < 0.0 and entry.proposed == 0.0 != entry.applied for entry in log)
    found = review(shield, make_agent("coast"), WORLDS)
    shares = [found.share(kind) for kind in ("needed", "harmless", "costly")]
    assert found.unshielded_harm.shape == (len(log),) and shares[0] > 0.8 and sum(shares) == pytest.approx(1.0)
    first = {entry.world: k for k, entry in reversed(list(enumerate(log)))}  # each world's first intervention
    alone = drive(WORLDS, make_agent("coast"), SCENARIO, 1).ledger.world_harm("first")
    assert all(found.unshielded_harm[k] == alone[world] for world, k in first.items())


@pytest.mark.parametrize("mode", ["distrusted", "robust"])
def test_review__tells_the_harm_of_the_engine_also_where_the_bound_is_not_it(mode):
    worlds = WORLDS.take(np.arange(40))
    other = parse_uncertainty("braking_capacity_mps2=20%").draw(worlds, np.random.default_rng(0))
    settings = {"assumed": other} if mode == "distrusted" else {"uncertainty": "gaps_m=0.5"}
    episodes = logged(wavering, worlds, **settings)
    harm, shield = episodes.ledger.world_harm("first"), episodes.guarded.shield
    assert abs(shield.bound - harm).max() > 1.0
    found = review(shield, wavering, worlds)
    assert found.harm.tolist() == harm[found.world].tolist()
    assert found.trusted.tolist() == (~shield.memory.distrusted[found.world]).tolist()
    assert found.trusted.all() == (mode == "robust")


def test_review__is_of_the_last_batch_and_of_its_worlds_alone():
    smaller, driver = WORLDS.take(np.arange(30, 50)), ShieldedDriver(wavering, SCENARIO, logging=True)
    logged(None, driver=driver)
    again, fresh = logged(None, smaller, driver), logged(wavering, smaller)
    found = [review(episodes.guarded.shield, wavering, smaller) for episodes in (again, fresh)]
    assert all(told.tolist() == expected.tolist() for told, expected in zip(*found, strict=True))
