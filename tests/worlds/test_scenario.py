"""What a scenario is, and the worlds that are drawn from it."""

import copy
import json
import pickle
from collections import UserDict, UserList, deque
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from ethbrake_marl.episode.observe import View
from ethbrake_marl.episode.state import NUMBER
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.yaml import read_yaml
from ethbrake_marl.worlds import catalogue, sampling, scenario_file
from ethbrake_marl.worlds.catalogue import group_of_scenarios, list_scenarios, load_scenario
from ethbrake_marl.worlds.channel_table import values_of
from ethbrake_marl.worlds.counters import uniform_numbers
from ethbrake_marl.worlds.describe import clusters_of, columns_of, fixed_columns
from ethbrake_marl.worlds.open_game import views_of
from ethbrake_marl.worlds.quantities import QUANTITIES
from ethbrake_marl.worlds.sampling import WorldPool
from ethbrake_marl.worlds.scenario import Scenario
from tests.fixtures.scenarios import SHIPPED
from tests.refused import refused

PAPER = load_scenario("paper-random")
LINE: dict[str, Any] = {
    "name": "line", "gaps_m": 7, "speeds_mps": 20, "braking_capacity_mps2": [6, 7, 6], "driving_capacity_mps2": 5,
    "mass_t": [4.5, 5.5, 5.9], "latency_s": [0, 0.5, 0.8],
}  # fmt: skip


def line(**changes: Any) -> Scenario:
    return Scenario(**{**LINE, **changes})


def bits(state: Any) -> list[bytes]:
    return [array.tobytes() for array in state[:5]]


# ---------------------------------------------------------------- lists of worlds


@pytest.mark.parametrize(
    "name", ["paper-random", "realistic-mixed", "cooperation-4-congested", "mixture-three-tests", "standards-r157"]
)
def test_world_k__is_the_same_alone_and_in_any_batch(name: str) -> None:
    scenario = load_scenario(name)
    batch = scenario.sample(40, 3, first=10**15)
    assert batch.clock[:, NUMBER].tolist() == list(range(10**15, 10**15 + 40))
    for k in (0, 17, 39):
        assert bits(scenario.sample(np.int64(1), np.uint64(3), first=10**15 + k)) == bits(batch.take([k]))
    others = [scenario.sample(40, 3, first=10**15, purpose="training"), scenario.sample(40, 2**200, first=10**15)]
    assert bits(batch) not in [bits(other) for other in others]


def test_rejected_draws__are_counted_and_drawn_again() -> None:
    # Vehicle 1 brakes with 6 m/s2 and is 3 m closer to Vehicle 2 at 1 s, when this one may act: 2 m are too little.
    close = line(vehicles=2, gaps_m={"choice": [2, 4]}, braking_capacity_mps2=6, mass_t=5, latency_s=[0, 1])
    drawn = close.replace(early_impacts="reject").draw(200, 7)
    assert drawn.worlds.gaps_m.ravel().tolist() == [4.0] * 200
    rejected, pending = 0, np.arange(200)
    for attempt in range(100):
        pending = pending[uniform_numbers(7, "list", attempt, pending)(16, ())[:, 0] < 0.5] if len(pending) else pending
        rejected += len(pending)
    assert drawn.rejected == rejected > 100
    kept = close.sample(200, 7).take(close.sample(200, 7).gaps_m[:, 0] == 4.0)
    assert bits(kept) == bits(drawn.worlds.take(kept.clock[:, NUMBER].astype(int)))


@pytest.mark.parametrize(
    ("gap_m", "roles", "rejected"),
    [
        (3.001, {"vehicle_1": "full_brake"}, False),
        (2.999, {"vehicle_1": "full_brake"}, True),
        (0.999, {"vehicle_1": "constant:2"}, True),
    ],
)
def test_early_impact__follows_from_the_roles(gap_m: float, roles: dict[str, str], rejected: bool) -> None:
    roles = {**roles, "vehicle_2": "learner"}
    pair = line(vehicles=2, gaps_m=gap_m, braking_capacity_mps2=6, mass_t=5, latency_s=[0, 1], roles=roles)
    pair = pair.replace(early_impacts="reject")
    if rejected:
        with refused("early_impacts: reject, but in all 1000 draws of world 0 an impact happens before vehicle_2"):
            pair.sample(3, 0)
    else:
        assert pair.draw(1, 0).rejected == 0


