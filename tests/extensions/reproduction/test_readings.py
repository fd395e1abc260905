"""Readings of the paper: the worlds that they change, and what strategies do there."""

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.pairwise import harm_of_deceleration, pairwise
from ethbrake_marl.extensions.proofs.avoidability import avoidability
from ethbrake_marl.extensions.proofs.lower_bound import lower_bound
from ethbrake_marl.extensions.reproduction.readings import OURS, RANDOM, STATED, Reading
from ethbrake_marl.extensions.reproduction.strategies import (
    COUPLED,
    E_V2X_BM,
    NON_E,
    PREDICTED,
    algorithm_1,
    contact_unavoidable,
    drive,
    impact_unavoidable,
    open_reading,
    proven_least_harm,
    strategies,
)
from ethbrake_marl.extensions.reproduction.tables import ends_of_star
from ethbrake_marl.motion.layout import BRAKING, LATENCY

WORLDS = 100
SHIPPED = {"PPO": "ppo", "SAC": "sac"}

# collisions, first-impact harm, total harm, predicted harm in the first 100 worlds, by version 0.5
GOLDEN = {
    STATED: {
        NON_E: (80, 21.01116356815893, 22.464131799726196, None),
        E_V2X_BM: (60, 17.195162763975528, 18.491602802513473, 8.559600828714368),
        COUPLED: (60, 13.67244358932681, 14.448446979076754, None),
        "SAC": (60, 6.222264735090079, 6.512750651973412, None),
        "Hybrid PPO": (60, 6.9340617463633585, 7.164829747133655, 6.055780908806861),
    },
    Reading(acts_s=0.2): {
        NON_E: (96, 31.74147533004871, 32.511432448520004, None),
        "Hybrid PPO": (49, 3.463970974223885, 3.683772674937231, 3.3204208348440165),
    },
    Reading("paper-distance"): {E_V2X_BM: (68, 12.61114288160522, 13.102561622377982, 3.3187025173271767)},
    Reading(step_s=0.25): {NON_E: (96, 34.530865, None, None), E_V2X_BM: (91, 28.875307, None, 8.559600828714368)},
}


@pytest.mark.parametrize("reading", GOLDEN, ids=str)
def test_strategies__have_the_numbers_of_version_0_5(reading: Reading) -> None:
    found = strategies(reading, WORLDS, SHIPPED)
    assert next(iter(found)) == OURS and (len(found) == 1) == (reading.step_s is not None)
    for name, (collisions, first, total, predicted) in GOLDEN[reading].items():
        own = found[OURS][name]
        close = {"rel": 5e-4} if name == COUPLED else {"rel": 1e-7}  # the search for its deceleration is another
        assert own["collided"].sum() == collisions
        assert own["first"].mean() == pytest.approx(first, **close)
        assert total is None or own["total"].mean() == pytest.approx(total, **close)
        assert (PREDICTED in own) == (predicted is not None)
        assert predicted is None or own[PREDICTED].mean() == pytest.approx(predicted, **close)


def test_bounds__hold_for_every_strategy_and_search() -> None:
    """No impact is avoided where one is proven; contact, proven in more worlds, may be without an impact."""
    found, impact = strategies(STATED, WORLDS, SHIPPED), impact_unavoidable(STATED, WORLDS)
    contact, least = contact_unavoidable(STATED, WORLDS), proven_least_harm(STATED, WORLDS)
    found[OURS] |= {spec: drive(STATED, spec, WORLDS) for spec in ("plan", "best_harm")}
    for reading, outcomes in found.items():
        assert all((outcome["collided"] | ~impact).all() for outcome in outcomes.values())
        assert reading != OURS or all((least <= outcome["first"] + 1e-9).all() for outcome in outcomes.values())
    assert contact.sum() == 60 and (contact | ~impact).all() and least.mean() > 0.0


def test_contact_that_is_certain__may_be_without_an_impact() -> None:
    """In world 261 a search lets Vehicle 2 touch Vehicle 1 and press: contact, but no collision."""
    scenario, _, alert = open_reading(STATED, 262)
    world = alert.take([261])
    bound = lower_bound(world, harm_count="first", horizon_s=scenario.horizon_s, time_step_s=scenario.time_step_s)
    assert not avoidability(world, 2).avoidable[0] and not bound.impact_proven[0]
    measured = eb.evaluate(world, "best_harm", scenario=scenario, harm_count="first", measures="pushed_mps")
    searched = measured["best_harm"]
    assert not searched["collided"][0] and searched["impacts"][0] == 0 and searched["pushed_mps_1"][0] > 10.0


@pytest.mark.parametrize("reading", [STATED._replace(step_s=0.2), STATED], ids=str)
def test_baselines_and_hybrid__are_what_the_agents_do(reading: Reading) -> None:
    agents = "full_brake,e_v2x_bm:pairwise,ppo+episode:pairwise"
    if reading.step_s is not None:
        agents = "full_brake,e_v2x_bm:pairwise"
    result = eb.evaluate(reading.scenario(), agents, episodes=WORLDS, harm_count="first")
    found = strategies(reading, WORLDS, {"PPO": "ppo"})[OURS]
    for row, name in zip((NON_E, E_V2X_BM, "Hybrid PPO"), result, strict=False):
        assert np.array_equal(found[row]["first"], result[name]["first_impact_harm"])
        assert np.array_equal(found[row]["collided"], result[name]["collided"])
    assert np.array_equal(found[E_V2X_BM][PREDICTED], result["e_v2x_bm:pairwise"]["predicted_harm"])


def test_algorithm_1__by_hand() -> None:
    policy = {"collided": np.array([True, True, False]), "first": np.array([2.0, 3.0, 0.0])}
    baseline = {"collided": np.array([False, True, True]), "first": np.array([9.0, 8.0, 7.0])}
    hybrid = algorithm_1(policy, baseline, np.array([2.0, 2.9, 0.0]))
    assert hybrid["first"].tolist() == [2.0, 8.0, 0.0] and hybrid["collided"].tolist() == [True, True, False]


def test_ends_of_a_star__do_equally_little_harm_and_nothing_beyond_them_does() -> None:
    alert = eb.load_scenario(RANDOM).sample(WORLDS, 7)
    (low, high), chosen = ends_of_star(WORLDS), pairwise(alert, 2)
    assert (low <= chosen.deceleration_mps2 + 1e-9).all() and (chosen.deceleration_mps2 <= high + 1e-9).all()
    assert np.array_equal(low == high, chosen.harm > 0.0)
    for k in np.flatnonzero(chosen.harm == 0.0):
        car = alert.car[k].copy()

        def at(deceleration: float, k: int = k, car: np.ndarray = car) -> float:
            return harm_of_deceleration(alert.line[k], car[BRAKING], car[LATENCY], 2, deceleration)

        assert max(at(low[k]), at(high[k])) < 1e-9
        assert at(low[k] - 1e-3) > 0.0 and (high[k] == 7.0 or at(high[k] + 1e-3) > 0.0)


def test_scenario__has_what_the_reading_says() -> None:
    scenario = Reading("paper-delay-low", 0.25, 0.5, (("horizon_s", 5.0), ("gaps_m", (7, 7)))).scenario()
    assert scenario.latency_s == (0.0, 0.25, 0.3) and (scenario.physics, scenario.time_step_s) == ("paper-map", 0.5)
    assert (scenario.horizon_s, scenario.gaps_m) == (5.0, (7.0, 7.0))
    assert Reading("paper-delay-low").scenario().latency_s == (0.0, 0.1, 0.3)
