"""What figures and tables of the paper show here: numbers of version 0.5, statements with planted harm, claims."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.reproduction import (
    changes,
    curves,
    map_bound,
    random_test,
    strategies,
    tables,
    trajectories,
    verdicts,
)
from ethbrake_marl.extensions.reproduction.curves import DISTANCE, EXPECTED, PROVEN
from ethbrake_marl.extensions.reproduction.learning import Course
from ethbrake_marl.extensions.reproduction.made import Made, ReproductionSettings
from ethbrake_marl.extensions.reproduction.paper_rows import HYBRID_TEST, RANDOM_TEST, PaperRow
from ethbrake_marl.extensions.reproduction.random_test import (
    E_V2X_BM,
    HYBRID_PPO,
    NON_E,
    SHIPPED_SPECS,
    plan,
    report_outcome,
)
from ethbrake_marl.extensions.reproduction.readings import RANDOM, STATED, Reading
from ethbrake_marl.extensions.reproduction.strategies import COUPLED, PREDICTED
from ethbrake_marl.extensions.reproduction.verdicts import Claim, Verdict, judge_statement
from ethbrake_marl.files.sheet import Estimate

SETTINGS = ReproductionSettings(Path("unused"), episodes=100)

# collisions, first-impact harm, total harm, predicted harm in the first 100 worlds, by version 0.5
GOLDEN = {
    STATED: {
        NON_E: (80, 21.01116356815893, 22.464131799726196, None),
        E_V2X_BM: (60, 17.195162763975528, 18.491602802513473, 8.559600828714368),
        COUPLED: (60, 13.67244358932681, 14.448446979076754, 13.672443589326782),
        "SAC": (60, 6.222264735090079, 6.512750651973412, None),
        "Hybrid PPO, simulated H*": (60, 6.072011927547129, 6.326495805283884, 6.072011927547129),
        HYBRID_PPO: (60, 6.9340617463633585, 7.164829747133655, 6.055780908806861),
    },
    Reading(acts_s=0.2): {
        NON_E: (96, 31.74147533004871, 32.511432448520004, None),
        HYBRID_PPO: (49, 3.463970974223885, 3.683772674937231, 3.3204208348440165),
    },
    Reading(DISTANCE): {E_V2X_BM: (68, 12.61114288160522, 13.102561622377982, 3.3187025173271767)},
}


@pytest.mark.parametrize("reading", GOLDEN, ids=lambda reading: reading.name)
def test_strategies__have_the_numbers_of_version_0_5(reading: Reading) -> None:
    found = strategies.strategies(reading, 100, SHIPPED_SPECS)
    least = strategies.proven_least_harm(reading, 100)
    for name, (collisions, first, total, predicted) in GOLDEN[reading].items():
        own = found[name]
        close = {"rel": 5e-4} if name == COUPLED else {"rel": 1e-12}  # the search for its deceleration is another
        assert own["collided"].sum() == collisions
        assert own["first"].mean() == pytest.approx(first, **close)
        assert own["total"].mean() == pytest.approx(total, **close)
        assert (PREDICTED in own) == (predicted is not None)
        assert predicted is None or own[PREDICTED].mean() == pytest.approx(predicted, **close)
    assert all((least <= own["first"] + 1e-9).all() for own in found.values()) and least.mean() > 0.0


def test_hybrid__with_the_simulated_bound_always_takes_the_better_one() -> None:
    found = strategies.strategies(STATED, 100, {"policy": "sac"})
    alone, baseline, hybrid = (found[name]["first"] for name in ("policy", COUPLED, "Hybrid policy, simulated H*"))
    assert np.array_equal(hybrid, np.minimum(alone, baseline))
    assert (hybrid < alone).any() and (hybrid < baseline).any()


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
    }
    assert judged["hybrid and learning"][2].startswith("Hybrid PPO minus PPO")
    worse = outcomes(NonE=4.0, EV2X=5.0, SAC=6.0, PPO=6.0, HSAC=5.5, HPPO=4.5)
    assert [judge_statement(parts)[0] for parts in tables.conclusions(worse).values()] == [
        "does not hold", "holds in 0 of 3", "holds in 0 of 4", "holds in 0 of 6", "holds in 0 of 2", "holds in 2 of 8",
        "holds in 0 of 4", "holds in 2 of 6", "holds in 4 of 6",
    ]  # fmt: skip


def test_avoided__collisions_are_counted_world_by_world() -> None:
    worlds = np.arange(1_000)
    baseline, policy = worlds < 600, (worlds >= 40) & (worlds < 605)  # avoids 40 of the baseline's, adds 5
    assert random_test.avoided_text(policy, baseline) == "avoids 40, adds 5 of 1,000"
    stated = {E_V2X_BM: {"collided": baseline}, "PPO": {"collided": policy}, "SAC": {"collided": worlds < 601}}
    better, alike = (tables.avoidance_claim(name, stated, stated) for name in ("PPO", "SAC"))
    assert better == Claim("PPO avoids collisions", "holds: avoids 40, adds 5 of 1,000", "holds", "agrees")
    assert alike.verdict == "undecided" and alike.ours == "not shown: avoids 0, adds 1 of 1,000"


def test_avoided__at_the_distance_at_which_most_is_gained() -> None:
    near, far = np.arange(200) < 100, np.arange(200) >= 100
    lines = {E_V2X_BM: np.ones(200), "PPO": np.where(np.arange(200) < 180, 1.0, 0.0)}
    groups = {"10-12 m": (lines, near), "12-14 m": (lines, far)}
    claim = curves.avoidance_by_distance(groups, "PPO")
    assert claim.ours == "holds: 10-12 m avoids 0, adds 0 of 100; 12-14 m avoids 20, adds 0 of 100"
    assert claim.verdict == "agrees"


def test_worlds__by_hand() -> None:
    """Four worlds. The last is without harm; in the first E-V2X-BM does what it predicts, in the second more."""
    planted = outcomes(EV2X=5.0, NonE=9.0, SAC=4.0, PPO=3.0, HSAC=4.0, HPPO=3.0)
    planted[COUPLED] = {**planted[E_V2X_BM], "first": planted[E_V2X_BM]["first"] - 1.0,
                        "total": planted[E_V2X_BM]["total"] - 1.0}  # fmt: skip
    planted["SAC"]["total"] = planted["SAC"]["total"] + np.array([0.0, 0.0, 0.0, 2.0])
    planted[E_V2X_BM][PREDICTED] = np.array([5.0, 2.0, 2.0, 0.0])
    planted["Hybrid SAC"][PREDICTED], planted[HYBRID_PPO][PREDICTED] = np.array([4.0, 2.0, 9.0, 9.0]), np.full(4, 9.0)
    claims = {claim.name: claim for claim in
              tables.world_claims(planted, np.array([1.0, 1.0, 0.0, 0.0]))}  # fmt: skip
    assert claims["severity of certain collisions"].verdict == "agrees"
    assert claims["three vehicles"].verdict == "agrees"
    assert claims["expected is overall"].ours == "holds in 33.3 % [6.1, 79.2] of 3 worlds with H* > 0"
    exceeded = "above H* in 0 (Hybrid PPO), 1 (Hybrid SAC) of 4 worlds"
    assert claims["safety bound"][1:] == (exceeded, "", "differs")
    above = "above E-V2X-BM's harm in 0 (Hybrid PPO), 0 (Hybrid SAC), 0 (PPO), 1 (SAC) of 4 worlds"
    assert claims["never worse"][1:] == (above, "", "agrees")  # whatever the policies alone do
    assert claims[f"{NON_E}'s avoidable collisions"].ours == "in 25.0 % [4.6, 69.9] of all worlds"  # the third world


def test_deceleration__is_free_of_collisions_in_its_interval_and_unique_beside_it() -> None:
    interval, unique = tables.deceleration_claims(100)
    assert interval[1:] == ("holds in 100.0 % [91.2, 100.0] of 40 worlds with H* = 0", "", "agrees")
    assert unique[1:] == ("holds in 100.0 % [94.0, 100.0] of 60 worlds with H* > 0", "", "agrees")


@pytest.mark.parametrize("step_s", [0.2, 0.3])
def test_least_rate__in_the_map_holds_for_every_strategy(step_s: float) -> None:
    reading = STATED._replace(step_s=step_s)
    certain = map_bound.collides_in_map(reading, 60)
    driven = strategies.strategies(reading, 60, SHIPPED_SPECS)
    avoided = np.any([~outcome["collided"] for outcome in driven.values()], axis=0)
    assert certain.any() and avoided.any() and not (certain & avoided).any()
    assert (certain | avoided).mean() > 0.9  # the bound is nearly reached


def world_of(gap_m: float, speed_mps: float) -> Reading:
    """One world of the map: Vehicles 1 and 2 at this gap, with Vehicle 2 at this speed; Vehicle 3 is far behind."""
    return STATED._replace(step_s=0.1, others=(("gaps_m", (gap_m, 90.0)), ("speeds_mps", (20.0, speed_mps, 20.0))))


def test_least_rate__by_hand() -> None:
    """Vehicle 1 stops after 400 / 12 m, Vehicle 2 after 0.5 s at its speed and then v^2 / 14 m."""
    for speed_mps in (20.0, 22.0):
        needed = 0.5 * speed_mps + speed_mps**2 / 14.0 - 20.0**2 / 12.0
        narrow, wide = (map_bound.collides_in_map(world_of(needed + by, speed_mps), 1)[0] for by in (-0.3, 0.3))
        assert narrow and not wide


def test_capacities__decide_whether_harm_grows_with_the_distance() -> None:
    claim = curves.capacity_claim(Reading(DISTANCE), 300)
    assert claim.verdict == "agrees"
    numbers = [float(text) for text in re.findall(r"(\d+\.\d+)", claim.ours)]
    assert numbers[0] < numbers[1] - 5.0 and abs(numbers[3] - numbers[2]) < 0.5 and numbers[5] < numbers[4] - 5.0


def test_changes__have_a_number_for_each_claim() -> None:
    made = changes.reproduce_changes(SETTINGS)
    texts = verdicts.paper_texts()["changes"]
    rows = {text["result"]: row for text, row in zip(texts, made.sheets[0].rows, strict=True)}
    assert [row[:2] for row in made.sheets[0].rows] == [(text["claim"], text["change"]) for text in texts]
    hybrid, simulated = GOLDEN[STATED][HYBRID_PPO][1], GOLDEN[STATED]["Hybrid PPO, simulated H*"][1]
    assert f"hybrid with PPO {hybrid:.2f} -> {simulated:.2f}, PPO alone" in rows["reliable"][2]
    assert rows["baseline"][2] == "17.20 -> 8.56" and rows["avoided"][2] == "2,005 for at most 737 + 1,263"
    assert rows["braking"][2] == "Non-E 80.0 % and 21.01 -> Non-E 96.0 % and 31.74"
    assert rows["bound"][2].count("-> 0") == rows["lower"][2].count("-> 0") == 2


def test_numbers__by_hand() -> None:
    """400 worlds of the same harm, so that the means have no interval; half of them cannot be without harm."""
    printed = [PaperRow(NON_E, 0, 300, 0.75, 10.1, 0.0), PaperRow(E_V2X_BM, 0, 120, 0.3, 3.0, 0.7)]
    worlds = np.arange(400)
    three, half = worlds % 4 > 0, worlds % 2 > 0
    stated = {NON_E: (three, np.full(400, 10.0)), E_V2X_BM: (half, np.full(400, 6.0))}
    nearest = {NON_E: (three, np.full(400, 12.0)), E_V2X_BM: (three, np.full(400, 3.0))}
    in_map = {"0.1 s": Estimate(0.6, (0.5, 0.7)), "0.2 s": Estimate(0.5, (0.4, 0.6))}
    claims = tables.number_claims(printed, stated, nearest, 8.0 * half, in_map)
    three_quarters, one_half = "75.0 % [70.5, 79.0]", "50.0 % [45.1, 54.9]"
    least = "; with exact impacts at least {}, whoever drives".format
    rates = "60.0 % [50.0, 70.0] (steps of 0.1 s), 50.0 % [40.0, 60.0] (steps of 0.2 s)"
    bounds = f"{least(one_half)}; in the paper's map at least {rates}"
    assert claims == [
        ("Non-E, collision rate", three_quarters, f"{three_quarters}, agrees", "agrees"),
        ("Non-E, average harm", "10.00 [10.00, 10.00]", "12.00 [12.00, 12.00], differs", "agrees"),
        ("E-V2X-BM, collision rate", one_half + bounds, f"{three_quarters} (what happens), differs", "cannot be"),
        ("E-V2X-BM, average harm", "6.00 [6.00, 6.00]" + least("4.00 [3.61, 4.39]"),
         "3.00 [3.00, 3.00] (predicted), agrees", "differs"),
        ("E-V2X-BM, harm decrease", "40.0 % [40.0, 40.0]", "75.0 % [75.0, 75.0] (predicted), differs", "differs"),
    ]  # fmt: skip
    in_map["0.3 s"] = Estimate(0.4, (0.3, 0.5))  # 0.3 is within chance
    assert tables.number_claims(printed, stated, nearest, 8.0 * half, in_map)[2].verdict == "differs"


def by_name(made: Made) -> dict[str, tuple[str, str, Verdict]]:
    claims = {claim.name: claim[1:] for claim in made.claims}
    assert len(claims) == len(made.claims)
    return claims


@pytest.fixture
def ppo_is_unconverged(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (curves, tables):
        monkeypatch.setattr(module, "unconverged_policy", lambda folder: "sac")


@pytest.fixture
def process_is_shipped(monkeypatch: pytest.MonkeyPatch) -> None:
    course = Course([{k: -9.0 + min(k, 3) for k in range(9)}] * 2, [{100.0: 1.0}] * 2, 9_000.0, 7.0, 5)
    monkeypatch.setattr(
        strategies, "process", lambda settings: {name: [spec, spec] for name, spec in SHIPPED_SPECS.items()}
    )
    for module in (curves, tables):
        monkeypatch.setattr(module, "courses_of", lambda settings, delay: dict.fromkeys(SHIPPED_SPECS, course))


@pytest.mark.usefixtures("process_is_shipped")
def test_random_table__has_every_printed_number_and_the_papers_process() -> None:
    made = tables.reproduce_random_table(SETTINGS)
    claims, (stated, in_map, process) = by_name(made), made.sheets
    assert len(claims) == 11 + 9 + 2 + 7 + 2 + 1 + 4
    assert [row[0] for row in in_map.rows] == ["0.1 s", "0.2 s", "0.25 s", "0.3 s"]
    collides = map_bound.collides_in_map(STATED._replace(step_s=0.2), 100)
    assert in_map.rows[1][1].value == pytest.approx(collides.mean())  # as many worlds as in the list
    length = "2 of 5 seeds, 9,000 decisions, 7 CPU-s, last third +0.00 of a rise of 3.0"
    assert claims["PPO by the process"][0].endswith(f"(PPO: {length})") and f"SAC: {length}." in process.note
    rate = claims["Non-E, collision rate"]
    assert rate == ("80.0 % [71.1, 86.7]", "96.0 % [90.2, 98.4], undecided", "differs")
    rows = {name: [each and each.value for each in cells] for name, *cells in stated.rows}
    assert rows[E_V2X_BM] == pytest.approx([0.6, *GOLDEN[STATED][E_V2X_BM][1:]])
    assert rows["least possible (proven)"][1] == pytest.approx(strategies.proven_least_harm(STATED, 100).mean())
    driven = eb.evaluate("paper-random-map", "full_brake,ppo", episodes=100, harm_count="first")
    rows = {name: cells for name, *cells in process.rows}
    assert [*rows] == [NON_E, E_V2X_BM, "PPO", HYBRID_PPO, "SAC", "Hybrid SAC"]
    assert rows[NON_E][1] == driven["full_brake"]["first_impact_harm"].mean() and rows["PPO"][3] is None
    assert [each.value for each in rows["PPO"][:3]] == pytest.approx(
        [driven["ppo"][key].mean() for key in ("collided", "first_impact_harm", "total_harm")]
    )
    assert "means over seeds" in process.note


@pytest.mark.usefixtures("ppo_is_unconverged")
def test_hybrid_table__has_every_printed_number() -> None:
    claims = by_name(tables.reproduce_hybrid_table(SETTINGS))
    assert len(claims) == 6 + 2
    assert claims["avoided"] == ("at most 737 + 1,263 = 2,000", "", "cannot be")
    rows = {name: claims[name][2] for name in claims if name.startswith(("Standalone", "Hybrid"))}
    assert {*rows.values()} <= {"undecided", "cannot be"} and len(rows) == 4


def test_safety_bound__is_exceeded_where_algorithm_1_foresees_less_than_it_does() -> None:
    does, bound = (
        report_outcome(HYBRID_PPO, Reading(hybrid=reported), 100, "sac")[1] for reported in ("realised", "predicted")
    )
    hybrid = strategies.strategies(STATED, 100, {"PPO": "sac"})[HYBRID_PPO]
    assert strategies.above_bound(hybrid) == (does > bound + 1e-9).sum() > 0


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
    claim = curves.advantage_claim({"10-12 m": (lines, near), "12-14 m": (lines, far)})
    text = "minus E-V2X-BM, by distance: PPO -8.00, -2.00; SAC -4.00, -2.00"
    assert claim.ours == f"holds in 2 of 2: {text}" and claim.verdict == "agrees"
    assert curves.advantage_claim({"10-12 m": (lines, far), "12-14 m": (lines, near)}).verdict == "differs"


def test_time__alone_makes_harm_certain() -> None:
    claim = curves.time_claim(replace(SETTINGS, episodes=200))
    least = [float(text) for text in re.findall(r"(\d+\.\d\d) at", claim.ours)]
    assert claim.verdict == "agrees" and least == sorted(least) and least[0] < 0.3 * least[-1]


@pytest.mark.usefixtures("process_is_shipped")
def test_distance__figure_and_tables_have_the_same_numbers() -> None:
    made = curves.reproduce_distance(SETTINGS)
    assert len(by_name(made)) == 2 * 4 + 1 + 3 + 2 + 2
    stated, *others = (axes.lines for axes in made.figures[0].figure.axes)
    for lines, sheet in zip((stated, *others), made.sheets, strict=True):
        rows = {name: [each.value for each in cells] for name, *cells in sheet.rows}
        shown = {line.get_label(): line.get_ydata().tolist() for line in lines}
        assert {name: rows[name] for name in shown} == shown and {NON_E, "PPO", "SAC"} <= {*shown}
        assert (PROVEN in rows) == (lines is stated) and EXPECTED in rows
    assert len(others) == 2 and "paper's process" in made.sheets[2].title


@pytest.mark.parametrize(("spec", "outcome"), [("sac", "differs"), ("e_v2x_bm:pairwise", "agrees")])
def test_illustration__counts_the_worlds_in_which_the_hybrid_is_not_the_better(monkeypatch, spec, outcome) -> None:
    monkeypatch.setattr(curves, "unconverged_policy", lambda folder: spec)
    (claim,) = curves.reproduce_illustration(SETTINGS).claims
    agents = [spec, f"{spec}+episode:pairwise", "e_v2x_bm:pairwise"]
    result = eb.evaluate(DISTANCE, [*dict.fromkeys(agents)], episodes=100)
    alone, hybrid, baseline = (result[each]["first_impact_harm"] for each in agents)
    count = (hybrid > np.minimum(alone, baseline) + 1e-9).sum()
    assert claim.ours.startswith(f"not in {count} of 100 worlds; predicted") and claim.verdict == outcome


def test_delays__in_the_world_of_the_figure() -> None:
    made = curves.reproduce_delays(replace(SETTINGS, episodes=50))
    assert {name: claim[2] for name, claim in by_name(made).items()} == dict.fromkeys(
        ("learning harms least", "robust", "time"), "agrees"
    ) | {"room": "undecided"}
    (sheet,) = made.sheets
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
    predicted = [plan(Reading(base), 5_000).harm.mean() for base in (DISTANCE, RANDOM)]
    assert [f"{each:.2f}" for each in predicted] == ["3.07", "9.38"]  # printed: 9.85


def test_trajectories_and_accelerations__have_these_numbers() -> None:
    made = trajectories.reproduce_trajectories(SETTINGS), trajectories.reproduce_accelerations(SETTINGS)
    record = trajectories.record_all(STATED, tuple(SHIPPED_SPECS.items()))["PPO", 1]
    assert record.gaps_m[-1] == pytest.approx([0.16, 1.84], abs=0.005) and record.impacts.number.sum() == 0.0
    assert record.last.harm("first")[0] == record.last.harm("total")[0] == 0.0
    assert len(made[0].figures) == 2 and len(made[1].sheets[0].rows) == 8
    claims = {(k, *claim) for k, item in enumerate(made) for claim in item.claims}
    assert claims == {
        (0, "alike in Scenario 1", "does not hold: root mean square 2.06 m against 0.88 m", "does not hold",
         "undecided"),
        (0, "PPO from Vehicle 3", "holds: mean gap 5.92 m under SAC, 6.70 m under PPO", "holds", "undecided"),
        (0, "SAC from Vehicle 1", "holds: mean gap 3.28 m under PPO, 4.05 m under SAC", "holds", "undecided"),
        (1, "alike in Scenario 1", "does not hold: root mean square difference 3.13 m/s² against 2.16 m/s²",
         "does not hold", "undecided"),
        (1, "PPO accelerates", "holds: first command +7.00 m/s²", "holds", "undecided"),
        (1, "SAC decelerates", "holds: braking in 100 % of the time it moves", "holds", "undecided"),
        (1, "PPO is smoother", "does not hold: ups and downs 17.4 m/s² under PPO, 8.9 m/s² under SAC", "holds",
         "undecided"),
    }  # fmt: skip


def test_shapes__need_our_policies_and_all_seeds_of_the_papers_process(monkeypatch: pytest.MonkeyPatch) -> None:
    calm = Course([{k: -9.0 + min(k, 3) for k in range(9)}] * 2, [{100.0: 1.0}] * 2, planned_seeds=2)
    monkeypatch.setattr(trajectories, "courses_of", lambda settings, group: {"PPO": calm})

    def verdict(*values: float) -> Claim:
        return trajectories.claims_of([{"x": ("1 m", value)} for value in values], SETTINGS)[0]

    assert verdict(-1.0, 1.0) == Claim("x", "holds: 1 m", "does not hold", "undecided")
    seeds = "by the paper's process, by seed: holds, holds"
    assert verdict(-1.0, 1.0, -2.0, -3.0) == Claim("x", f"holds: 1 m; {seeds}", "does not hold", "agrees")
    assert verdict(-1.0, 1.0, -2.0, 3.0).verdict == verdict(1.0, 1.0, -2.0, -3.0).verdict == "undecided"
    assert verdict(1.0, -1.0, 2.0, 3.0).verdict == "differs"
    still = calm._replace(returns=[{k: -9.0 + k for k in range(9)}] * 2)
    for course in (still, calm._replace(returns=calm.returns[:1])):
        monkeypatch.setattr(trajectories, "courses_of", lambda settings, group, course=course: {"PPO": course})
        assert verdict(-1.0, 1.0, -2.0, -3.0).verdict == "undecided"


def test_figures__of_positions_and_commands_are_those_of_the_records() -> None:
    record = trajectories.record_all(STATED, tuple(SHIPPED_SPECS.items()))["PPO", 1]
    road = trajectories.road_figure(dict.fromkeys([(name, 1) for name in "abcd"], record), "c").axes[0]
    arrows = [line for line in road.lines if line.get_marker() == ">"]
    assert len(arrows) == 3
    for i, line in enumerate(arrows):
        at = np.interp(np.arange(int(record.time_s[-1]) + 1), record.time_s, record.positions_m[:, i])
        assert line.get_xdata() == pytest.approx(at) and {*line.get_ydata()} == {i + 1}
    panels = dict.fromkeys([(name, 1) for name in "abcd"], record)
    profile = trajectories.profiles_figure({"stated": panels}, "c").axes[0]
    assert np.array_equal(profile.lines[1].get_ydata(), record.command_mps2[:, 1])


def test_paper_rows__are_consistent() -> None:
    for row in (*RANDOM_TEST, *HYBRID_TEST):
        assert row.collision_rate == pytest.approx(row.collisions / row.episodes, abs=5e-5)
        if row.harm_decrease is not None:
            assert row.harm_decrease == pytest.approx(1 - row.average_harm / 33.5878, abs=2e-4)