# ---------------------------------------------------------------- quantities that follow from others

ROLES = {"vehicle_1": "constant:2", "vehicle_2": "learner", "vehicle_3": "my_agent:x"}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"time_gaps_s": [0.5, 2], "speeds_mps": [30, 20, 10]}, {"gaps_m": [10, 20], "speeds_mps": [30, 20, 10]}),
        (
            {"line_speed_mps": 20, "speed_deviations_mps": [1, -2, 0.5]},
            {"gaps_m": [7, 7], "speeds_mps": [21, 18, 20.5]},
        ),
        (
            {"time_gaps_s": 0.5, "line_speed_mps": 20, "speed_deviations_mps": [0, -2, 2]},
            {"gaps_m": [9, 11], "speeds_mps": [20, 18, 22]},
        ),
        ({"friction": 0.5}, {"braking_capacity_mps2": [0.5 * 9.81] * 3, "driving_capacity_mps2": [0.5 * 9.81] * 3}),
        (
            {"friction": 0.5, "grip": [1, 0.9, 0.8]},
            {name: [4.905, 4.4145, 3.924] for name in ("braking_capacity_mps2", "driving_capacity_mps2")},
        ),
        ({"friction": 2}, {"braking_capacity_mps2": [6, 7, 6], "obstacle_gap_m": np.inf}),
        ({"alert_s": 1.5}, {"latency_s": [1.5, 2, 2.3]}),
        ({"obstacle_gap_m": 42}, {"obstacle_gap_m": 42}),
        # 20 x 0.5 + 20^2 / (2 x 5) + 1.5, and with brakes of 4 m/s2
        ({"obstacle_margin_m": 1.5, "braking_capacity_mps2": 5, "latency_s": 0.5}, {"obstacle_gap_m": 51.5}),
        (
            {"obstacle_margin_m": 1.5, "braking_capacity_mps2": 5, "latency_s": 0.5, "friction": 4 / 9.81},
            {"obstacle_gap_m": 61.5},
        ),
        # brakes build up for 0.5 s: 10 + (10 - 10 x 0.5^3 / 6) + 18.75^2 / (2 x 5) + 1.5
        (
            {"obstacle_margin_m": 1.5, "braking_capacity_mps2": 5, "latency_s": 0.5, "brake_rate_mps3": 10},
            {"obstacle_gap_m": 56.447916666666664},
        ),
        ({"roles": ROLES}, {"wanted": [0, -2, 0, 0]}),
        ({"roles": {"vehicle_1": "coast"}}, {"wanted": [0, 0, -7, -6]}),
    ],
)
def test_world__by_hand(given: dict[str, Any], expected: dict[str, Any]) -> None:
    scenario = line().replace(**given)
    worlds = scenario.sample(1, 7)
    for name, value in expected.items():
        assert getattr(worlds, name)[0].tolist() == pytest.approx(value), name
    assert scenario.has_obstacle == np.isfinite(worlds.obstacle_gap_m[0])


@pytest.mark.parametrize("name", ["realistic-motorway", "realistic-pair", "realistic-platoon", "recorded-openacc"])
def test_road__is_one_for_the_line__and_each_vehicle_has_its_share(name: str) -> None:
    drawn = load_scenario(name).draw(300, 7)
    share = drawn.worlds.braking_capacity_mps2 / (9.81 * drawn.friction[:, np.newaxis])
    assert 0.5 <= drawn.friction.min() < 0.55 < 0.85 < drawn.friction.max() <= 0.9
    assert share == pytest.approx(drawn.grip) and 0.8 <= share.min() < 0.82 < 0.98 < share.max() <= 1.0
    assert abs(np.corrcoef(share.T) - np.eye(share.shape[1])).max() < 0.2  # by itself


def test_road__is_refused_without_friction() -> None:
    with refused("grip = 0.9: can be used only with friction, of which it is a share"):
        line(grip=0.9)
    with refused("grip[1] (vehicle_2) = 1.1: must be finite and in (0, 1]"):
        line(friction=0.5, grip=[1, 1.1, 1])


