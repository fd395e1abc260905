"""Roads, tables, equipage, loads and later alerts: what a scenario may say beside the line."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.agents.protocol import Team
from ethbrake_marl.first_edition.evaluation.identity import worlds_sha256
from ethbrake_marl.first_edition.evaluation.varying import states_of
from ethbrake_marl.first_edition.scenario.ranges import ranges
from ethbrake_marl.first_edition.scenario.sampling import middle_world
from ethbrake_marl.first_edition.scenario.tables import worlds_from_state, worlds_from_table
from tests.refused import refused

PAPER = eb.load_scenario("paper-random")
FIXED = PAPER.replace(gaps_m=40, speeds_mps=20, latency_s=0, early_impacts="keep", horizon_s=30)


def final(scenario):
    """The world once everybody has braked fully, or as its script says."""
    team = Team.of(make_agent("full_brake"), list(scenario.learners))
    return drive(scenario.sample(1, 7).worlds, team, scenario).final


def without(scenario, *keys):
    """What a scenario declares, but these keys."""
    return {key: value for key, value in scenario.declared().items() if key not in keys}


TABLE = {"columns": ["gap_1_m", "speed_2_mps"], "rows": [[5.0, 18.0], [6.0, 19.0], [7.0, 20.0]]}


def tabled(table):
    given = {"gaps_m": 9.0, "speeds_mps": {"uniform": [18, 22]}, "table": table}
    return eb.Scenario(**without(PAPER, *given), **given)


# Two trios of one recording, and one of another.
NAMED = {
    "columns": ["gap_1_m", "recording", "speed_2_mps"],
    "rows": [[5.0, "a.csv: 1-2-3", 18.0], [6.0, "a.csv: 4-5-6", 19.0], [7.0, "b.csv: 1-2-3", 20.0]],
}


LINKS = {"preset": "nominal", "link_latency_s": 0.3, "sensing_s": [1.0, 1.0]}


def lorries(**spread):
    capacity = {"with_load": [7, 5], **spread}
    kinds = {"lorry": {"mass_t": {"with_load": [10, 40]}, "braking_capacity_mps2": capacity}}
    return eb.Scenario(**without(FIXED, "mass_t", "braking_capacity_mps2"), vehicle_types=kinds)


@pytest.mark.parametrize(
    ("friction", "capacity", "gaps_m"),
    [
        (0.6, [4, 7, 7], [40 + 400 / 8 - 400 / 11.772, 40]),  # 4 < 5.886 < 7
        (0.3, [4, 7, 7], [40, 40]),  # all 2.943
        (1.0, [4, 7, 6], [40 + 400 / 8 - 400 / 14, 40 + 400 / 14 - 400 / 12]),  # dry enough
    ],
)
def test_friction__limits_braking(friction, capacity, gaps_m) -> None:
    # Stopping ways are v^2 / (2 min(capacity, 9.81 mu)).
    found = final(FIXED.replace(friction=friction, braking_capacity_mps2=capacity)).gaps_m[0]
    assert found == pytest.approx(np.array(gaps_m), abs=1e-9)


def test_friction__is_one_number_for_the_whole_line_and_moves_nothing_else() -> None:
    wet = PAPER.replace(friction={"uniform": [0.2, 0.9]}, early_impacts="keep")
    worlds, dry = wet.sample(200, 7).worlds, PAPER.replace(early_impacts="keep").sample(200, 7).worlds
    assert 0.2 <= worlds.friction.min() < 0.22 and 0.88 < worlds.friction.max() <= 0.9
    for name in ("braking_capacity_mps2", "driving_capacity_mps2"):
        own, allowed = getattr(dry.vehicles, name), 9.81 * worlds.friction[:, np.newaxis]
        assert (getattr(worlds.vehicles, name) == np.minimum(own, allowed)).all()
        assert (worlds.dry(name) == own).all()
    for name in ("gaps_m", "speeds_mps"):
        assert (getattr(worlds, name) == getattr(dry, name)).all()
    assert wet.bounds("braking_capacity_mps2") == ((9.81 * 0.2, 6.0), (9.81 * 0.2, 7.0), (9.81 * 0.2, 6.0))
    assert wet.bounds("braking_capacity_mps2", dry=True) == ((6.0, 6.0), (7.0, 7.0), (6.0, 6.0))
    assert ranges(wet).names[-1] == "friction"


def test_margin__is_added_to_the_way_on_that_road() -> None:
    short = FIXED.replace(friction=0.3, obstacle_margin_m=1.7)
    assert short.sample(1, 7).worlds.obstacle_gap_m[0] == pytest.approx(1.7 + 400 / (2 * 2.943))
    assert short.farthest_obstacle_m == pytest.approx(1.7 + 400 / (2 * 2.943))


def test_table_of_initial_states__gives_the_same_worlds() -> None:
    wet = PAPER.replace(friction={"uniform": [0.2, 0.9]}, braking_capacity_mps2={"uniform": [3, 9]})
    worlds = wet.sample(50, 3).worlds
    states = states_of(worlds, wet)
    assert list(states[0])[-1] == "friction"
    assert "braking_capacity_2_mps2" in states[0]
    again = worlds_from_table(wet, {name: [state[name] for state in states] for name in states[0]})
    assert (again.road == worlds.road).all()
    assert (again.vehicles.braking_capacity_mps2 == worlds.vehicles.braking_capacity_mps2).all()
    state = {"friction": 0.5, "gaps_m": 7, "speeds_mps": 20, "braking_capacity_mps2": 6}
    assert worlds_from_state(wet, state).friction.tolist() == [0.5]


def test_table__has_one_row_for_each_world_of_which_none_is_torn() -> None:
    found = tabled(TABLE).sample(600, 7).worlds
    rows = np.stack([found.gaps_m[:, 0], found.speeds_mps[:, 1]], axis=1)
    kinds, counts = np.unique(rows, axis=0, return_counts=True)
    assert kinds.tolist() == [[5.0, 18.0], [6.0, 19.0], [7.0, 20.0]]
    assert (np.abs(counts - 200) < 60).all()
    assert np.unique(found.gaps_m[:, 1]).tolist() == [9.0]
    alone = tabled({**TABLE, "weights": [1, 1, 8]}).sample(600, 7).worlds
    assert (alone.speeds_mps[:, [0, 2]] == found.speeds_mps[:, [0, 2]]).all()
    assert abs(np.mean(alone.gaps_m[:, 0] == 7.0) - 0.8) < 0.05
    assert ranges(tabled(TABLE)).names[-1] == "row of the table"
    assert tabled(TABLE).bounds("gaps_m") == ((5.0, 7.0), (9.0, 9.0))
    assert middle_world(tabled(TABLE)).gaps_m[0].tolist() == [6.0, 9.0]
    one = eb.Scenario(**{**FIXED.declared(), "table": {"columns": ["gap_1_m", "mass_3_t"], "rows": [[12, 30]]}})
    assert one.sample(3, 7).worlds.gaps_m.tolist() == [[12.0, 40.0], [12.0, 40.0], [12.0, 40.0]]
    assert one.sample(3, 7).worlds.vehicles.mass_t[:, 2].tolist() == [30.0, 30.0, 30.0]
    stopped = final(one).gaps_m[0].tolist()
    assert stopped == pytest.approx([12 + 400 / 12 - 400 / 14, 40 + 400 / 14 - 400 / 12], abs=1e-9)


def test_table_of_a_file__is_read_once_and_goes_along(empty_folder: Path) -> None:
    whole = {"gap_1_m": 5.5, "gap_2_m": 6.5, "speed_1_mps": 20, "speed_2_mps": 19, "speed_3_mps": 18, "count": 3}
    lines = [",".join(whole), *(",".join(str(value + k) for value in whole.values()) for k in range(14))]
    Path("rows.csv").write_text("\n".join(lines) + "\n\n")
    table = {"file": "rows.csv", "columns": [*whole][:5], "weights": "count"}
    declared = {**without(PAPER, "gaps_m", "speeds_mps"), "name": "mine", "early_impacts": "keep"}
    Path("mine.yaml").write_text(json.dumps({**declared, "table": table}))
    mine = eb.load_scenario(Path("mine.yaml"))
    Path("rows.csv").unlink()
    again = eb.Scenario(**mine.declared()).replace(horizon_s=9)
    assert len(again.table.rows) == 14
    assert again.table.weights == (3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0, 16.0)
    assert (again.sample(50, 7).worlds.gaps_m == mine.sample(50, 7).worlds.gaps_m).all()


def test_recording__goes_with_its_row_and_changes_no_world() -> None:
    found, without_it = tabled(NAMED).sample(300, 7), tabled(TABLE).sample(300, 7)
    assert worlds_sha256(found.worlds, found.index) == worlds_sha256(without_it.worlds, without_it.index)
    of_gap = {5.0: "a.csv: 1-2-3", 6.0: "a.csv: 4-5-6", 7.0: "b.csv: 1-2-3"}
    assert found.kinds["recording"].tolist() == [of_gap[gap] for gap in found.worlds.gaps_m[:, 0].tolist()]
    assert found.take([7, 2]).recordings.tolist() == found.recordings[[7, 2]].tolist()
    assert without_it.recordings is None and "recording" not in without_it.kinds
    assert found.count_kinds() == "; recording: 3 different"
    assert tabled(NAMED).bounds("gaps_m") == ((5.0, 7.0), (9.0, 9.0))
    assert ranges(tabled(NAMED)).names == ranges(tabled(TABLE)).names
    again = eb.Scenario(**tabled(NAMED).declared()).sample(300, 7)
    assert again.recordings.tolist() == found.recordings.tolist()


def test_recording__of_a_rejected_row_is_that_of_the_row_drawn_instead() -> None:
    # 18 m/s, 2 m behind a vehicle at rest: an impact after 0.11 s, before vehicle_2 may act (0.5 s).
    rows = [[2.0, "close", 0.0, 18.0], [40.0, "far", 0.0, 1.0]]
    table = {"columns": ["gap_1_m", "recording", "speed_1_mps", "speed_2_mps"], "rows": rows}
    given = {"gaps_m": 9.0, "speeds_mps": 1.0, "latency_s": [0.0, 0.5, 0.8], "table": table}
    sample = eb.Scenario(**without(PAPER, *given), **given).replace(early_impacts="reject").sample(100, 7)
    assert sample.rejected > 20 and set(sample.recordings.tolist()) == {"far"}


def test_lognormal__is_truncated_as_in_the_textbook() -> None:
    law, u = stats.lognorm(s=0.4, scale=1.1), np.array([0.0, 0.5, 0.975])
    low, high = law.cdf(0.3), law.cdf(3.0)
    shape = {"median": 1.1, "sigma": 0.4, "low": 0.3, "high": 3.0}
    (entry, _) = PAPER.replace(time_gaps_s={"lognormal": shape}).quantities("time_gaps_s")
    assert np.allclose(entry.value(u), law.ppf(low + (high - low) * u), rtol=1e-9, atol=0.0)


@pytest.mark.parametrize(
    ("vehicles", "expected"),
    [
        ({}, ([0.0, 0.3, 0.3], [0.3, 0.3])),
        ({"vehicle_1": {"sends": False}}, ([0.0, 1.0, 2.0], [2.0, 1.0])),
        ({"vehicle_3": {"sends": False, "hears": "none"}}, ([0.0, 0.3, 1.3], [1.3, 1.0])),
        ({"vehicle_2": {"sends": False, "hears": "front"}}, ([0.0, 0.3, 0.3], [1.0, 1.0])),
    ],
)
def test_equipage__who_sends_and_who_hears(vehicles, expected) -> None:
    # Equipage, who sends and who hears: latencies, what Vehicle 3 knows of Vehicle 2, and Vehicle 2 of Vehicle 3.
    # Where Vehicle 1 does not send, one sees it brake, and the other one that; where Vehicle 2 hears the front only,
    # it sees Vehicle 3.
    v2x = {**LINKS, **({"vehicles": vehicles} if vehicles else {})}
    found = FIXED.replace(v2x=v2x).sample(1, 7).worlds.vehicles
    assert (found.latency_s[0].round(12).tolist(), found.known_from_s[0, [2, 1], [1, 2]].round(12).tolist()) == expected


def test_equipage__of_types_is_drawn_with_them() -> None:
    kinds = {"equipped": {"weight": 7}, "without": {"weight": 3, "v2x": {"sends": False, "hears": "none"}}}
    sample = FIXED.replace(vehicle_types=kinds, v2x=LINKS).sample(2000, 7)
    silent, latency = sample.types == "without", sample.worlds.vehicles.latency_s
    second = np.where(silent[:, 0] | silent[:, 1], 1.0, 0.3)
    third = np.where(silent[:, 0] | silent[:, 2], second + 1.0, 0.3)
    assert (latency[:, 1] == second).all()
    assert np.abs(latency[:, 2] - third).max() < 1e-12


def test_spread__is_added_to_what_the_load_gives() -> None:
    spread = lorries(spread={"uniform": [-0.5, 0.5]})
    plain, wide = (scenario.sample(3000, 7).worlds.vehicles for scenario in (lorries(), spread))
    by_load = 7 - 2 * (plain.mass_t - 10) / 30
    assert np.abs(plain.braking_capacity_mps2 - by_load).max() <= 1e-12
    more = wide.braking_capacity_mps2 - by_load
    assert (wide.mass_t == plain.mass_t).all()
    assert -0.5 <= more.min() < -0.49
    assert 0.49 < more.max() <= 0.5
    assert abs(np.corrcoef(wide.mass_t.ravel(), more.ravel())[0, 1]) < 0.02
    assert spread.bounds("braking_capacity_mps2")[0] == (4.5, 7.5)
    assert [f"{key} of vehicle_1" in ranges(spread).names for key in ("braking_capacity_mps2", "mass_t")] == [
        True,
        False,
    ]


def test_alert_s__everybody_goes_on_until_then() -> None:
    # Where the alert comes later, everybody goes on until then: after 2 s the gaps are 2 x 2 m shorter, or longer.
    late = FIXED.replace(alert_s=2, speeds_mps=[20, 18, 20], latency_s=[0, 0.5, 0.8])
    assert late.sample(1, 7).worlds.vehicles.latency_s.tolist() == [[2.0, 2.5, 2.8]]
    now = eb.Scenario(**without(late.replace(gaps_m=[40 + 2 * 2, 40 - 2 * 2]), "alert_s"))
    assert np.abs(final(late).gaps_m - final(now).gaps_m).max() <= 1e-9
    drawn = FIXED.replace(alert_s={"uniform": [1, 5]})
    latency = drawn.sample(100, 7).worlds.vehicles.latency_s
    assert (latency == latency[:, :1]).all()
    assert 1 <= latency.min() < 1.2
    assert 4.8 < latency.max() <= 5
    assert drawn.bounds("latency_s") == ((1.0, 5.0), (1.0, 5.0), (1.0, 5.0))
    assert ranges(drawn).names == ("alert_s",)


# ---------------------------------------------------------------- what is refused

SILENT = {"sends": False, "hears": "none"}


def lognormal(**changes: float) -> eb.Scenario:
    """Gaps of this distribution."""
    return PAPER.replace(gaps_m={"lognormal": {"median": 7.0, "sigma": 0.4, "low": 3.0, "high": 30.0, **changes}})


ROADS: dict[str, Callable[[], object]] = {
    "roles.vehicle_1 = constant:5: must not be above the braking_capacity_mps2 of vehicle_1": lambda: FIXED.replace(
        friction={"uniform": [0.3, 0.9]}, roles={"vehicle_1": "constant:5", "vehicle_2": "learner"}
    ),
    "scenario 'paper-random': friction = 0: must be finite and in (0, 2]": lambda: FIXED.replace(friction=0),
    "must be a number or a distribution; leave the key out if you do not need it": lambda: FIXED.replace(friction=None),
    "scenario 'paper-random': no quantity is random, so all its worlds are the same": lambda: ranges(
        eb.Scenario(**{**FIXED.declared(), "table": {"columns": ["gap_1_m", "mass_3_t"], "rows": [[12, 30]]}})
    ),
    "only with v2x: paper, because messages before the alert are not": lambda: FIXED.replace(alert_s=2, v2x="nominal"),
    "the sum of alert_s and latency_s may be 40 s; it must be below horizon_s (30": lambda: FIXED.replace(alert_s=40),
}


@pytest.mark.parametrize("message", ROADS)
def test_road_or_alert__is_refused(message: str) -> None:
    with refused(message):
        ROADS[message]()


TABLES: dict[str, Callable[[], object]] = {
    "unknown column; did you mean gap_2_m (metres)?": lambda: tabled({**TABLE, "columns": ["gap_1_m", "gap_9_m"]}),
    "scenario 'paper-random': table.columns = [gap_1_m]: must not list a column twice": lambda: tabled(
        {**TABLE, "columns": ["gap_1_m", "gap_1_m"]}
    ),
    "scenario 'paper-random': table.rows[0]: has 1 values; must have one for each of the 2": lambda: tabled(
        {**TABLE, "rows": [[5.0]]}
    ),
    "speed_2_mps must be finite and in [0, 200] m/s (metres per": lambda: tabled({**TABLE, "rows": [[5.0, -1.0]]}),
    "scenario 'paper-random': table.weights: must be 3 numbers, one per row, all above 0 and with a finite": lambda: (
        tabled({**TABLE, "weights": [1, 1]})
    ),
    "scenario 'paper-random': table.file = other.csv: cannot be combined with rows; leave one of them": lambda: tabled(
        {**TABLE, "file": "other.csv"}
    ),
    "scenario 'paper-random': table.rows: must be given as lists here; only load_scenario reads the rows": lambda: (
        tabled({**TABLE, "weights": "count"})
    ),
    "scenario 'paper-random': gaps_m = 9: must be left out, because the table has columns of": lambda: tabled(
        {"columns": ["gap_1_m", "gap_2_m"], "rows": [[5, 6]]}
    ),
    "table.rows[0][1] = 12: recording must be a text of 1 to 200 printable": lambda: tabled(
        {**NAMED, "rows": [[5.0, 12, 18.0]]}
    ),
    'table.rows[1][1] = "": recording must be a text of 1 to 200 printable': lambda: tabled(
        {**NAMED, "rows": [[5.0, "a", 18.0], [5.0, "", 18.0]]}
    ),
    "recording must be a text of 1 to 200 printable characters, such as 'drive_1.csv: 2-3-4'": lambda: tabled(
        {**NAMED, "rows": [[5.0, "a\tb", 18.0]]}
    ),
    "table.rows[0][2] = fast: speed_2_mps must be a number": lambda: tabled({**NAMED, "rows": [[5.0, "a", "fast"]]}),
    "table.columns = [recording]: must also have a column of numbers": lambda: tabled(
        {"columns": ["recording"], "rows": [["a"]]}
    ),
    "scenario: table.file = ../rows.csv: must be a relative path in the scenario's folder": lambda: eb.load_scenario(
        {**PAPER.declared(), "table": {"file": "../rows.csv"}}
    ),
    "scenario: no.csv: the file does not": lambda: eb.load_scenario({**PAPER.declared(), "table": {"file": "no.csv"}}),
}


@pytest.mark.parametrize("message", TABLES)
def test_table__is_refused(message: str) -> None:
    with refused(message):
        TABLES[message]()


DISTRIBUTIONS: dict[str, Callable[[], object]] = {
    "scenario 'paper-random': gaps_m.lognormal = {median: 0, sigma: 0.4, low: 3, high": lambda: lognormal(median=0.0),
    "scenario 'paper-random': gaps_m.lognormal = {median: 7, sigma: 0, low: 3, high: 30}": lambda: lognormal(sigma=0.0),
    "scenario 'paper-random': gaps_m.lognormal = {median: 7, sigma: 0.4, low": lambda: lognormal(low=3.0, high=3.0),
    "[low, high]": lambda: lognormal(low=1e3, high=2e3),
    "must be finite and in (0, 100] m/s2 (metres per second squared)": lambda: lorries(spread={"uniform": [-5, 0]}),
    "scenario 'paper-random': vehicle_types.lorry.braking_capacity_mps2.spread = 0.3": lambda: lorries(spread=0.3),
}


@pytest.mark.parametrize("message", DISTRIBUTIONS)
def test_distribution__is_refused(message: str) -> None:
    with refused(message):
        DISTRIBUTIONS[message]()


LINKED: dict[str, Callable[[], object]] = {
    "preset paper generates no messages; leave it out": lambda: PAPER.replace(v2x={"vehicles": {"vehicle_2": SILENT}}),
    "false, hears: none}: has no effect, because v2x": lambda: PAPER.replace(vehicle_types={"car": {"v2x": SILENT}}),
    "scenario 'paper-random': v2x.vehicles.vehicle_4: unknown vehicle": lambda: PAPER.replace(
        v2x={**LINKS, "vehicles": {"vehicle_4": SILENT}}
    ),
    "scenario 'paper-random': v2x = {preset: nominal, senses: none, link_latency_s: 0.3, vehi...": lambda: (
        PAPER.replace(
            v2x={"preset": "nominal", "link_latency_s": 0.3, "vehicles": {"vehicle_2": SILENT}, "senses": "none"}
        )
    ),
}


@pytest.mark.parametrize("message", LINKED)
def test_equipage__is_refused(message: str) -> None:
    with refused(message):
        LINKED[message]()


def test_table_of_a_file__is_refused_with_the_row_of_the_file(empty_folder: Path) -> None:
    Path("rows.csv").write_text("speed_1_mps\n" + "".join(f"{20 + row}\n" for row in range(1_200)))
    with refused("table.rows[181][0] = 201: speed_1_mps must be finite and in [0, 200] m/s (metres per second)"):
        eb.load_scenario({**PAPER.declared(), "table": {"file": "rows.csv", "columns": ["speed_1_mps"]}})


def test_state_that_is_given__needs_a_channel_that_draws_nothing() -> None:
    kinds = {"equipped": {"weight": 7}, "without": {"weight": 3, "v2x": SILENT}}
    with refused("initial_state: with v2x: nominal, it is random what the vehicles learn about each other"):
        worlds_from_state(FIXED.replace(vehicle_types=kinds, v2x=LINKS), {"gaps_m": [7, 7], "speeds_mps": [20, 20, 20]})
