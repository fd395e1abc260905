"""Worlds that are drawn, derived or given, by every key.

By hand: ``test_given_worlds``, ``test_roads``; refusals: ``test_refusals``, ``test_refused_worlds``.
"""

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy import stats

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.evaluation.identity import worlds_sha256
from ethbrake_marl.first_edition.physics.state import Vehicles
from ethbrake_marl.first_edition.scenario.channel import PRESETS
from ethbrake_marl.first_edition.scenario.distributions import Choice, LogUniform, Normal, Uniform, support, values
from ethbrake_marl.first_edition.scenario.fields import BLOCK, QUANTITY

near = pytest.approx
PAPER = eb.load_scenario("paper-random")
ALMOST_ONE = 1.0 - 2.0**-53

# ---------------------------------------------------------------- distributions


def normal(mean: float, sd: float, low: float, high: float) -> Normal:
    return Normal.model_validate({"normal": {"mean": mean, "sd": sd, "low": low, "high": high}})


@pytest.mark.parametrize(
    ("quantity", "u", "drawn", "bounds"),
    [
        (3.5, [0.0, 0.3, 0.9], [3.5, 3.5, 3.5], (3.5, 3.5)),
        (Uniform(uniform=(5.0, 10.0)), [0.0, 0.2, 0.5], [5.0, 6.0, 7.5], (5.0, 10.0)),
        (LogUniform(loguniform=(1.0, 16.0)), [0.0, 0.25, 0.5], near([1.0, 2.0, 4.0], rel=1e-15), (1.0, 16.0)),
        (normal(20.0, 1.0, 18.0, 22.0), [0.5], [20.0], (18.0, 22.0)),
        (Choice(choice=(6, 8, 7)), [0.0, 0.33, 0.34, 0.66, 0.67, ALMOST_ONE], [6, 6, 8, 8, 7, 7], (6.0, 8.0)),
        (
            Choice(choice=(1, 2, 3), weights=(1, 2, 1)),
            [0.0, 0.249, 0.25, 0.749, 0.75, ALMOST_ONE],
            [1, 1, 2, 2, 3, 3],
            (1.0, 3.0),
        ),
    ],
    ids=lambda value: type(value).__name__,
)  # fmt: skip
def test_distribution__by_hand(quantity: Any, u: list[float], drawn: Any, bounds: tuple[float, float]) -> None:
    assert values(quantity, np.array(u)).tolist() == drawn and support(quantity) == bounds


@given(st.floats(0, 1e4), st.floats(0, 1e4), st.lists(st.floats(1e-6, 1e6), min_size=1, max_size=9))
def test_distribution__is_never_outside_its_bounds(a: float, b: float, weights: list[float]) -> None:
    low, high = sorted((a, b))
    drawn = Uniform(uniform=(low, high)).value(np.array([0.0, 0.1, 0.7, ALMOST_ONE]))
    assert ((drawn >= low) & (drawn <= high)).all()
    logarithmic = LogUniform(loguniform=(low + 0.2, high + 0.2)).value(np.array([0.0, 0.4, ALMOST_ONE]))
    assert ((logarithmic >= low + 0.2) & (logarithmic <= high + 0.2)).all()
    last = Choice(choice=tuple(float(k) for k in range(len(weights))), weights=tuple(weights))
    assert last.value(np.array([ALMOST_ONE]))[0] == len(weights) - 1


@pytest.mark.parametrize("shape", [(20.0, 1.0, 18.0, 22.0), (0.97, 0.26, 0.3, 3.0), (5.0, 2.0, 9.0, 11.0)])
def test_normal__has_the_quantiles_of_the_truncated_normal(shape: tuple[float, float, float, float]) -> None:
    mean, sd, low, high = shape
    u = (np.arange(0, 200_000, 50) + 0.5) / 200_000
    other = stats.truncnorm((low - mean) / sd, (high - mean) / sd, mean, sd)
    assert np.allclose(normal(*shape).value(u), other.ppf(u), rtol=1e-9, atol=1e-9)
    tail = normal(0.0, 1.0, 4.0, 30.0).value(np.array([0.0, 0.5, 0.999999, ALMOST_ONE]))
    assert np.all((tail >= 4.0) & (tail <= 30.0)) and np.all(np.diff(tail) > 0.0)


# ---------------------------------------------------------------- worlds and their numbers