def test_bounds__hold_for_every_draw() -> None:
    drawn = line().replace(
        time_gaps_s={"uniform": [0.2, 2]},
        line_speed_mps={"uniform": [10, 38]},
        speed_deviations_mps={"uniform": [-2, 2]},
    )
    assert drawn.bounds("speeds_mps") == ((8.0, 40.0),) * 3
    assert drawn.bounds("gaps_m") == ((1.6, 80.0),) * 2
    worlds = drawn.sample(2000, 7)
    assert 8.0 <= worlds.speeds_mps.min() < 10.0 < 38.0 < worlds.speeds_mps.max() <= 40.0
    assert line(friction={"uniform": [0.1, 0.9]}).bounds("braking_capacity_mps2")[0] == (0.1 * 9.81, 6.0)
    tyres = line(friction={"uniform": [0.1, 0.4]}, grip=[{"uniform": [0.5, 1]}, 0.8, 1])
    of_first, of_second = ((0.05 * 9.81, 0.4 * 9.81), (0.1 * 9.81 * 0.8, 0.4 * 9.81 * 0.8))
    assert tyres.bounds("braking_capacity_mps2")[:2] == (of_first, of_second)
    assert load_scenario("mixture-delays").bounds("latency_s") == ((0.0, 0.0), (0.1, 0.8), (0.3, 1.2))


# ---------------------------------------------------------------- types, tables, mixtures


def test_types_and_loads__are_drawn_first() -> None:
    kinds = {"car": {"weight": 3}, "truck": {"mass_t": {"with_load": [14, 40]}}}
    drawn = line(mass_t=1.5, vehicle_types=kinds).draw(300, 7)
    u = uniform_numbers(7, "list", 0, np.arange(300))(12, (3,)).reshape(300, 3, 4)
    assert (drawn.types == np.where(u[..., 0] < 0.75, "car", "truck")).all()
    assert (drawn.worlds.mass_t == np.where(u[..., 0] < 0.75, 1.5, 14 + 26 * u[..., 1])).all()


def test_table__gives_whole_rows() -> None:
    rows = [[5, 11, "a: 1"], [6, 12, "a: 2"], [7, 13, "b: 1"]]
    scenario = line(table={"columns": ["gap_1_m", "speed_2_mps", "recording"], "rows": rows})
    drawn = scenario.draw(400, 7)
    row = np.floor(3 * uniform_numbers(7, "list", 0, np.arange(400))(4, (6,))[:, 1])
    assert drawn.worlds.gaps_m.tolist() == np.stack([5 + row, np.full(400, 7)], axis=1).tolist()
    assert drawn.worlds.speeds_mps[:, 1].tolist() == (11 + row).tolist()
    assert clusters_of(columns_of(drawn)).tolist() == np.where(row < 2, "a", "b").tolist()
    assert scenario.bounds("gaps_m") == ((5.0, 7.0), (7.0, 7.0))


def test_mixture__is_world_by_world_that_of_its_members(empty_folder: Path) -> None:
    mixture = load_scenario("mixture-three-tests")
    drawn = mixture.draw(60, 7)
    parts = [drawn.scenarios == member.name for member in mixture.members]
    assert np.sum(parts, axis=0).tolist() == [1] * 60
    for member, rows in zip(mixture.members, parts, strict=True):
        assert bits(member.sample(60, 7).take(rows)) == bits(drawn.worlds.take(rows))
    delays = load_scenario("mixture-delays")
    heavy = delays.replace(mass_t=[40, 1, 1])
    assert np.unique(heavy.sample(20, 7).mass_t[:, 0]).tolist() == [40.0]
    assert {"title", "source"}.isdisjoint(delays.content()["mixture"][0]["scenario"])
    assert heavy.sample(20, 7).gaps_m.tolist() == delays.sample(20, 7).gaps_m.tolist()
    assert [each.learners for each in delays.with_learners(["vehicle_3"]).members] == [(3,)] * 3
    Path("own.yaml").write_text(json.dumps(PAPER.replace(name="own", title="").declared()))
    Path("mine.yaml").write_text("name: mine\nmixture: [{scenario: own.yaml}, {scenario: paper-random-early}]\n")
    assert [each.name for each in load_scenario("mine.yaml").members] == ["own", "paper-random-early"]


