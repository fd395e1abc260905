from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Vehicles, Worlds
from ethbrake_marl.scenario import Scenario, load_scenario, sampling
from ethbrake_marl.scenario.sampling import BLOCK, QUANTITY, uniform_numbers

# As printed by: python -c "import ethbrake_marl as eb; print(eb.load_scenario('paper-random').sample(3, 7).worlds)"
GOLDEN_GAPS_M = [[6.619524755316499, 8.488312854553527], [5.330123950353819, 7.790992608679621]]
GOLDEN_SPEEDS_MPS = [
    [20.44900720872454, 21.48658333485936, 21.023493985459318],
    [18.171640335640056, 18.728364132629064, 21.911283369281954],
]

ALL_RANDOM = Scenario(
    name="all-random",
    gaps_m={"uniform": [5, 10]},
    speeds_mps={"normal": {"mean": 20, "sd": 1, "low": 18, "high": 22}},
    braking_capacity_mps2={"uniform": [5, 9]},
    driving_capacity_mps2={"choice": [2, 3, 4]},
    mass_t={"uniform": [1, 6]},
    latency_s={"uniform": [0, 1]},
    speed_limit_mps={"uniform": [30, 40]},
    restitution={"uniform": [0, 0.3]},
)


def closing_pair(gap_m: object) -> Scenario:
    """Two vehicles at 20 m/s; the front one brakes at 6 m/s2, the rear one may act at 1 s: 3 m closer by then."""
    return Scenario(
        name="closing-pair", vehicles=2, gaps_m=gap_m, speeds_mps=20, braking_capacity_mps2=6,
        driving_capacity_mps2=6, mass_t=5, latency_s=[0, 1], early_impacts="reject",
    )  # fmt: skip


def quantity(worlds: Worlds, field: str) -> np.ndarray:
    return getattr(worlds, field) if hasattr(worlds, field) else getattr(worlds.vehicles, field)


def assert_same_bits(a: Worlds, b: Worlds) -> None:
    for field in [*fields(Worlds)[1:], *fields(Vehicles)]:
        assert quantity(a, field.name).tobytes() == quantity(b, field.name).tobytes(), field.name


def test_paper_random__golden_worlds_of_seed_7():
    worlds = load_scenario("paper-random").sample(2, 7).worlds
    assert worlds.gaps_m.tolist() == GOLDEN_GAPS_M
    assert worlds.speeds_mps.tolist() == GOLDEN_SPEEDS_MPS
    assert worlds.vehicles.latency_s.tolist() == [[0.0, 0.5, 0.8]] * 2
    assert worlds.vehicles.mass_t.tolist() == [[4.5, 5.5, 5.9]] * 2
    assert worlds.vehicles.restitution.tolist() == [0.1, 0.1]
    assert worlds.time_s.tolist() == [0.0, 0.0]
    assert not worlds.pair_hit.any()


def test_uniform_numbers__are_those_of_numpys_own_generator():
    key = np.random.SeedSequence([7], spawn_key=(0, 0)).generate_state(2, np.uint64)
    expected = np.random.Generator(np.random.Philox(key=key)).random(5 * 24).reshape(5, 24)
    assert uniform_numbers(7, "list", 0, 0, 5, 24).tolist() == expected.tolist()
    assert uniform_numbers(7, "list", 0, 3, 2, 24).tolist() == expected[3:].tolist()


@pytest.mark.parametrize("scenario", [ALL_RANDOM, closing_pair({"uniform": [1, 5]})], ids=lambda s: s.name)
def test_world_k_alone__is_row_k_bit_for_bit(scenario):
    whole = scenario.sample(40, 11)
    for k in range(40):
        alone = scenario.sample(1, 11, first=k)
        assert_same_bits(alone.worlds, whole.worlds.take([k]))
        assert alone.index.tolist() == [k]
    assert_same_bits(scenario.sample(15, 11, first=20).worlds, whole.worlds.take(np.arange(20, 35)))
    assert whole.index.tolist() == list(range(40))


def test_world_k__far_down_the_list():
    far = ALL_RANDOM.sample(3, 0, first=10**15)
    assert far.index.tolist() == [10**15, 10**15 + 1, 10**15 + 2]
    assert_same_bits(ALL_RANDOM.sample(1, 0, first=10**15 + 2).worlds, far.worlds.take([2]))