ALL_RANDOM = eb.Scenario(
    name="all-random",
    gaps_m={"uniform": [5, 10]},
    speeds_mps={"normal": {"mean": 20, "sd": 1, "low": 18, "high": 22}},
    braking_capacity_mps2={"uniform": [5, 9]},
    driving_capacity_mps2={"choice": [2, 3, 4], "weights": [0.2, 0.3, 0.5]},
    mass_t={"uniform": [1, 6]},
    latency_s={"uniform": [0, 1]},
    speed_limit_mps={"uniform": [30, 40]},
    restitution={"uniform": [0, 0.3]},
    obstacle_gap_m={"uniform": [10, 45]},
)
MIXED, DELAYS = eb.load_scenario("realistic-mixed"), eb.load_scenario("mixture-delays")


def closing_pair(gap_m: object, **changes: Any) -> eb.Scenario:
    """Two vehicles at 20 m/s; the front one brakes at 6 m/s2, the rear one may act at 1 s: 3 m closer by then."""
    usual = {"gaps_m": gap_m, "braking_capacity_mps2": 6, "latency_s": [0, 1], "early_impacts": "reject"}
    return build(**{"name": "closing-pair", "vehicles": 2, "speeds_mps": 20, **usual, **changes})


def build(**given: Any) -> eb.Scenario:
    rest = {"braking_capacity_mps2": [6, 7, 6], "driving_capacity_mps2": 6, "mass_t": 5, "latency_s": [0, 0.5, 0.8]}
    return eb.Scenario(**{"name": "given", **rest, **given})


def quantity(worlds: eb.Worlds, field: str) -> np.ndarray:
    return getattr(worlds, field) if hasattr(worlds, field) else getattr(worlds.vehicles, field)


def bits(worlds: eb.Worlds) -> dict[str, bytes]:
    return {field.name: quantity(worlds, field.name).tobytes() for field in [*fields(eb.Worlds)[1:], *fields(Vehicles)]}


NEWS = [PAPER.replace(name=preset, v2x=preset, early_impacts="keep") for preset in PRESETS]


@pytest.mark.parametrize(
    "scenario",
    [ALL_RANDOM, closing_pair({"uniform": [1, 5]}), MIXED, DELAYS, *NEWS],
    ids=lambda scenario: scenario.name,
)
def test_world_k__is_the_same_alone_and_in_any_list(scenario: eb.Scenario) -> None:
    whole = scenario.sample(40, 11)
    assert whole.index.tolist() == list(range(40))
    for first, n in (*((k, 1) for k in range(40)), (20, 15)):
        part, rows = scenario.sample(n, 11, first=first), np.arange(first, first + n)
        assert bits(part.worlds) == bits(whole.worlds.take(rows)) and part.index.tolist() == rows.tolist()
        assert all(part.kinds[name].tolist() == kinds[rows].tolist() for name, kinds in whole.kinds.items())
    other, training = scenario.sample(40, 12), scenario.sample(40, 11, channel="training")
    for name, kinds in whole.kinds.items():
        assert (other.kinds[name] != kinds).any() and (training.kinds[name] != kinds).any()


# ---------------------------------------------------------------- early impacts


def test_early_impacts__are_drawn_again_and_counted() -> None:
    scenario = closing_pair({"uniform": [1, 5]})
    sample = scenario.sample(4000, 5)
    assert sample.worlds.gaps_m.min() > 3.0  # half of all draws: about one refusal per world (its variance is 2)
    assert abs(sample.rejected - 4000) < 5.0 * np.sqrt(2.0 * 4000)
    parts = [scenario.sample(1, 5, first=k) for k in range(100)] + [scenario.sample(3900, 5, first=100)]
    assert sample.rejected == sum(part.rejected for part in parts)
    kept = scenario.replace(early_impacts="keep").sample(200, 5)
    late = kept.worlds.gaps_m[:, 0] > 3.0  # accepted draws are what they are where all are kept
    assert kept.rejected == 0 and 50 < late.sum() < 150
    assert bits(sample.worlds.take(np.flatnonzero(late))) == bits(kept.worlds.take(late))


# ---------------------------------------------------------------- types of vehicles

KINDS = {
    "car": {"weight": 3, "mass_t": {"uniform": [1, 2]}, "braking_capacity_mps2": {"normal": {
        "mean": 8, "sd": 1, "low": 6, "high": 10}}},
    "truck": {"mass_t": {"with_load": [14, 40]}, "braking_capacity_mps2": {"with_load": [7, 4]}},
}  # fmt: skip
N = 20_000