# ---------------------------------------------------------------- the object


# Each kind of scenario; `tests/golden` draws the worlds of all.
KINDS = [
    "paper-random", "paper-random-obstacle", "realistic-mixed-buildup", "stress-wide",
    "cooperation-2-five", "cooperation-4-congested", "benchmark-noisy", "mixture-three-tests", "standards-r157",
]  # fmt: skip


@pytest.mark.parametrize("name", [name for name in KINDS if name in SHIPPED])
def test_shipped_scenario__goes_round(name: str, empty_folder: Path) -> None:
    scenario = load_scenario(name)
    assert Scenario(**scenario.declared()) == scenario
    assert load_scenario(scenario.declared()) == scenario
    assert pickle.loads(pickle.dumps(scenario)) == scenario == copy.deepcopy(scenario)
    for key in scenario.model_fields_set - {"vehicles"}:
        assert scenario.replace(**{key: getattr(scenario, key)}) == scenario, key
    Path("mine.yaml").write_text(scenario_file.new_scenario_text("mine", name))
    assert bits(load_scenario("mine.yaml").sample(5, 7)) == bits(scenario.sample(5, 7))
    Path(f"{name}.yaml").write_text(scenario_file.whole_text(name))
    table = {} if scenario.table is None else {"table": scenario.table}
    whole = {"v2x": values_of(scenario.v2x)} if "v2x" in scenario.model_fields_set and not scenario.members else {}
    assert table or load_scenario(f"{name}.yaml") in (scenario, scenario.replace(**whole))


def test_what_users_hand_over__becomes_plain() -> None:
    roles = UserDict({"vehicle_2": "learner"})
    scenario = PAPER.replace(
        observation=deque(["own", "front_1"]), roles=roles, mass_t=np.array([1.0, 2.0, 3.0]), gaps_m=UserList([7, 8]),
        objective=("own", "own", "total"), v2x=UserDict({"preset": "nominal"}),
        latency_s=UserDict({"choice": (0, 0.5)}),
    )  # fmt: skip
    assert scenario.observation == ("own", "front_1")
    assert scenario.declared()["mass_t"] == [1.0, 2.0, 3.0]
    assert PAPER.replace(observation=View(["own", "front_1.gap"])).observation[-1] == "front_1.gap"
    assert load_scenario(UserDict(PAPER.declared())) == PAPER
    each = PAPER.replace(observation={"vehicle_2": ["own"]})
    assert each.replace(observation=each.observation) == each


def test_new_way_to_declare__takes_the_place_of_the_old_one() -> None:
    timed = line().replace(time_gaps_s=1, line_speed_mps=20, speed_deviations_mps=1)
    assert (timed.gaps_m, timed.speeds_mps) == (None, None)
    assert timed.replace(speeds_mps=20).declared().keys() & {"line_speed_mps", "speed_deviations_mps"} == set()
    margin = line(obstacle_margin_m=1.5).replace(obstacle_gap_m=42)
    assert margin.obstacle_margin_m is None


def test_columns__are_all_that_was_drawn() -> None:
    wet = line(friction={"uniform": [0.2, 0.4]})
    of_mixture, of_types, of_wet = (
        columns_of(scenario.draw(3, 7, first=5))
        for scenario in (load_scenario("mixture-delays"), load_scenario("realistic-mixed"), wet)
    )
    assert [*of_mixture][:3] == ["world", "scenario", "gap_1_m"]
    assert [*of_types][:5] == ["world", "vehicle_1_type", "vehicle_2_type", "vehicle_3_type", "gap_1_m"]
    assert of_types["world"].tolist() == [5, 6, 7]
    both = [{"scenario": "paper-random"}, {"scenario": "paper-random-obstacle"}]
    some = load_scenario({"name": "both", "mixture": both}).draw(30, 7)
    assert set(columns_of(some)["obstacle_gap_m"][some.worlds.obstacle_gap_m == np.inf].astype(str)) == {"nan"}
    assert (of_wet["braking_capacity_1_mps2"] == of_wet["friction"] * 9.81).all()
    fixed = {f"{name}_{i}_{unit}" for name, unit in (("mass", "t"), ("latency", "s")) for i in (1, 2, 3)}
    assert fixed_columns(wet) == fixed | {f"speed_limit_{i}_mps" for i in (1, 2, 3)} | {"restitution"}
    assert fixed_columns(wet) < {*of_wet}


