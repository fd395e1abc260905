"""Tables and curves: numbers recorded from version 0.5, groups and verdicts by hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.report.paper_rows import PAPER_ROWS, PaperRow
from ethbrake_marl.extensions.reproduction import curves, register, tables, trajectories
from ethbrake_marl.extensions.reproduction.made import Settings
from ethbrake_marl.extensions.reproduction.readings import (
    COUPLED,
    DISTANCE,
    EARLY,
    FOUR,
    NON_ETHICAL,
    PPO,
    PREDICTED,
    PROVEN,
    RANDOM,
    READINGS,
    REALISED,
    SAC,
    STATED,
    drive,
    driven,
    harms,
    least_harm,
)
from ethbrake_marl.files.sheet import Estimate

SETTINGS = Settings(Path("unused"), episodes=100)

# collisions, first-impact harm, total harm, predicted harm in the first 100 worlds, by version 0.5
GOLDEN = {
    (RANDOM, STATED): {
        "full_brake": (80, 21.01116356815893, 22.464131799726196, None),
        "e_v2x_bm:pairwise": (60, 17.195162763975528, 18.491602802513473, 8.559600828714368),
        "e_v2x_bm": (60, 13.67244358932681, 14.448446979076754, 13.672443589326782),
        "sac": (60, 6.222264735090079, 6.512750651973412, None),
        "ppo": (60, 6.072011927547129, 6.326495805283884, None),
        "ppo+episode": (60, 6.072011927547129, 6.326495805283884, 6.072011927547129),
        "ppo+episode:pairwise": (60, 6.9340617463633585, 7.164829747133655, 6.055780908806861),
    },
    (RANDOM, EARLY): {
        "full_brake": (96, 31.74147533004871, 32.511432448520004, None),
        "e_v2x_bm:pairwise": (49, 16.73908660822241, 18.211210127234533, 6.8928258915753995),
        "ppo+episode:pairwise": (49, 3.463970974223885, 3.683772674937231, 3.3204208348440165),
    },
    (DISTANCE, STATED): {
        "full_brake": (100, 28.117547669898304, 28.38319535024233, None),
        "e_v2x_bm:pairwise": (68, 12.61114288160522, 13.102561622377982, 3.3187025173271767),
        "ppo+episode:pairwise": (67, 4.479917782125832, 4.652749779492837, 2.03204383932475),
    },
}


@pytest.mark.parametrize("where", GOLDEN, ids=lambda where: f"{where[0]}, {where[1].name}")
def test_numbers__are_those_of_version_0_5(where) -> None:
    name, reading = where
    scenario, agents = reading.scenario(name), {spec: spec for spec in GOLDEN[where]}
    numbers = tables.numbers_of(drive(scenario, agents, 100), least_harm(scenario, 100))
    for spec, (collisions, first, total, predicted) in GOLDEN[where].items():
        own = numbers[spec]
        assert own["collision rate"].value == collisions / 100
        close = {"rel": 5e-4} if spec == "e_v2x_bm" else {"rel": 1e-12}  # the search for its deceleration is another
        assert own["average harm"].value == pytest.approx(first, **close)
        assert own["total harm"].value == pytest.approx(total, **close)
        if predicted is None:
            assert "predicted harm" not in own
        else:
            assert own["predicted harm"].value == pytest.approx(predicted, **close)
    for own in numbers.values():
        assert own["average harm"].value >= numbers[tables.NOBODY]["average harm"].value > 0.0
        assert own["collision rate"].value >= numbers[tables.NOBODY]["collision rate"].value


def test_readings__differ_in_the_latency_of_vehicle_2_alone() -> None:
    stated, early = (reading.scenario("paper-delay-high").model_dump() for reading in READINGS)
    assert [stated.pop("latency_s"), early.pop("latency_s")] == [(0.0, 0.8, 1.2), (0.0, 0.2, 1.2)]
    assert stated == early


def printed(table: str, agent: str) -> PaperRow:
    return next(row for row in PAPER_ROWS if (row.table, row.agent) == (table, agent))


def test_printed__hybrid_avoids_more_than_its_parts_can() -> None:
    parts = [printed("hybrid test", agent) for agent in ("E-V2X-BM", "Standalone DRL", "Hybrid")]
    verdict = tables.selection_verdict(*parts)
    assert verdict.outcome == "cannot agree" and verdict.because.endswith(
        "it avoids at most 737 + 1,263 = 2,000 collisions; printed: 2,005"
    )
    assert tables.selection_verdict(*parts[:2], replace(parts[2], collisions=3_000)).outcome == "agrees"


def beside(title: str, harm: float, rate: float, least: float = 0.0, predicted: float = 1.0) -> tables.Beside:
    exact = {
        "collision rate": Estimate(rate, None),
        "average harm": Estimate(harm, None),
        "total harm": Estimate(harm + 1.0, None),
        "predicted harm": Estimate(predicted, None),
        "harm decrease": Estimate(0.7059, None),
    }
    nobody = {"collision rate": Estimate(0.0, None), "average harm": Estimate(least, None)}
    return tables.Beside(title, 10, {REALISED: exact, tables.NOBODY: nobody}, {"E-V2X-BM": (REALISED,)})


def test_rows__are_compared_under_every_reading_and_name_the_nearest() -> None:
    row = printed("random test", "E-V2X-BM")
    one, other = beside("one", 19.2, 0.65), beside("other", 9.9, 0.852, least=9.95, predicted=9.0)
    found = {each.what: each for each in tables.compare_rows([row], [one, other])}
    assert {what: each.outcome for what, each in found.items()} == {
        "E-V2X-BM, collision rate (one)": "differs",
        "E-V2X-BM, average harm (one)": "differs",
        "E-V2X-BM, harm decrease (one)": "agrees",
        "E-V2X-BM, collision rate (other)": "agrees",
        "E-V2X-BM, average harm (other)": "cannot agree",
        "E-V2X-BM, harm decrease (other)": "agrees",
    }
    assert "nearest: E-V2X-BM, realised (other), 9.90" in found["E-V2X-BM, average harm (one)"].because
    nearer = tables.compare_rows([row], [beside("one", 19.2, 0.65, predicted=9.8)])[1]
    assert f"nearest: {PREDICTED} (one), 9.80, which agrees" in nearer.because


def test_by_distance__groups_are_2_m_wide_and_keep_every_world() -> None:
    scenario = STATED.scenario(DISTANCE)
    result = driven(DISTANCE, STATED, {NON_ETHICAL: "full_brake"}, 100)
    alert = scenario.sample(100, 7)
    total, harm = alert.gaps_m.sum(axis=1), result[NON_ETHICAL]["first_impact_harm"]
    at, groups = curves.by_distance(result, harms(result, scenario))
    assert [*groups] == ["10-12 m", "12-14 m", "14-16 m", "16-18 m", "18-20 m"]
    for k, (each, middle) in enumerate(zip(groups.values(), at, strict=True)):
        rows = (total >= 10.0 + 2.0 * k) & (total < 12.0 + 2.0 * k)
        assert np.array_equal(each[NON_ETHICAL], harm[rows]) and middle == pytest.approx(total[rows].mean())
        assert len(each[PROVEN]) == rows.sum()


def test_driven__is_shared_by_items_and_differs_by_reading() -> None:
    agents = {NON_ETHICAL: "full_brake"}
    assert driven(RANDOM, STATED, agents, 5) is driven(RANDOM, STATED, agents, 5)
    assert driven(RANDOM, STATED, agents, 5) is not driven(RANDOM, EARLY, agents, 5)


@pytest.fixture
def ppo_is_unconverged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(curves, "unconverged", lambda settings: "ppo-obstacle")


@pytest.mark.usefixtures("ppo_is_unconverged")
def test_illustration__hybrid_takes_the_lower_only_with_the_realised_bound() -> None:
    made = curves.reproduce_illustration(SETTINGS)
    found = {each.what: each for each in made.verdicts}
    assert found["the hybrid, realised H* takes the lower of the two (as stated)"].outcome == "agrees"
    worse = found["the hybrid, predicted H* takes the lower of the two (as stated)"]
    result = curves.drive_hybrid(DISTANCE, SETTINGS, STATED)
    harm = harms(result, STATED.scenario(DISTANCE))
    count = (harm[curves.HYBRID_PREDICTED] > np.minimum(harm[curves.ALONE], harm[REALISED]) + 1e-9).sum()
    assert worse.outcome == "differs" and worse.because.startswith(f"in {count} of 100 worlds") and count > 0
    assert [drawn.stem for drawn in made.figures] == ["hybrid-illustration"]


@pytest.mark.usefixtures("ppo_is_unconverged")
def test_tables__have_every_printed_number_under_every_reading() -> None:
    hybrid, random = tables.reproduce_hybrid_table(SETTINGS), tables.reproduce_random_table(SETTINGS)
    assert (len(hybrid.verdicts), len(random.verdicts)) == (1 + 4 * 6, 2 * 11)
    assert len({each.what for each in [*hybrid.verdicts, *random.verdicts]}) == 25 + 22
    assert hybrid.verdict.outcome == "cannot agree"
    stated = random.sheets[1]
    assert stated.title == "as stated" and [row[0] for row in stated.rows][-1] == tables.NOBODY
    assert stated.rows[0][1].value == 0.8 and stated.rows[0][-1].value == 0.0
    assert random.sheets[0].rows[1] == ("E-V2X-BM", "8,520", "85.2 %", "9.8772", "70.59 %")
    assert hybrid.sheets[0].rows[2] == ("Hybrid", "2,995", "59.9 %", "7.3641")


def test_distance__says_where_the_paper_is_right() -> None:
    made = curves.reproduce_distance(SETTINGS)
    found = {each.what: each.outcome for each in made.verdicts}
    assert len(found) == 20 and found["PPO harms less than E-V2X-BM, realised over the whole range (as stated)"] in (
        "agrees", "undecided",
    )  # fmt: skip
    assert [row[0] for row in made.sheets[0].rows] == [*FOUR, PREDICTED, PROVEN]


def test_delays__in_the_world_of_the_figure_are_those_of_the_page() -> None:
    made = curves.reproduce_delays(replace(SETTINGS, episodes=5))
    (stated, *_), rows = made.sheets, {}
    rows = {row[0]: [f"{each.value:.2f}" for each in row[1:]] for row in stated.rows}
    assert stated.title == "d = 7, 7 m; v = 20, 18, 20 m/s; as stated"
    assert rows == {
        NON_ETHICAL: ["24.08", "27.78", "45.99"],
        REALISED: ["0.00", "0.00", "47.35"],
        COUPLED: ["0.00", "0.00", "43.82"],
        SAC: ["0.00", "0.00", "16.44"],
        PPO: ["0.00", "0.00", "15.61"],
        PREDICTED: ["0.00", "0.00", "22.26"],
        PROVEN: ["0.00", "0.00", "15.28"],
    }
    assert [drawn.stem for drawn in made.figures] == ["harm-delays-world", "harm-delays-list"]


def test_trajectories__end_as_the_page_says() -> None:
    (sheet,) = trajectories.reproduce_trajectories(SETTINGS).sheets
    told = [[cell.in_words for cell in row[1:]] for row in sheet.shown() if row[0].in_words == "as stated"]
    assert told == [
        ["1", "PPO", "0", "0.00", "0.16", "1.84"],
        ["1", "SAC", "0", "0.00", "1.01", "0.99"],
        ["1", "E-V2X-BM, coupled", "0", "0.00", "1.03", "0.97"],
        ["1", "Non-ethical (full braking)", "4", "28.98", "7.35", "0.00"],
        ["2", "PPO", "0", "0.00", "0.19", "4.81"],
        ["2", "SAC", "0", "0.00", "1.17", "3.83"],
        ["2", "E-V2X-BM, coupled", "0", "0.00", "2.68", "2.32"],
        ["2", "Non-ethical (full braking)", "4", "30.98", "9.86", "0.00"],
    ]


def test_trajectories_and_accelerations__have_the_verdicts_of_the_page() -> None:
    made = [trajectories.reproduce_trajectories(SETTINGS), trajectories.reproduce_accelerations(SETTINGS)]
    found = {each.what: (each.outcome, each.because) for one in made for each in one.verdicts}
    assert len(found) == 14
    assert found["Vehicle 2 of PPO and SAC is nearer together in Scenario 1 than in 2 (as stated)"] == (
        "differs", "not so: root mean square 2.06 m against 0.88 m, 1.18 m",
    )  # fmt: skip
    assert found["Scenario 2: PPO keeps the larger distance to Vehicle 3 (Vehicle 2 acts at 0.2 s)"] == (
        "agrees", "mean gap 6.31 m under SAC, 6.99 m under PPO, -0.68 m",
    )  # fmt: skip
    assert found["Scenario 2: SAC keeps the larger distance to Vehicle 1 (as stated)"] == (
        "agrees", "mean gap 3.28 m under PPO, 4.05 m under SAC, -0.78 m",
    )  # fmt: skip
    assert found["the profiles are more alike in Scenario 1 than in 2 (as stated)"] == (
        "differs", "not so: root mean square difference 3.13 m/s² against 2.16 m/s², 0.97 m/s²",
    )  # fmt: skip
    assert found["Scenario 2: SAC decelerates throughout most of it (Vehicle 2 acts at 0.2 s)"] == (
        "agrees", "braking in 97 % of the time it moves, -0.47 m/s²",
    )  # fmt: skip
    assert found["Scenario 2: PPO's profile is the smoother one (as stated)"] == (
        "differs", "not so: ups and downs 17.4 m/s² under PPO, 8.9 m/s² under SAC, 8.50 m/s²",
    )  # fmt: skip


@pytest.mark.parametrize("gap", register.GAPS, ids=lambda gap: gap.name)
def test_register__every_gap_has_alternatives_or_says_why_not(gap: register.Gap) -> None:
    assert bool(gap.alternatives) != bool(gap.otherwise) and gap.paper and gap.ours


def test_register__alternatives_are_measured_as_they_say() -> None:
    episodes = 20
    _, base = register.measure(register.Alternative(""), episodes)
    named = {f"{gap.name}: {each.value}": each for gap in register.GAPS for each in gap.alternatives}
    assert len(named) == 23

    def harm_of(row: str) -> dict[str, np.ndarray]:
        return register.measure(named[row], episodes)[1]

    for name, spec in (("PPO", "ppo"), (REALISED, "e_v2x_bm:pairwise")):
        plain = eb.evaluate(RANDOM, spec, episodes=episodes, measures="sampled_harm")[spec]
        assert np.array_equal(base[name], plain["first_impact_harm"])
        assert np.array_equal(harm_of("which impacts count: every impact")[name], plain["total_harm"])
        sampled = harm_of(f"impacts at samples or exact: {named_of(named, 'the paper')}")
        assert np.array_equal(sampled[name], plain["sampled_harm"])
    predicted = harm_of("H* of E-V2X-BM, predicted or realised: predicted, pair by pair")
    assert predicted[REALISED].mean() < base[REALISED].mean() and np.array_equal(predicted[PPO], base[PPO])
    other = harm_of("seed of the test: 8")
    assert np.array_equal(other[PPO], eb.evaluate(RANDOM, "ppo", episodes=episodes, seed=8)["ppo"]["first_impact_harm"])
    hybrid = harm_of("H* inside the hybrid: hybrid with predicted H*")
    spec = "ppo+episode:pairwise"
    assert np.array_equal(hybrid[PPO], eb.evaluate(RANDOM, spec, episodes=episodes)[spec]["first_impact_harm"])
    early = harm_of("when Vehicle 2 may act: 0.2 s")
    assert early[NON_ETHICAL].mean() > base[NON_ETHICAL].mean()


def named_of(named: dict[str, register.Alternative], beginning: str) -> str:
    return next(each.value for each in named.values() if each.value.startswith(beginning))


def test_register__shows_every_alternative_and_whether_the_order_stays() -> None:
    made = register.reproduce_gaps(replace(SETTINGS, episodes=10))
    listed, measured = made.sheets
    assert len(listed.rows) == len(register.GAPS) and len(measured.rows) == 24
    assert measured.rows[0][:2] == ("our defaults", "")
    order = made.verdicts[-1]
    assert "what Vehicle 1 brakes for: an obstacle" in order.because and order.outcome == "differs"