def typed(**given: Any) -> eb.Scenario:
    rest = {"gaps_m": 30, "speeds_mps": 20, "driving_capacity_mps2": 3, "latency_s": 0.2}
    return eb.Scenario(**{"name": "typed", **rest, "vehicle_types": KINDS, **given})


def test_quantities__follow_the_distribution_of_their_type() -> None:
    sample = typed().sample(N, 3)
    car, truck = (sample.types == name for name in ("car", "truck"))
    mass, braking = sample.worlds.vehicles.mass_t, sample.worlds.vehicles.braking_capacity_mps2
    assert stats.kstest(braking[car], stats.truncnorm(-2, 2, loc=8, scale=1).cdf).pvalue > 0.001
    assert abs(stats.pearsonr(mass[car], braking[car]).statistic) < 0.02  # a car's are drawn apart
    load = (mass[truck] - 14.0) / 26.0  # a truck's go together
    np.testing.assert_allclose(braking[truck], 7.0 - 3.0 * load, rtol=1e-12)
    assert stats.kstest(load, stats.uniform().cdf).pvalue > 0.001
    kinds = {"van": {"mass_t": {"with_load": [2, 4]}, "braking_capacity_mps2": 6, "load": {"choice": [0, 0.5]}}}
    assert set(np.unique(typed(vehicle_types=kinds).sample(1_000, 1).worlds.vehicles.mass_t)) == {2.0, 3.0}


# ---------------------------------------------------------------- mixtures

MEMBERS = ("paper-delay-low", "paper-delay-middle", "paper-delay-high")


def mixed(*members: str, **beside: object) -> eb.Scenario:
    return eb.load_scenario({"name": "mixed", "mixture": [{"scenario": name} for name in members], **beside})


@pytest.mark.parametrize("channel", ["list", "training"])
@pytest.mark.parametrize(
    "mixture",
    [
        DELAYS,
        mixed("paper-random", "stress-wide", horizon_s=16),  # with early impacts
        mixed("realistic-mixed", "realistic-truck"),  # with types
        mixed("cooperation-3-pair", "cooperation-3-congested"),  # with a channel in one
    ],
    ids=range(4),
)
def test_mixture__world_k_is_that_of_its_member(mixture: eb.Scenario, channel: Any) -> None:
    sample = mixture.sample(300, 7, channel=channel)
    assert set(sample.scenarios) == {member.name for member in mixture.members}
    for member in mixture.members:
        own = eb.load_scenario(member.name).sample(300, 7, channel=channel)
        rows = np.flatnonzero(sample.scenarios == member.name)
        told = sample.worlds.take(rows), own.worlds.take(rows)
        assert worlds_sha256(told[0], rows) == worlds_sha256(told[1], rows)
        assert (told[0].vehicles.known_from_s == told[1].vehicles.known_from_s).all()
        if sample.types is not None:
            assert (sample.types[rows] == ("" if own.types is None else own.types[rows])).all()


def test_results__tell_scenario_and_types_agree_with_the_members_and_can_be_grouped() -> None:
    agents = {"full_brake": eb.make_agent("full_brake"), "e_v2x_bm": eb.make_agent("e_v2x_bm")}
    sample = DELAYS.sample(120, 7)
    found = eb.evaluate(sample, agents, scenario=DELAYS, seed=7)
    assert found.arrays()["scenario"].tolist() == sample.scenarios.tolist() * 2
    groups = eb.summarise_by(found, "scenario")
    for name in MEMBERS:
        member, rows = eb.load_scenario(name), np.flatnonzero(sample.scenarios == name)
        own = eb.evaluate(member.sample(120, 7).take(rows), agents, scenario=member, seed=7)
        assert (own.outcome("e_v2x_bm").total_harm == found.outcome("e_v2x_bm").total_harm[rows]).all()
        assert [row.total_harm for row in groups[name]] == [row.total_harm for row in eb.summarise(own)]
    sample = MIXED.sample(200, 7)
    found = eb.evaluate(sample, {"full_brake": eb.make_agent("full_brake")}, scenario=MIXED, seed=7)
    assert found.arrays()["vehicle_3_type"].tolist() == sample.types[:, 2].tolist()
    groups = eb.summarise_by(found, "vehicle_3_type")
    assert list(groups) == ["car", "truck", "van"]
    told = [(row.episodes, row.collisions) for (row,) in groups.values()]
    assert np.sum(told, axis=0).tolist() == [200, eb.summarise(found)[0].collisions]