def test_sample__one_world_after_the_other() -> None:
    scenario = PAPER.replace(name="once")
    for first in (0, 1, 2, 3, 2000, 2, 1024, 1025):
        expected = bits(scenario.draw(1, 7, first=first).worlds)
        for _ in range(2):
            world = scenario.sample(1, 7, first=first)
            assert bits(world) == expected
            world.line[:] = 0.0  # the caller's own array
    assert len(pickle.dumps(scenario)) < 100_000
    assert pickle.loads(pickle.dumps(scenario)) == scenario == PAPER.replace(name="once")
    with refused("seed of the list = 7.0: must be a whole number"):
        scenario.sample(1, 7.0, first=2)  # type: ignore[arg-type]


def test_sample__an_error_of_a_later_world_comes_only_with_that_world(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "MOST_ATTEMPTS", 2)  # with them, one world in 256 has an early impact
    often = PAPER.replace(gaps_m=[{"choice": [0.01, 9.0], "weights": [1, 15]}, 9.0])
    bad = next(k for k in range(999) if not can_draw(often, k))
    assert 2 < bad < 900  # worlds before and after it are drawn together
    fresh = often.replace(name="fresh")
    for first in range(bad):
        fresh.sample(1, 7, first=first)
    with refused(f"early_impacts: reject, but in all 2 draws of world {bad} an impact happens"):
        fresh.sample(1, 7, first=bad)


def can_draw(scenario: Scenario, number: int) -> bool:
    try:
        scenario.draw(1, 7, first=number)
    except InvalidInput:
        return False
    return True


def test_game__has_the_training_worlds_and_sees_an_obstacle() -> None:
    pool = WorldPool(PAPER, "training")
    for seed, first in ((0, 0), (0, 3), (0, 500), (1, 500), (1, 503), (1, 5000), (1, 10), (1, 1520), (0, 6)):
        expected = PAPER.draw(3, seed, first=first, purpose="training").worlds
        assert bits(pool(3, seed, first)) == bits(expected)
    assert not any(name.startswith("obstacle") for name in views_of(line())[0].names)
    assert any(name.startswith("obstacle") for name in views_of(line(obstacle_gap_m=42))[0].names)


def test_catalogue__has_groups() -> None:
    assert len(list_scenarios()) == 60
    tasks = group_of_scenarios("benchmark")
    assert [task.removeprefix("benchmark-") for task in tasks] == [
        "all", "blocked", "five", "noisy", "pair", "single", "truck",
    ]  # fmt: skip
    assert load_scenario("benchmark-five").learners == (1, 2, 3, 4, 5)
    assert load_scenario("benchmark-blocked").learners == (2, 3)
    assert group_of_scenarios("stress") == ["stress-wide", "stress-wide-obstacle"]
    assert group_of_scenarios("nothing") == []