def test_streams__differ_by_seed_and_channel_and_world():
    lists = [ALL_RANDOM.sample(50, 1), ALL_RANDOM.sample(50, 2), ALL_RANDOM.sample(50, 1, channel="training")]
    drawn = np.concatenate([np.hstack([s.worlds.gaps_m, s.worlds.speeds_mps, s.worlds.vehicles.mass_t]) for s in lists])
    assert len(np.unique(drawn)) == drawn.size


@pytest.mark.parametrize("changed", list(QUANTITY.usual))
def test_columns__changing_one_quantity_leaves_all_others_alone(changed):
    fixed_values = {"speeds_mps": 20, "restitution": 0.2, "speed_limit_mps": 35}
    before = ALL_RANDOM.sample(20, 3).worlds
    after = ALL_RANDOM.replace(**{changed: fixed_values.get(changed, 2)}).sample(20, 3).worlds
    for field in QUANTITY.usual:
        same = quantity(before, field).tobytes() == quantity(after, field).tobytes()
        assert same == (field != changed), field


def test_columns__every_entry_of_a_world_has_its_own():
    rules = [*QUANTITY.usual.values(), QUANTITY.otherwise["line_speed_mps"]]
    places = [rule.place(index) for rule in rules for index in range(rule.count(64))]
    assert len(set(places)) == len(places)
    assert [QUANTITY.usual["mass_t"].place(i) for i in range(3)] == [5, 13, 21]
    assert QUANTITY.otherwise["line_speed_mps"].place(0) == 15  # slot 7 of vehicle_2
    assert max(places) < BLOCK * 64
    assert BLOCK % 4 == 0


def test_columns__one_vehicle_more_does_not_need_another_rule():
    five = load_scenario("paper-random").replace(
        vehicles=5,
        braking_capacity_mps2=6,
        driving_capacity_mps2=6,
        mass_t=5,
        latency_s=0.5,
        roles={"vehicle_2": "learner"},
    )
    worlds = five.sample(7, 1).worlds
    assert worlds.gaps_m.shape == (7, 4)
    assert len(np.unique(worlds.speeds_mps)) == 35  # one entry for all: each vehicle draws its own value


def test_paper_random__has_the_stated_means_and_bounds():
    worlds = load_scenario("paper-random").sample(10_000, 7).worlds
    # Standard errors: (10 - 5) / sqrt(12 * 10,000) = 0.0144 m and 0.0115 m/s; five of them.
    assert np.all(np.abs(worlds.gaps_m.mean(axis=0) - 7.5) < 0.072)
    assert np.all(np.abs(worlds.speeds_mps.mean(axis=0) - 20.0) < 0.058)
    assert np.all(np.abs(worlds.gaps_m.std(axis=0) - 5.0 / np.sqrt(12.0)) < 0.04)
    assert worlds.gaps_m.min() >= 5.0
    assert worlds.gaps_m.max() <= 10.0
    assert worlds.speeds_mps.min() >= 18.0
    assert worlds.speeds_mps.max() <= 22.0
    columns = np.hstack([worlds.gaps_m, worlds.speeds_mps])
    assert np.all(np.abs(np.corrcoef(columns.T) - np.eye(5)) < 0.05)


def test_early_impacts__are_drawn_again_and_counted():
    sample = closing_pair({"uniform": [1, 5]}).sample(4000, 5)
    gaps = sample.worlds.gaps_m[:, 0]
    # Only gaps above 3 m survive: half of all draws, so about one refusal per world (its variance is 2).
    assert gaps.min() > 3.0
    assert abs(gaps.mean() - 4.0) < 5.0 * (2.0 / np.sqrt(12.0 * 4000))
    assert abs(sample.rejected - 4000) < 5.0 * np.sqrt(2.0 * 4000)
    assert sample.rejected == sum(
        closing_pair({"uniform": [1, 5]}).sample(1, 5, first=k).rejected for k in range(100)
    ) + (closing_pair({"uniform": [1, 5]}).sample(3900, 5, first=100).rejected)