def test_mixture__an_obstacle_in_some_worlds_changes_nothing_in_the_others() -> None:
    """Nor does what is certified in a world depend on the worlds beside it; the rest is left open."""
    check_obstacles_apart("e_v2x_bm", "coast+episode", "coast+step")


def check_obstacles_apart(*names: str) -> None:
    mixture = mixed("paper-random", "paper-random-obstacle")
    sample = mixture.sample(12, 7)

    def driven(scenario: eb.Scenario, worlds: Any, **options: Any) -> Any:
        agents = {name: eb.make_agent(name, scenario=scenario, harm_count="total") for name in names}
        return eb.evaluate(worlds, agents, scenario=scenario, seed=7, **options)

    together, apart = driven(mixture, sample), driven(mixture, sample, chunk=1)
    for member in map(eb.load_scenario, ("paper-random", "paper-random-obstacle")):
        rows = np.flatnonzero(sample.scenarios == member.name)
        own = driven(member, member.sample(12, 7).take(rows))
        for name in names:
            harm = own.outcome(name).total_harm.tobytes()
            assert [found.outcome(name).total_harm[rows].tobytes() for found in (together, apart)] == [harm, harm]
        told = {row for row, gap in enumerate(together.per_world()["obstacle_gap_m"][: sample.worlds.n]) if gap is None}
        assert bool(told & set(rows)) != member.has_obstacle
    assert "obstacle at = " in " ".join(str(eb.summarise(together)).split())


@pytest.mark.parametrize("seed", [1, 2])
def test_step_shield__in_a_batch_whose_rows_come_to_an_obstacle_and_lose_it(seed: int) -> None:
    env = eb.shield(
        eb.make_sb3_vec_env(mixed("paper-random", "paper-random-obstacle"), n_envs=2, seed=seed), mode="step"
    )
    env.reset()
    for _ in range(120):
        env.step(np.full((2, 1), 0.5, np.float32))


def test_shields_and_searches__take_a_mixture() -> None:
    agents = {name: eb.make_agent(name, scenario=DELAYS) for name in ("full_brake+step", "constant:3+episode")}
    plain = eb.evaluate(DELAYS.sample(20, 7), {"b": eb.make_agent("full_brake")}, scenario=DELAYS).outcome("b")
    shielded = eb.evaluate(DELAYS.sample(20, 7), agents, scenario=DELAYS).outcome("full_brake+step")
    assert (shielded.first_impact_harm <= plain.first_impact_harm + 1e-9).all()


# ---------------------------------------------------------------- the friction of the road


def test_types__of_each_place() -> None:
    scenario = typed(types=["truck", {"car": 1, "truck": 9}, "any"])
    counts = (scenario.sample(N, 1).types == "truck").sum(axis=0)
    assert counts[0] == N
    assert [stats.binomtest(counts[i], N, p).pvalue > 0.001 for i, p in ((1, 0.9), (2, 0.25))] == [True, True]
    assert scenario.bounds("mass_t") == ((14.0, 40.0), (1.0, 40.0), (1.0, 40.0))
    roles = {"vehicle_1": "constant:5", "vehicle_2": "learner"}  # within the capacity of every type of its place
    assert typed(roles=roles, types=["car", "any", "any"]).scripts[0] == "constant:5"


def test_columns__every_entry_of_a_world_has_its_own() -> None:
    rules = [*QUANTITY.usual.values(), QUANTITY.otherwise["line_speed_mps"]]
    streams, places = zip(*(rule.place(index) for rule in rules for index in range(rule.count(64))), strict=True)
    assert set(streams) == {()}
    assert len(set(places)) == len(places)
    assert max(places) < BLOCK * 64
    assert BLOCK % 4 == 0
    for_all = {"braking_capacity_mps2": 6, "driving_capacity_mps2": 6, "mass_t": 5, "latency_s": 0.5}
    worlds = PAPER.replace(vehicles=5, roles={"vehicle_2": "learner"}, **for_all).sample(7, 1).worlds
    assert len(np.unique(worlds.speeds_mps)) == 35
    assert worlds.gaps_m.shape == (7, 4)


def test_mixture__draws_its_scenarios_by_their_weights() -> None:
    parts = [{"scenario": name, "weight": weight} for name, weight in (("paper-delay-low", 1), ("paper-delay-high", 4))]
    drawn = eb.load_scenario({"name": "weighed", "mixture": parts}).sample(2_000, 7).scenarios
    assert np.mean(drawn == "paper-delay-high") == near(0.8, abs=0.03)