def test_catalogue__has_names_and_paths(empty_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("mine.yaml").write_text(json.dumps(PAPER.replace(name="mine").declared()))
    monkeypatch.setenv("HOME", str(empty_folder))
    monkeypatch.setenv("USERPROFILE", str(empty_folder))
    for path in ("mine.yaml", "mine", "./mine", "~/mine.yaml", "~/mine", empty_folder / "mine.yaml"):
        assert load_scenario(path).name == "mine"
    Path("paper-random.yaml").touch()
    assert load_scenario("paper-random") == PAPER
    Path("paper-random.yaml").unlink()
    Path("mine.yaml").rename("mine.yml")
    assert load_scenario("mine").name == "mine"


def test_catalogue__takes_folders_of_new_names(empty_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("mine.yaml").write_text(json.dumps(PAPER.replace(name="mine").declared()))
    monkeypatch.setenv("HOME", str(empty_folder))
    monkeypatch.setattr(catalogue, "FOLDERS", {})
    catalogue.register_scenarios("~")
    catalogue.register_scenarios("~")
    assert [entry.name for entry in list_scenarios() if not entry.shipped] == ["mine"]
    Path("sub").mkdir()
    with refused("folder of scenarios 'sub': has no file that ends in .yaml"):
        catalogue.register_scenarios("sub")
    Path("sub/paper-random.yaml").touch()
    with refused("already has the name 'paper-random'; rename the file", AlreadyExists):
        catalogue.register_scenarios("sub")


def test_new_file__says_of_each_key_its_range_and_what_it_replaces() -> None:
    text = scenario_file.new_scenario_text("mine")
    assert "; finite and in (0, 60] s (seconds); give either this key or gaps_m\n# time_gaps_s: " in text


def test_json_schema__accepts_what_the_reader_accepts() -> None:
    editor = jsonschema.Draft202012Validator(scenario_file.scenario_json_schema())
    for entry in list_scenarios():
        if entry.name in SHIPPED:
            assert not [*editor.iter_errors(read_yaml(entry.path).content)], entry.name
    for key, rule in QUANTITIES.items():
        inside, outside = rule.high, np.nextafter(rule.high, np.inf)
        for content in ({key: inside}, {key: {"uniform": [inside, inside]}}):
            assert editor.is_valid({"name": "x", **content}), key
        low = {"normal": {"mean": inside, "sd": 1, "low": -201, "high": inside}}
        for wrong in (outside, [inside, outside], {"choice": [inside, outside]}, low):
            assert not editor.is_valid({"name": "x", key: wrong}), key
    heavy = {"car": {"mass_t": {"with_load": [1, 1001]}}}
    for wrong in ({"vehicle_types": heavy}, {"v2x": "nominl"}, {"zzz": 1}, {"name": "Bad Name"}):
        assert not editor.is_valid({"name": "x", **wrong}), wrong


def write(name: str, text: str, folder: str = ".") -> Path:
    path = Path(folder) / f"{name}.yaml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"name: {name}\n{text}")
    return path


def test_based_on__takes_all_values_but_the_words_and_what_the_file_says(empty_folder: Path) -> None:
    write("near", "based_on: paper-random-obstacle\ntime_gaps_s: 0.4\nobstacle_margin_m: null\n", "sub")
    far = write("far", "title: Far\nbased_on: sub/near.yaml\nlatency_s: [0, 0.2, 0.8]\nearly_impacts: keep\n")
    paper = load_scenario("paper-random")
    expected = paper.replace(name="far", title="Far", time_gaps_s=0.4, latency_s=[0, 0.2, 0.8], early_impacts="keep")
    found = load_scenario(far)
    assert found == expected.replace(description="", source="") and not found.has_obstacle
    assert load_scenario({"name": "far", "title": "Far", "based_on": far}) == found
    assert load_scenario({**found.declared(), "name": "far"}) == found


def test_based_on__a_mixture_changes_every_member(empty_folder: Path) -> None:
    changed = load_scenario(write("slow", "based_on: mixture-delays\nmass_t: 3\n"))
    assert {member.mass_t for member in changed.members} == {3.0}


BASED = {
    "a.yaml, line 3: mass_t: has the same value in paper-random; leave it out": "paper-random\nmass_t: [4.5, 5.5, 5.9]",
    "a.yaml, line 2: based_on = [b]: must be the name of a scenario or the path of its file": "[b]",
    "a.yaml, line 2: based_on = a.yaml: a -> a is a circle; base one of them on another scenario": "a.yaml",
    "a.yaml, line 3: frictoin: unknown key; did you mean friction": "paper-random\nfrictoin: null",
    "a -> c -> a is a circle; base one of them on another scenario": "c.yaml",
    "more than 50 files are based on each other": "0.yaml",
}


@pytest.mark.parametrize("message", BASED)
def test_based_on__refuses(message: str, empty_folder: Path) -> None:
    write("b", "based_on: a.yaml\n")
    write("c", "mixture: [{scenario: paper-random}, {scenario: a.yaml}]\n")
    for k in range(1000) if BASED[message] == "0.yaml" else ():
        write(str(k), f"based_on: {k + 1}.yaml\n")
    with refused(message):
        load_scenario(write("a", f"based_on: {BASED[message]}\n"))


def test_based_on__works_only_in_files() -> None:
    with refused("based_on = paper-random: works only in a file and with load_scenario"):
        PAPER.replace(based_on="paper-random")
