"""Shields over believed worlds: the bound where the world is a corner of what is open, and what they are without it."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents.registry import drive, make_agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import evaluate, summarise
from ethbrake_marl.physics import Floats
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.shield import ShieldedDriver, enclosure
from ethbrake_marl.shield.enclosure import Boxes, boxes_of
from ethbrake_marl.shield.step_shield import BelievedShield
from tests.shield.attacks import ABOVE, INSIDE, LISTS, NEVER_HEARD, WAYS, Hostile, shielded

BASE = load_scenario("cooperation-2-paper").replace(early_impacts="keep")
PERIODIC = BASE.replace(v2x={"preset": "blocked", "persistence": "periodic"})


def driven(agent: object, scenario: Scenario, n: int, seed: int = 7, vehicle: int = 1) -> tuple[Floats, Floats]:
    """Harm realised, and the first bound, [n] each."""
    episodes = drive(scenario.sample(n, seed).worlds, agent, scenario, vehicle)
    told = episodes.memories[vehicle] if episodes.guarded is None else episodes.guarded.told
    return episodes.ledger.world_harm("first"), told["predicted_harm"]


def behind(way: str, scenario: Scenario, robust: str | None = None) -> ShieldedDriver:
    """Who proposes so, behind a shield on what was received."""
    mode = {"mode": "step"} if robust is None else {"mode": "robust", "robust": robust}
    return ShieldedDriver(Hostile(way), scenario, believed=True, **mode)


@pytest.mark.parametrize("scenario", LISTS.values(), ids=list(LISTS))
@pytest.mark.parametrize("way", [pytest.param(way, marks=() if way == "drive" else pytest.mark.slow) for way in WAYS])
def test_robust__at_the_corners_no_world_is_above_the_first_bound(scenario: Scenario, way: str) -> None:
    harm, bound, replaced = shielded(way, scenario, 8, 7)
    assert (harm <= bound + ABOVE).all()
    assert replaced > 8


@pytest.mark.slow
@pytest.mark.parametrize(("name", "n"), [("never heard", 2), ("heard late", 12), ("sensors-only", 6)])
def test_interior__between_the_corners_no_world_is_above_the_first_bound(name: str, n: int) -> None:
    harm, bound, replaced = shielded("drive", INSIDE[name], n, 7, robust="interior")
    assert np.isfinite(bound).any() and (harm <= bound + ABOVE).all() and replaced > 0
    _, at_corners, _ = shielded("drive", INSIDE[name], n, 7)
    assert (bound >= at_corners - 1e-4).all()


@pytest.mark.slow
def test_interior__a_box_that_is_the_middle_alone_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def middle(*given: object) -> Boxes:
        boxes = boxes_of(*given)
        half = 0.5 * (boxes.low + boxes.high)
        return boxes._replace(low=half, high=half)

    monkeypatch.setattr(enclosure, "boxes_of", middle)
    monkeypatch.setattr(BelievedShield, "_corners", lambda self: [{}])
    harm, bound, _ = shielded("coast", INSIDE["never heard"], 12, 7, robust="interior")
    assert (harm > bound + 1.0).any()


def test_step__in_the_middle_promises_nothing_of_the_corners() -> None:
    harm, bound, _ = shielded("coast", NEVER_HEARD, 30, 7, robust=None)
    assert (harm > bound + 1.0).any()


@pytest.mark.parametrize("robust", [None, "corners", pytest.param("interior", marks=pytest.mark.slow)])
def test_believed__where_everything_is_known_the_bound_is_that_of_the_best_constant(robust: str | None) -> None:
    n = 40 if robust == "interior" else 20
    harm, bound = driven(behind("drive", BASE, robust), BASE, n)
    _, best = driven(make_agent("e_v2x_bm", scenario=BASE), BASE, n)
    if robust == "interior":  # an upper bound, which is not exact where impacts coincide
        assert (bound >= best - 1e-4).all() and np.isclose(bound, best, atol=1e-4).mean() > 0.9
    else:
        np.testing.assert_allclose(bound, best, atol=1e-4)
    assert (harm <= bound + 1e-6).all()


@pytest.mark.parametrize("spec", ["coast+step:believed", "coast+robust:believed", "ppo@shipped/ppo+episode:believed"])
def test_believed__no_world_depends_on_the_batch(spec: str) -> None:
    worlds = PERIODIC.sample(5, 3).worlds
    whole = drive(worlds, make_agent(spec, scenario=PERIODIC), PERIODIC, 1).final
    alone = drive(worlds.take([4]), make_agent(spec, scenario=PERIODIC), PERIODIC, 1).final
    np.testing.assert_allclose(whole.speeds_mps[4], alone.speeds_mps[0], atol=1e-6)


@pytest.mark.parametrize("vehicles", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_believed__shields_lines_of_other_lengths(vehicles: int) -> None:
    scenario = load_scenario("paper-random").replace(
        vehicles=vehicles, braking_capacity_mps2=6.0, driving_capacity_mps2=6.0, mass_t=5.0, latency_s=0.1,
        roles={"vehicle_2": "learner"}, v2x={"preset": "nominal", "persistence": "periodic"}, horizon_s=10.0,
    )  # fmt: skip
    for robust in (None, "corners"):
        harm, bound = driven(behind("coast", scenario, robust), scenario, 2)
        assert np.isfinite(bound).all() and np.isfinite(harm).all()


def test_believed__shields_beside_an_obstacle() -> None:
    scenario = load_scenario("cooperation-4-all").replace(
        early_impacts="keep", v2x=PERIODIC.v2x.model_dump(exclude_none=True)
    )
    scenario = scenario.with_learners(["vehicle_2"])
    harm, bound = driven(behind("coast", scenario), scenario, 10)
    assert np.isfinite(bound).all() and np.isfinite(harm).all()


def test_believed__asked_again_at_the_same_moment_says_the_same() -> None:
    worlds, proposed = PERIODIC.sample(5, 3).worlds, np.zeros(5)
    later = drive(worlds, make_agent("full_brake", scenario=PERIODIC), PERIODIC, 1).final
    shield = BelievedShield(PERIODIC, 1)
    shield.begin(worlds, np.arange(5))
    first = shield.decide(later, proposed)
    assert np.array_equal(first, shield.decide(later, proposed + 1.0))


def test_robust__too_many_open_numbers_are_refused() -> None:
    wide = load_scenario("paper-random").replace(
        vehicles=4, braking_capacity_mps2={"uniform": [3, 9]}, driving_capacity_mps2=3.0, mass_t={"uniform": [2, 9]},
        latency_s=0.1, v2x="nominal", roles={"vehicle_2": "learner"},
    )  # fmt: skip
    with pytest.raises(InvalidInput, match="scenario 'paper-random' leaves 14 numbers of the other vehicles open"):
        make_agent("coast+robust:believed", scenario=wide)


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("coast+step:pairwise:believed", "step:pairwise:believed"),
        ("coast+step:believed+robust", "then one shield"),
        ("e_v2x_bm:believed+episode:believed", "decides on what was received itself"),
    ],
)
def test_believed__what_cannot_be_is_refused(spec: str, words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        make_agent(spec, scenario=BASE)


@pytest.mark.parametrize("spec", ["coast+robust:interior:believed", "coast+step:believed", "e_v2x_bm:believed"])
@pytest.mark.parametrize("script", ["copy_leader", "e_v2x_bm"])
def test_believed__the_script_of_the_driven_vehicle_itself_does_not_count(spec: str, script: str) -> None:
    scripted = BASE.replace(roles={"vehicle_1": "full_brake", "vehicle_2": script, "vehicle_3": "full_brake"})
    worlds = scripted.sample(3, 1).worlds
    harms = [
        drive(worlds, make_agent(spec, scenario=scenario), scenario, 1).ledger.world_harm("total")
        for scenario in (BASE, scripted)
    ]
    np.testing.assert_array_equal(*harms)


def test_interior__what_it_cannot_certify_is_refused_when_the_agent_is_made() -> None:
    with pytest.raises(InvalidInput, match="robust interior: total harm"):
        make_agent("coast+robust:interior:believed", scenario=BASE, harm_count="total")
    with pytest.raises(InvalidInput, match="robust interior: an obstacle ahead"):
        make_agent("coast+robust:interior:believed", scenario=BASE.replace(obstacle_gap_m=60.0))


@pytest.mark.slow
def test_believed__bounds_nothing_where_its_vehicle_had_an_impact_before_the_first_decision() -> None:
    late = BASE.replace(latency_s=[0.0, 1.2, 0.5])
    for spec in ("coast+step:believed", "coast+robust:believed"):
        harm, bound = driven(make_agent(spec, scenario=late), late, 60)
        assert 0 < np.isinf(bound).sum() < 10 and (harm <= bound + ABOVE).all()
    agents = {spec: make_agent(spec, scenario=late) for spec in ("coast+step", "coast+robust:believed")}
    known, received = summarise(evaluate(late.sample(60, 7), agents, scenario=late))
    assert known["predicted_harm"] is not None and received["predicted_harm"] is None  # no mean of what is not finite
