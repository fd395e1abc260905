"""What figures and tables of the paper show here: statements with planted harm, and claims."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import teams_of
from ethbrake_marl.agents.pairwise import pairwise
from ethbrake_marl.agents.team import play
from ethbrake_marl.extensions.reproduction import curves, map_bound, strategies, tables, trajectories
from ethbrake_marl.extensions.reproduction.curves import DISTANCE, EXPECTED, PROVEN
from ethbrake_marl.extensions.reproduction.made import Made, ReproductionSettings
from ethbrake_marl.extensions.reproduction.paper_rows import HYBRID_TEST, RANDOM_TEST, PaperRow
from ethbrake_marl.extensions.reproduction.readings import OURS, R1, R2, RANDOM, READINGS, STATED, Reading
from ethbrake_marl.extensions.reproduction.strategies import COUPLED, E_V2X_BM, NON_E, PREDICTED, SHIPPED_SPECS
from ethbrake_marl.extensions.reproduction.verdicts import Claim, Result, judge_statement
from ethbrake_marl.files.sheet import Estimate

HYBRID_PPO = "Hybrid PPO"
SETTINGS = ReproductionSettings(Path("unused"), episodes=100)


def outcomes(**harm: float) -> dict[str, dict[str, np.ndarray]]:
    """What strategies do in 4 worlds with this harm; names of the paper without blanks."""
    names = {"NonE": NON_E, "EV2X": E_V2X_BM, "HSAC": "Hybrid SAC", "HPPO": HYBRID_PPO}
    return {
        names.get(name, name): {"collided": np.array([True, True, value > 3.0, False]),
                                **dict.fromkeys(("first", "total"), value + np.array([0.0, 0.25, 0.5, 0.25]))}
        for name, value in harm.items()
    }  # fmt: skip


def test_conclusions__by_planted_harm() -> None:
    planted = outcomes(NonE=10.0, EV2X=5.0, SAC=3.5, PPO=2.0, HSAC=3.0, HPPO=2.5)
    judged = {name: judge_statement(parts) for name, parts in tables.conclusions(planted).items()}
    assert {name: result[:2] for name, result in judged.items()} == {
        "E-V2X-BM collides less": ("does not hold", "differs"),
        "Non-E collides most": ("holds in 0 of 3", "differs"),
        "hybrids collide least": ("holds in 0 of 4", "undecided"),
        "Non-E harms most": ("holds in 6 of 6", "agrees"),
        "E-V2X-BM harms less": ("holds in 2 of 2", "agrees"),
        "hybrids harm least": ("holds in 8 of 8", "agrees"),
        "learning harms less": ("holds in 4 of 4", "agrees"),
        "hybrid and baseline": ("holds in 4 of 6", "undecided"),
        "hybrid and learning": ("holds in 2 of 6", "differs"),
        "three vehicles": ("holds in 2 of 2", "agrees"),
    }
    assert judged["hybrid and learning"][2].startswith("Hybrid PPO minus PPO")
    worse = outcomes(NonE=4.0, EV2X=5.0, SAC=6.0, PPO=6.0, HSAC=5.5, HPPO=4.5)
    assert [judge_statement(parts)[0] for parts in tables.conclusions(worse).values()] == [
        "does not hold", "holds in 0 of 3", "holds in 0 of 4", "holds in 0 of 6", "holds in 0 of 2", "holds in 2 of 8",
        "holds in 0 of 4", "holds in 2 of 6", "holds in 4 of 6", "holds in 0 of 2",
    ]  # fmt: skip


def test_avoided__collisions_are_counted_world_by_world() -> None:
    worlds = np.arange(1_000)
    baseline, policy = worlds < 600, (worlds >= 40) & (worlds < 605)  # avoids 40 of the baseline's, adds 5
    assert strategies.avoided_text(policy, baseline) == "avoids 40, adds 5 of 1,000"
    driven = {NON_E: worlds < 800, E_V2X_BM: baseline, "PPO": policy, "SAC": worlds < 601}
    contact, impact = (worlds >= 40) & (worlds < 590), (worlds >= 40) & (worlds < 580)
    claims = tables.avoidance_claims({name: {"collided": rows} for name, rows in driven.items()}, contact, impact)
    full, published, better, alike = claims
    assert better == Claim(
        "PPO avoids collisions", {OURS: Result("holds: avoids 40, adds 5 of 1,000", "agrees")}, "4.0 %"
    )
    assert alike.results[OURS] == ("not shown: avoids 0, adds 1 of 1,000", "undecided")
    assert full.share == "25.0 %" and full.results[OURS].text.endswith("(250 to 260 of its 800 collisions)")
    text = "at least in 5.0 % [3.8, 6.5] of all worlds (50 to 60 of its 600 collisions)"
    assert published.results[OURS] == (text, "agrees")


def test_avoided__at_the_distance_at_which_most_is_gained() -> None:
    near, far = np.arange(200) < 100, np.arange(200) >= 100
    lines = {E_V2X_BM: np.ones(200), "PPO": np.where(np.arange(200) < 180, 1.0, 0.0)}
    groups = {"10-12 m": (lines, near), "12-14 m": (lines, far)}
    claim = curves.avoidance_by_distance(groups, "PPO")
    text = "holds: 10-12 m avoids 0, adds 0 of 100; 12-14 m avoids 20, adds 0 of 100"
    assert claim == Claim("PPO avoids collisions", {OURS: Result(text, "agrees")}, "10.0 %")


def test_worlds__by_hand() -> None:
    """Four worlds. The last is without harm; in the first E-V2X-BM does what it predicts, in the second more."""
    planted = outcomes(EV2X=5.0, NonE=9.0, SAC=4.0, PPO=3.0, HSAC=4.0, HPPO=3.0)
    planted["SAC"]["first"] = planted["SAC"]["first"] + np.array([0.0, 0.0, 0.0, 2.0])
    planted[E_V2X_BM][PREDICTED] = np.array([5.0, 2.0, 6.0, 0.0])
    overall, safe, better = tables.world_claims({R1: planted})
    assert overall.results[R1] == ("holds in 33.3 % [6.1, 79.2] of 3 worlds with H* > 0", "differs")
    assert safe.results[R1] == ("above H* in 2 (Hybrid PPO), 2 (Hybrid SAC) of 4 worlds", "differs")
    above = "above E-V2X-BM's harm in 0 (Hybrid PPO), 0 (Hybrid SAC), 0 (PPO), 1 (SAC) of 4 worlds"
    assert better.results[R1] == (above, "agrees")  # whatever the policies alone do
    parts = tables.severity(planted, np.array([True, True, False, False]))
    assert [part.difference.value for part in parts] == [-2.0, -1.0]


def test_deceleration__is_free_of_collisions_in_its_interval_and_unique_beside_it() -> None:
    interval, unique = tables.deceleration_claims(100)
    assert interval.results[OURS] == ("holds in 100.0 % [91.2, 100.0] of 40 worlds with H* = 0", "agrees")
    assert unique.results[OURS] == ("holds in 100.0 % [94.0, 100.0] of 60 worlds with H* > 0", "agrees")


@pytest.mark.parametrize("step_s", [0.2, 0.3])
def test_least_rate__in_the_map_holds_for_every_strategy(step_s: float) -> None:
    reading = STATED._replace(step_s=step_s)
    certain, free = map_bound.collides_in_map(reading, 60), np.zeros(60, np.bool_)
    scenario, game, alert = strategies.open_reading(reading, 60)
    for spec in ("full_brake", "e_v2x_bm:pairwise", *SHIPPED_SPECS.values()):
        team = teams_of(spec, scenario, harm_count="first")[spec]
        least_gap = np.min([state.gaps_m.min(axis=1) for _, state in play(game, alert, team)], axis=0)
        free |= least_gap >= 0.0
    assert certain.any() and free.any() and not (certain & free).any()
    assert (certain | free).mean() > 0.9  # the bound is nearly reached


def world_of(gap_m: float, speed_mps: float) -> Reading:
    """One world of the map: Vehicles 1 and 2 at this gap, with Vehicle 2 at this speed; Vehicle 3 is far behind."""
    return STATED._replace(step_s=0.1, others=(("gaps_m", (gap_m, 90.0)), ("speeds_mps", (20.0, speed_mps, 20.0))))


def test_least_rate__by_hand() -> None:
    """Vehicle 1 stops after 400 / 12 m, Vehicle 2 after 0.5 s at its speed and then v^2 / 14 m."""
    for speed_mps in (20.0, 22.0):
        needed = 0.5 * speed_mps + speed_mps**2 / 14.0 - 20.0**2 / 12.0
        narrow, wide = (map_bound.collides_in_map(world_of(needed + by, speed_mps), 1)[0] for by in (-0.3, 0.3))
        assert narrow and not wide


def test_least_rate__by_hand_where_vehicle_3_is_near() -> None:
    """Vehicle 2 drives away at 7 m/s2 from 0.5 s on; Vehicle 3, 4 m/s faster, brakes with 6 m/s2 from 0.8 s on."""
    at_braking = 4.0 - 7.0 * 0.3
    needed = 0.5 * 4.0 + 0.3 * 0.5 * (4.0 + at_braking) + at_braking**2 / (2.0 * 13.0)
    for by, collides in ((-0.15, True), (0.15, False)):
        keys = (("gaps_m", (90.0, needed + by)), ("speeds_mps", (20.0, 18.0, 22.0)))
        assert map_bound.collides_in_map(STATED._replace(step_s=0.1, others=keys), 1)[0] == collides


def test_capacities__decide_whether_harm_grows_with_the_distance() -> None:
    results = curves.capacity_results(300)
    assert [*results] == [*READINGS] and {result.verdict for result in results.values()} == {"agrees"}
    for result in results.values():
        numbers = [float(text) for text in re.findall(r"(\d+\.\d+)", result.text)]
        assert numbers[0] < numbers[1] - 2.0 and abs(numbers[3] - numbers[2]) < 0.5 and numbers[5] < numbers[4] - 2.0


def test_numbers__by_hand() -> None:
    """400 worlds of the same harm, so that the means have no interval."""
    printed = [PaperRow(NON_E, 0, 300, 0.75, 10.1, 0.0), PaperRow(E_V2X_BM, 0, 120, 0.3, 3.0, 0.7)]
    worlds = np.arange(400)
    three, half = worlds % 4 > 0, worlds % 2 > 0

    def driven(non_e: float, e_v2x_bm: float) -> strategies.Outcomes:
        return {NON_E: {"collided": three, "first": np.full(400, non_e)},
                E_V2X_BM: {"collided": half, "first": np.full(400, e_v2x_bm)}}  # fmt: skip

    outcomes = {OURS: driven(10.0, 6.0), R1: driven(12.0, 3.0)}
    bounds = {tables.EXACT: Estimate(0.5, (0.45, 0.55)), "map": Estimate(0.6, (0.5, 0.7))}
    rates, harms = tables.number_claims(printed[0], outcomes, bounds)
    assert rates.results == dict.fromkeys((OURS, R1), ("75.0 % [70.5, 79.0]", "agrees"))
    assert harms.results == {OURS: ("10.00 [10.00, 10.00]", "agrees"), R1: ("12.00 [12.00, 12.00]", "differs")}
    rates, harms = tables.number_claims(printed[1], outcomes, bounds)
    least = "; at least 50.0 % [45.0, 55.0] with an impact, whoever drives"
    assert rates.results[OURS] == ("50.0 % [45.1, 54.9]" + least, "cannot be")
    assert [result.verdict for result in harms.results.values()] == ["differs", "agrees"]
    bounds["map"] = Estimate(0.4, (0.3, 0.5))  # 0.3 is within chance
    rates, _ = tables.number_claims(printed[1], outcomes, bounds)
    assert rates.results[OURS] == ("50.0 % [45.1, 54.9]", "differs")


def by_name(made: Made) -> dict[str, Claim]:
    claims = {claim.name: claim for claim in made.claims}
    assert len(claims) == len(made.claims)
    return claims


def test_random_table__has_every_printed_number_in_each_reading() -> None:
    made = tables.reproduce_random_table(SETTINGS)
    claims, (*tests, in_map) = by_name(made), made.sheets
    assert len(claims) == 2 * 4 + 10 + 1 + 3 + 4 + 2 + 1
    assert [row[0] for row in in_map.rows] == [
        "exact impacts",
        *(f"map, steps of {h} s" for h in (0.1, 0.2, 0.25, 0.3)),
    ]
    collides = map_bound.collides_in_map(STATED._replace(step_s=0.2), 100)
    assert in_map.rows[2][1].value == pytest.approx(collides.mean())  # as many worlds as in the list
    assert claims["Non-E, collision rate"].result(R2) == ("80.0 % [71.1, 86.7]", "differs")
    assert [sheet.title for sheet in tests] == [f"The random test, {reading}" for reading in READINGS]
    rows = {name: [each and each.value for each in cells] for name, *cells in tests[0].rows}
    assert rows[E_V2X_BM] == pytest.approx([0.6, 17.195162763975528, 18.491602802513473, 8.559600828714368])
    assert rows["least possible (proven)"][:2] == pytest.approx(
        [0.59, strategies.proven_least_harm(STATED, 100).mean()]
    )
    assert claims["safety bound"].result(OURS).verdict == "differs"
    assert {claims["safety bound"].result(reading).verdict for reading in (R1, R2)} == {"agrees"}


def test_hybrid_table__has_what_needs_no_training() -> None:
    claims = by_name(tables.reproduce_hybrid_table(SETTINGS))
    assert len(claims) == 4
    assert claims["avoided"].result(R1) == ("2,005 of at most 737 + 1,263 = 2,000", "cannot be")
    assert claims["Hybrid, collision rate"].result(OURS).text.startswith("at least 59.0 % [")


def test_by_distance__groups_are_2_m_wide_and_keep_every_world() -> None:
    reading, harm = Reading(DISTANCE), np.arange(100.0)
    total = eb.load_scenario(DISTANCE).sample(100, 7).gaps_m.sum(axis=1)
    groups = curves.by_distance(reading, 100, {"x": harm})
    assert [*groups] == ["10-12 m", "12-14 m", "14-16 m", "16-18 m", "18-20 m"]
    for k, (lines, rows) in enumerate(groups.values()):
        assert lines["x"] is harm
        assert np.array_equal(rows, (total >= 10.0 + 2.0 * k) & (total < 12.0 + 2.0 * k))


def test_statements__of_the_distance_by_planted_harm() -> None:
    near, far = np.arange(6) < 3, np.arange(6) >= 3
    tenths = np.array([0.0, 0.1, 0.2, 0.0, 0.1, 0.2])
    harm = {NON_E: (5.0, 9.0), E_V2X_BM: (7.0, 1.0), "SAC": (6.0, 0.5), "PPO": (8.0, 0.1)}
    lines = {name: np.where(near, *values) + k * tenths for k, (name, values) in enumerate(harm.items())}
    groups = {"10-12 m": (lines, near), "12-14 m": (lines, far)}
    judged = [judge_statement(parts) for parts in curves.statements(groups).values()]
    assert [each[:2] for each in judged] == [
        ("holds in 3 of 6", "differs"), ("holds in 1 of 2", "differs"), ("holds", "agrees"),
        ("holds in 3 of 4", "differs"),
    ]  # fmt: skip
    assert judged[1][2].startswith("E-V2X-BM minus Non-E, 10-12 m, +2.10")
    assert judged[3][2].startswith("PPO minus E-V2X-BM, 10-12 m, +1.20")
    lines[EXPECTED] = 0.1 * lines[NON_E]
    predicted = [judge_statement(parts)[1] for parts in curves.statements(groups, EXPECTED).values()]
    assert predicted == ["differs", "agrees", "differs", "differs"]  # it predicts least at the shortest distance
    assert judge_statement(curves.growth_between_groups(groups, NON_E))[:2] == ("holds", "agrees")


def test_advantage__is_largest_where_the_policy_gains_most() -> None:
    near, far = np.arange(60) < 30, np.arange(60) >= 30
    lines = {E_V2X_BM: np.where(near, 9.0, 3.0), "PPO": np.ones(60), "SAC": np.where(near, 5.0, 1.0)}
    lines = {name: line + 0.1 * (np.arange(60) % 3) for name, line in lines.items()}
    result = curves.advantage_result({"10-12 m": (lines, near), "12-14 m": (lines, far)})
    text = "minus E-V2X-BM, by distance: PPO -8.00, -2.00; SAC -4.00, -2.00"
    assert result == (f"holds in 2 of 2: {text}", "agrees")
    assert curves.advantage_result({"10-12 m": (lines, far), "12-14 m": (lines, near)}).verdict == "differs"


def test_time__alone_makes_harm_certain() -> None:
    claim = curves.time_claim(replace(SETTINGS, episodes=200))
    assert {claim.result(reading).verdict for reading in READINGS} == {"agrees"}
    least = [float(text) for text in re.findall(r"(\d+\.\d\d)", claim.results[OURS].text)[-4:]]
    assert least == sorted(least) and least[0] < 0.3 * least[-1]


def test_distance__figure_and_tables_have_the_same_numbers() -> None:
    made = curves.reproduce_distance(SETTINGS)
    claims = by_name(made)
    assert len(claims) == 2 * 4 + 4 + 2 + 1
    for axes, sheet in zip(made.figures[0].figure.axes, made.sheets, strict=True):
        rows = {name: [each.value for each in cells] for name, *cells in sheet.rows}
        shown = {line.get_label(): line.get_ydata().tolist() for line in axes.lines}
        assert {name: rows[name] for name in shown} == shown and {NON_E, "PPO", "SAC"} <= {*shown}
        assert (PROVEN in rows) == (COUPLED in rows) == (sheet is made.sheets[0]) and EXPECTED in rows
    agents = ["ppo", "ppo+episode:pairwise", "e_v2x_bm:pairwise"]
    result = eb.evaluate(DISTANCE, agents, episodes=100)
    alone, hybrid, baseline = (result[each]["first_impact_harm"] for each in agents)
    count = (hybrid > np.minimum(alone, baseline) + 1e-9).sum()
    assert claims["lower"].result(OURS).text.startswith(f"not the lower in {count} (Hybrid PPO), ")
    assert [claims["lower"].result(reading).verdict for reading in READINGS] == ["differs", "agrees", "agrees"]


def test_delays__in_the_world_of_the_figure() -> None:
    made = curves.reproduce_delays(replace(SETTINGS, episodes=50))
    for reading in READINGS:
        assert {name: claim.result(reading).verdict for name, claim in by_name(made).items()} == dict.fromkeys(
            ("learning harms least", "robust", "time"), "agrees"
        ) | {"room": "undecided"}
    sheet = made.sheets[0]
    assert sheet.headings == ["Strategy", "low (0.1, 0.3 s)", "middle (0.3, 0.6 s)", "high (0.8, 1.2 s)"]
    rows = {name: [f"{each.value:.2f}" for each in cells] for name, *cells in sheet.rows}
    golden = {
        NON_E: ["24.08", "27.78", "45.99"],
        E_V2X_BM: ["0.00", "0.00", "47.35"],
        COUPLED: ["0.00", "0.00", "43.82"],
        "SAC": ["0.00", "0.00", "16.44"],
        "PPO": ["0.00", "0.00", "15.61"],
        EXPECTED: ["0.00", "0.00", "22.26"],
        PROVEN: ["0.00", "0.00", "15.28"],
    }
    assert {name: rows[name] for name in golden} == golden
    state = {"gap_1_m": [7], "gap_2_m": [7], "speed_1_mps": [20], "speed_2_mps": [18], "speed_3_mps": [20]}
    for k, delay in enumerate(("low", "middle", "high")):
        scenario = eb.load_scenario(f"paper-delay-{delay}")
        result = eb.evaluate(eb.worlds_from_table(scenario, state), "full_brake,ppo", scenario=scenario)
        assert rows[NON_E][k] == f"{result['full_brake']['first_impact_harm'].mean():.2f}"
        assert rows["PPO"][k] == f"{result['ppo']['first_impact_harm'].mean():.2f}"


def test_5000_worlds__cannot_be_driven_at_the_speeds_of_the_figure_of_distances() -> None:
    predicted = [pairwise(eb.load_scenario(base).sample(5_000, 7), 2).harm.mean() for base in (DISTANCE, RANDOM)]
    assert [f"{each:.2f}" for each in predicted] == ["3.07", "9.38"]  # printed: 9.85


def test_trajectories_and_accelerations__have_these_numbers() -> None:
    made = trajectories.reproduce_trajectories(SETTINGS), trajectories.reproduce_accelerations(SETTINGS)
    record = trajectories.record_all()["PPO", 1]
    assert record.gaps_m[-1] == pytest.approx([0.16, 1.84], abs=0.005) and record.impacts.number.sum() == 0.0
    assert record.last.harm("first")[0] == record.last.harm("total")[0] == 0.0
    assert len(made[0].figures) == 1 and len(made[1].sheets[0].rows) == 4
    no, yes = "does not hold", "holds"
    seeds = "; by the paper's process, by seed: "
    claims = {(k, claim.name, *claim.results[OURS]) for k, item in enumerate(made) for claim in item.claims}
    assert claims == {
        (0, "alike in Scenario 1", f"{no}: root mean square 2.06 m against 0.88 m{seeds}{no}, {no}, {no}", "differs"),
        (0, "PPO from Vehicle 3",
         f"{yes}: mean gap 5.92 m under SAC, 6.70 m under PPO{seeds}{yes}, {yes}, {yes}", "agrees"),
        (0, "SAC from Vehicle 1",
         f"{yes}: mean gap 3.28 m under PPO, 4.05 m under SAC{seeds}{yes}, {yes}, {yes}", "agrees"),
        (1, "alike in Scenario 1",
         f"{no}: root mean square difference 3.13 m/s² against 2.16 m/s²{seeds}{no}, {no}, {no}", "differs"),
        (1, "PPO accelerates", f"{yes}: first command +7.00 m/s²{seeds}{no}, {no}, {no}", "undecided"),
        (1, "SAC decelerates", f"{yes}: braking in 100 % of the time it moves{seeds}{yes}, {yes}, {yes}", "agrees"),
        (1, "PPO is smoother",
         f"{no}: ups and downs 17.4 m/s² under PPO, 8.9 m/s² under SAC{seeds}{no}, {yes}, {no}", "undecided"),
    }  # fmt: skip


def test_figures__of_positions_and_commands_are_those_of_the_records() -> None:
    record = trajectories.record_all()["PPO", 1]
    road = trajectories.road_figure(dict.fromkeys([(name, 1) for name in "abcd"], record), "c").axes[0]
    arrows = [line for line in road.lines if line.get_marker() == ">"]
    assert len(arrows) == 3
    for i, line in enumerate(arrows):
        at = np.interp(np.arange(int(record.time_s[-1]) + 1), record.time_s, record.positions_m[:, i])
        assert line.get_xdata() == pytest.approx(at) and {*line.get_ydata()} == {i + 1}
    panels = dict.fromkeys([(name, 1) for name in "abcd"], record)
    profile = trajectories.profiles_figure(panels, "c").axes[0]
    assert np.array_equal(profile.lines[1].get_ydata(), record.command_mps2[:, 1])


def test_paper_rows__are_consistent() -> None:
    for row in (*RANDOM_TEST, *HYBRID_TEST):
        assert row.collision_rate == pytest.approx(row.collisions / row.episodes, abs=5e-5)
        if row.harm_decrease is not None:
            assert row.harm_decrease == pytest.approx(1 - row.average_harm / 33.5878, abs=2e-4)