def test_early_impacts__accepted_draws_stay_what_they_were_with_keep():
    rejecting, keeping = (
        closing_pair({"uniform": [1, 5]}),
        closing_pair({"uniform": [1, 5]}).replace(early_impacts="keep"),
    )
    kept = keeping.sample(200, 5)
    late = kept.worlds.gaps_m[:, 0] > 3.0
    assert kept.rejected == 0
    assert 50 < late.sum() < 150
    assert_same_bits(rejecting.sample(200, 5).worlds.take(late), kept.worlds.take(late))


def test_early_impacts__an_impact_just_when_the_learner_may_act_is_early():
    assert closing_pair(3.001).sample(1, 0).rejected == 0
    with pytest.raises(InvalidInput, match=r"scenario 'closing-pair'.*1000 draws of world 0 all have an impact"):
        closing_pair(3.0).sample(1, 0)


def test_early_impacts__a_scenario_that_always_collides_early_fails_soon():
    with pytest.raises(InvalidInput, match=r"before vehicle_2 may act; give larger gaps_m"):
        closing_pair({"uniform": [1, 2]}).sample(10_000, 0)


def test_early_impacts__giving_up_costs_few_draws(monkeypatch):
    drawn = []
    draw = sampling._draw
    monkeypatch.setattr(sampling, "_draw", lambda *args: drawn.append(len(args[-1])) or draw(*args))
    with pytest.raises(InvalidInput, match="1000 draws of world 0"):
        closing_pair({"uniform": [1, 2]}).sample(500, 0)
    assert sum(drawn) == 10 * 500 + 990  # ten attempts of all, then one world to its end


def test_early_impacts__scripts_are_followed_and_learners_coast():
    # With the front vehicle coasting nothing closes; braking at 2 m/s2 it comes 1 m closer within 1 s.
    assert closing_pair(0.5).replace(roles={"vehicle_1": "coast", "vehicle_2": "learner"}).sample(1, 0).rejected == 0
    gentle = closing_pair(1.001).replace(roles={"vehicle_1": "constant:2", "vehicle_2": "learner"})
    assert gentle.sample(1, 0).rejected == 0
    with pytest.raises(InvalidInput, match="1000 draws"):
        gentle.replace(gaps_m=0.999).sample(1, 0)


def test_early_impacts__the_first_learner_counts():
    # vehicle_1 brakes at 6 m/s2, so 2 m are gone after 0.816 s: after vehicle_2 may act, before vehicle_3 may.
    both = Scenario(
        name="both", gaps_m=2, speeds_mps=20, braking_capacity_mps2=6, driving_capacity_mps2=6, mass_t=5,
        latency_s=[0, 0.5, 1], roles={"vehicle_2": "learner", "vehicle_3": "learner"}, early_impacts="reject",
    )  # fmt: skip
    assert both.sample(1, 0).rejected == 0
    with pytest.raises(InvalidInput, match="before vehicle_3 may act"):
        both.with_learners(["vehicle_3"]).sample(1, 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n": 0, "seed": 1}, "n = 0: must be a whole number, at least 1"),
        ({"n": 2.0, "seed": 1}, "n = 2.0"),
        ({"n": True, "seed": 1}, "n = True"),
        ({"n": 10_000_001, "seed": 1}, "n = 10000001: at most 10,000,000 worlds at once"),
        ({"n": 10**14, "seed": 1}, "n = 100000000000000: at most"),
        ({"n": 1, "seed": -1}, "seed = -1: must be a whole number, at least 0"),
        ({"n": 1, "seed": None}, "seed = None"),
        ({"n": 1, "seed": 1, "first": -1}, "first = -1"),
        ({"n": 1, "seed": 1, "first": 2**62}, "first = 4611686018427387904"),
        ({"n": 1, "seed": 1, "channel": "test"}, "channel 'test': must be one of list, training"),
    ],
)
def test_sample__bad_arguments_are_named(arguments, message):
    with pytest.raises(InvalidInput, match=message):
        ALL_RANDOM.sample(**arguments)


def test_sample__any_whole_seed_will_do():
    assert_same_bits(ALL_RANDOM.sample(2, np.uint64(5)).worlds, ALL_RANDOM.sample(np.int64(2), 5).worlds)
    assert ALL_RANDOM.sample(1, 2**200).worlds.n == 1
