"""What a scenario may not say, and what its methods refuse."""

import pickle
from collections.abc import Callable
from pathlib import Path

import pytest

from ethbrake_marl.errors import IgnoredName, UnknownName
from ethbrake_marl.files.yaml import parse_yaml
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.roles import check_role
from ethbrake_marl.worlds.scenario import Scenario
from ethbrake_marl.worlds.scenario_file import new_scenario_text
from ethbrake_marl.worlds.user_worlds import worlds_from_state
from tests.refused import refused

PAPER, DELAYS = load_scenario("paper-random"), load_scenario("mixture-delays")
LINES = """name: bad
vehicles: 3
time_step_s: 0.1
horizon_s: 8
gaps_m: {uniform: [5, 10]}
speeds_mps: [20, 18, 20]
braking_capacity_mps2: [6, 7, 6]
driving_capacity_mps2: [6, 7, 6]
mass_t: [4.5, 5.5, 5.9]
latency_s: [0, 0.5, 0.8]
speed_limit_mps: 40
restitution: 0.1
roles: {vehicle_1: full_brake, vehicle_2: learner, vehicle_3: full_brake}
early_impacts: reject"""
WHOLE = "gaps_m: 7, speeds_mps: 20, braking_capacity_mps2: 9, driving_capacity_mps2: 5, latency_s: 0.5, mass_t: 1"


def given(**changed: str | None) -> Scenario:
    """The scenario of LINES with other texts after some keys; None leaves a line empty."""
    lines = dict(line.split(": ", 1) for line in LINES.split("\n")) | changed
    text = "\n".join("" if value is None else f"{key}: {value}" for key, value in lines.items())
    return Scenario.from_document(parse_yaml(text, "bad.yaml"))


def loaded(text: str) -> Scenario:
    """The scenario of a file that says this under its name."""
    Path("mine.yaml").write_text(f"name: mine\n{text}\n")
    return load_scenario("mine.yaml")


REFUSED: dict[str, Callable[[], object]] = {
    "line 15: road_friction: unknown key; declare the friction of the road with the key friction, for": lambda: given(
        gaps_m=None, road_friction="0.7"
    ),
    "line 15: gaps_km: unknown key; did you mean gaps_m (metres)?": lambda: given(gaps_m=None, gaps_km="0.007"),
    "line 15: mass_kilograms: unknown key; did you mean mass_t (tonnes)?": lambda: given(
        mass_t=None, mass_kilograms="5500"
    ),
    "line 15: speeds_kilometres_per_hour: unknown key; did you mean speeds_mps (metres per second)?": lambda: given(
        speeds_mps=None, speeds_kilometres_per_hour="72"
    ),
    "line 15: latency: unknown key; did you mean latency_s (seconds)?": lambda: given(latency_s=None, latency="0.5"),
    "line 15: v2x.radio_milliseconds: unknown key; did you mean radio_s (seconds)?": lambda: given(
        v2x="{preset: nominal, radio_milliseconds: 20}"
    ),
    "line 15: restituton: unknown key; did you mean restitution?": lambda: given(restitution=None, restituton="0.1"),
    "bad.yaml: gaps_m: missing; write, for instance, gaps_m: 7, or time_gaps_s: 1": lambda: given(gaps_m=None),
    "line 5: gaps_m = -1: must be finite and in [0, 10000] m (metres)": lambda: given(gaps_m="-1"),
    "line 5: gaps_m = []: must not be empty": lambda: given(gaps_m="[]"),
    'line 5: gaps_m = "7": must be a number, not text; write it without quotes': lambda: given(gaps_m='"7"'),
    "line 5: gaps_m = true: must be a number or a distribution": lambda: given(gaps_m="true"),
    "line 5: gaps_m = null: must have a value; leave the key out if you do not need it": lambda: given(gaps_m=""),
    "line 5: gaps_m[1] (vehicle_2 to vehicle_3) = .inf: must be a finite number": lambda: given(gaps_m="[7, .inf]"),
    "{lognormal: {median, sigma, low, high}} or {choice: [a, b, ...]}; did you mean uniform?": lambda: given(
        gaps_m="{unifrom: [5, 9]}"
    ),
    "line 5: gaps_m.uniform[1]: missing; write {uniform: [low, high]}, {loguniform": lambda: given(
        gaps_m="{uniform: [5]}"
    ),
    "line 5: gaps_m.uniform = [9, 6]: low must not be above high": lambda: given(gaps_m="{uniform: [9, 6]}"),
    "line 5: gaps_m.loguniform = [9, 6]: low must not be above high": lambda: given(gaps_m="{loguniform: [9, 6]}"),
    "line 5: gaps_m[1].loguniform (vehicle_2 to vehicle_3) = [9, 6]: low must not be above high": lambda: given(
        gaps_m="[7, {loguniform: [9, 6]}]"
    ),
    "line 5: gaps_m.normal = {mean: 7, sd: 1, low: 9, high: 5}: low must be below high": lambda: given(
        gaps_m="{normal: {mean: 7, sd: 1, low: 9, high: 5}}"
    ),
    "line 5: gaps_m.lognormal = {median: 7, sigma: 1, low: 9, high: 5}: low must be below high": lambda: given(
        gaps_m="{lognormal: {median: 7, sigma: 1, low: 9, high: 5}}"
    ),
    "vehicle_types.car.mass_t.loguniform = [2, 1]: low must not be above high": lambda: given(
        vehicle_types="{car: {mass_t: {loguniform: [2, 1]}}}"
    ),
    "line 5: gaps_m.choice: cannot be combined with the other keys here; a quantity has only one": lambda: given(
        gaps_m="{uniform: [5, 9], choice: [7]}"
    ),
    "line 5: gaps_m.normal.high: missing; write {uniform: [low, high]}, {loguniform": lambda: given(
        gaps_m="{normal: {mean: 7, sd: 1, low: 5}}"
    ),
    "line 5: gaps_m.normal.std: unknown key; did you mean sd?": lambda: given(
        gaps_m="{normal: {mean: 7, std: 1, low: 5, high: 9}}"
    ),
    "line 5: gaps_m.normal = {mean: 7, sd: 1, low: 20, high: 99}: the untruncated distribution must": lambda: given(
        gaps_m="{normal: {mean: 7, sd: 1, low: 20, high: 99}}"
    ),
    "line 5: gaps_m.weights = [1]: must have as many entries as choice (2)": lambda: given(
        gaps_m="{choice: [7, 8], weights: [1]}"
    ),
    "line 6: speeds_mps[2] (vehicle_3) = {choice: [3, 41]}: vehicle_3 has a speed of 3 to 41": lambda: given(
        speeds_mps="[1, 2, {choice: [3, 41]}]"
    ),
    "vehicle_1 has a speed of 20 m/s; its speed must be from 0 to its speed_limit_mps, 19 m/s": lambda: given(
        speed_limit_mps="{uniform: [19, 40]}"
    ),
    "line 10: latency_s[2] (vehicle_3) = 8: vehicle_3 may not be able to act until 8 s; this": lambda: given(
        latency_s="[0, 0.5, 8]"
    ),
    "line 3: time_step_s = 9: must not be above horizon_s (8 s)": lambda: given(time_step_s="9"),
    "must be a whole number, written without a decimal point or an exponent": lambda: given(vehicles="3.0"),
    "unknown vehicle; this scenario has vehicle_1 ...": lambda: given(roles="{vehicle_2: learner, vehicle_4: coast}"),
    "line 13: roles.vehicel_2: unknown vehicle; did you mean vehicle_2?": lambda: given(roles="{vehicel_2: learner}"),
    "line 13: roles.vehicle_2 = Learner: agent 'Learner': must be name or name:argument": lambda: given(
        roles="{vehicle_2: Learner}"
    ),
    "line 13: roles.vehicle_2 = learner:1: agent 'learner:1': learner takes no argument": lambda: given(
        roles="{vehicle_2: learner:1}"
    ),
    "line 13: roles = [learner]: must be a mapping": lambda: given(roles="[learner]"),
    "line 13: roles.vehicle_2 = mine.py:drive: agent 'mine.py:drive': is a function in a Python file": lambda: given(
        roles="{vehicle_2: mine.py:drive}"
    ),
    "line 7: braking_capacity_mps2[0] (vehicle_1) = 6: must be at least 7 m/s2 on the road, because": lambda: given(
        roles="{vehicle_1: constant:7, vehicle_2: learner}"
    ),
    "line 8: driving_capacity_mps2[0] (vehicle_1) = 6: must be at least 7 m/s2 on the road, because": lambda: given(
        roles="{vehicle_1: constant:-7, vehicle_2: learner}"
    ),
    "line 13: roles.vehicle_3 = e_v2x_bm: with early_impacts: reject, a script must be full_brake": lambda: given(
        roles="{vehicle_3: e_v2x_bm, vehicle_2: learner}"
    ),
    "a script must be full_brake, coast or constant:a; did you mean full_brake?": lambda: given(
        roles="{vehicle_3: ful_brake, vehicle_2: learner}"
    ),
    "line 14: early_impacts = refuse: must be keep or reject": lambda: given(early_impacts="refuse"),
    "must be 1 to 64 lower case letters, digits, - and _, beginning with a letter": lambda: given(name="Bad Name"),
    "line 15: time_gaps_s = 1: give either gaps_m or time_gaps_s, not both": lambda: given(
        gaps_m="7", time_gaps_s="1", speeds_mps="20"
    ),
    "line 15: speed_deviations_mps = 0: can be used only with line_speed_mps, the speed to which": lambda: given(
        gaps_m="7", speeds_mps="20", speed_deviations_mps="0"
    ),
    "line 15: line_speed_mps = {uniform: [1, 38]}: vehicle_2 has a speed of -1 to 40 m/s; its speed": lambda: given(
        speeds_mps=None,
        gaps_m="7",
        line_speed_mps="{uniform: [1, 38]}",
        speed_deviations_mps="[0, {uniform: [-2, 2]}, 0]",
    ),
    "give either obstacle_gap_m or obstacle_margin_m": lambda: given(obstacle_margin_m="1.7", obstacle_gap_m="42"),
    "vehicle_1 can learn only with an obstacle ahead; add one, for": lambda: given(roles="{vehicle_1: learner}"),
    "line 15: vehicle_types.any: any means every type, so it cannot be a name; use": lambda: given(
        vehicle_types="{any: {}}"
    ),
    "line 15: vehicle_types.car.load = 2: a load must be in [0, 1]": lambda: given(vehicle_types="{car: {load: 2}}"),
    "line 10: latency_s = [0, 0.5, 0.8]: must be left out, because every vehicle type": lambda: given(
        vehicle_types="{car: {latency_s: 3}}"
    ),
    "line 15: types = car: can be used only with the key vehicle_types, which declares": lambda: given(types="car"),
    "line 16: types: has 2 entries; must have 3, one per vehicle, or be a single": lambda: given(
        vehicle_types="{car: {}}", types="[car, car]"
    ),
    "line 16: types[1] = cra: unknown vehicle type cra; did you mean car?": lambda: given(
        vehicle_types="{car: {}}", types="[car, cra, car]"
    ),
    "line 1: mass_t: vehicle type bus does not declare mass_t; declare mass_t in this type, or": lambda: given(
        mass_t=None, vehicle_types="{car: {mass_t: 2}, bus: {braking_capacity_mps2: 5}}"
    ),
    "line 15: follower: unknown key; give the line one more vehicle": lambda: given(follower="{time_gap_s: 1}"),
    "line 15: v2x.senss: unknown key; did you mean senses?": lambda: given(v2x="{preset: nominal, senss: both}"),
    "line 13: roles.vehicle_1 = {profile: [[0, 3]]}: must be learner or the name of a script, such as": lambda: given(
        roles="{vehicle_1: {profile: [[0, 3]]}, vehicle_2: learner}"
    ),
    "line 15: v2x = papr: must be a preset (paper, clear, nominal, congested, blocked, sensors-only)": lambda: given(
        v2x="papr"
    ),
    "preset paper generates no messages; leave it out": lambda: given(v2x="{loss_begins: 0.1}"),
    "a vehicle that may never get a message must see the vehicle ahead; use senses: both or front": lambda: given(
        v2x="{preset: clear, senses: none}"
    ),
    "line 15: v2x.radio_s = 0.1: has no effect, because link_latency_s fixes the delay of messages": lambda: given(
        v2x="{preset: clear, link_latency_s: 0.1, radio_s: 0.1}"
    ),
    "line 15: v2x.radio_s = 0.1: has no effect, because hears: none means that no vehicle gets": lambda: given(
        v2x="{preset: clear, hears: none, radio_s: 0.1}"
    ),
    "senses: none means that no vehicle is in sight; leave it out": lambda: given(v2x="{sensing_s: [0.8, 1]}"),
    "v2x = {preset: blocked}: vehicle_3 may not be able to act until 2.2 s; this time must be below": lambda: given(
        v2x="blocked", horizon_s="2"
    ),
    "mine.yaml, line 2: table.file = ../rows.csv: must be a relative path in the scenario's folder": lambda: loaded(
        "table: {file: ../rows.csv, columns: [gap_1_m]}"
    ),
    "mine.yaml, line 2: mixture[0].scenario: missing; write, for instance": lambda: loaded("mixture: [{weight: 1}]"),
    "mine.yaml, line 2: mixture[0].scenario: a mixture cannot contain another": lambda: loaded(
        "mixture: [{scenario: mixture-delays}]"
    ),
    "mine.yaml, line 2: mixture: paper-random is listed twice; list it once, with the sum of its weights": lambda: (
        loaded("mixture: [{scenario: paper-random}, {scenario: paper-random}]")
    ),
    "mine.yaml, line 2: mixture: vehicles must be the same in all scenarios of the mixture, but paper": lambda: loaded(
        "mixture: [{scenario: paper-random}, {scenario: cooperation-2-five}]"
    ),
    "mine.yaml, line 2: mixture: roles must be the same in all scenarios of the mixture, but paper-ra": lambda: loaded(
        "mixture: [{scenario: paper-random}, {scenario: cooperation-3-pair}]"
    ),
    "mine.yaml, line 2: mixture: horizon_s must be the same in all scenarios of the mixture, but": lambda: loaded(
        "mixture: [{scenario: paper-random}, {scenario: stress-wide}]"
    ),
    "mine.yaml, line 2: mixture[0].scenario: mass_t: has the same value in paper-random; leave it out": lambda: loaded(
        "mixture: [{scenario: {name: x, based_on: paper-random, mass_t: [4.5, 5.5, 5.9]}}]"
    ),
    "mine.yaml, line 2: mixture[0].scenario: scenario 'paper-random': braking_capacity_mps2: has 3 entries": lambda: (
        loaded("mixture: [{scenario: paper-random}]\nvehicles: 5")
    ),
    "mine.yaml, line 2: mixture[0].scenario: scenario 'x': massx: unknown key; did you mean mass_t (tonnes)?": lambda: (
        loaded("mixture: [{scenario: {name: x,\n   massx: 3}}]")
    ),
    "mine.yaml, line 1: brake_rate_mps3: vehicle type van does not declare brake_rate_mps3; declare": lambda: loaded(
        "vehicle_types: {car: {mass_t: 1, brake_rate_mps3: 9}, van: {mass_t: 2}}\n"
        + WHOLE.removesuffix(", mass_t: 1").replace(", ", "\n")
    ),
    "scenario 'x': mixture[0].scenario = paper-random: must be the content of a scenario as a": lambda: Scenario(
        name="x", mixture=[{"scenario": "paper-random"}]
    ),
    "initial_state: scenario 'mixture-delays' is a mixture, so it is unknown to which of": lambda: worlds_from_state(
        DELAYS, {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}
    ),
    "objective 'maximin:3': maximin takes no argument": lambda: PAPER.replace(objective="maximin:3"),
    "objective 'vehicle_4': there is no vehicle_4;": lambda: PAPER.replace(objective=["own", "own", "vehicle_4"]),
    "objective 'weighted:1,2': has 2 weights; must have 3": lambda: PAPER.replace(objective="weighted:1,2"),
    "objective 'vehicle_K': must name a vehicle, as in vehicle_3": lambda: PAPER.replace(objective="vehicle_K"),
    "objective = ownn: unknown objective 'ownn'; did you mean 'own'?": lambda: PAPER.replace(objective="ownn"),
    "unknown objective 'first'; known: ": lambda: PAPER.replace(objective="first:own,then:total"),
    "unknown objective 'mass-weighted'; did you mean 'weighted'?": lambda: PAPER.replace(objective="mass-weighted"),
    "table.columns = gap_9_m: unknown column; did you mean": lambda: PAPER.replace(
        table={"columns": ["gap_9_m"], "rows": [[1]]}
    ),
    "table.rows[0][0] = -1: gap_1_m must be finite and in [0, 10000] m": lambda: PAPER.replace(
        table={"columns": ["gap_1_m"], "rows": [[-1]]}
    ),
    "table.rows[1]: has 2 values; must have one for each of the 1 columns": lambda: PAPER.replace(
        table={"columns": ["gap_1_m"], "rows": [[1], [1, 2]]}
    ),
    "table.rows: must be given as lists here": lambda: PAPER.replace(table={"columns": ["gap_1_m"], "file": "x.csv"}),
    "gaps_m = 7: must be left out, because the table has columns of it for all": lambda: given(gaps_m="7").replace(
        table={"columns": ["gap_1_m", "gap_2_m"], "rows": [[1, 2]]}
    ),
    "must also have a column of numbers": lambda: PAPER.replace(table={"columns": ["recording"], "rows": [["a"]]}),
    "table.rows[0][1] = 2: recording must be a printable text, such as drive_1.csv: 2-3-4": lambda: PAPER.replace(
        table={"columns": ["gap_1_m", "recording"], "rows": [[1, 2]]}
    ),
    "missing.yaml: the file does not exist": lambda: load_scenario("missing.yaml"),
    "braking_capacity_mps2 = 0: must be finite and in (0, 100] m/s2 (metres per second squared)": (
        lambda: given(braking_capacity_mps2="0", mass_t="0", restitution="2")
    ),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", REFUSED)
def test_mistake__is_refused_with_its_place_and_what_would_be_right(message: str) -> None:
    with refused(message):
        REFUSED[message]()


@pytest.mark.parametrize("copied", [PAPER, pickle.loads(pickle.dumps(PAPER))])
def test_roles__are_frozen(copied: Scenario) -> None:
    for change in (
        lambda roles: roles.__setitem__("vehicle_3", "learner"), lambda roles: roles.__delitem__("vehicle_3"),
        lambda roles: roles.__ior__({"vehicle_3": "learner"}), lambda roles: roles.update(vehicle_3="learner"),
        lambda roles: roles.setdefault("vehicle_4", "learner"), lambda roles: roles.pop("vehicle_3"),
        lambda roles: roles.popitem(), lambda roles: roles.clear(),
    ):  # fmt: skip
        with refused("roles of a scenario cannot be changed; make a new scenario with"):
            change(copied.roles)


@pytest.mark.parametrize("spec", ["Full_brake", "constant:", "a\n"])
def test_agent_of_a_role__is_a_name_in_lower_case_and_an_argument(spec: str) -> None:
    with refused(f"agent {spec!r}: must be name or name:argument"):
        check_role(spec)


@pytest.mark.parametrize("name", ["x" * 65, "x\n"])
def test_name_of_a_new_scenario__is_a_plain_word(name: str) -> None:
    with refused(f"scenario name {name!r}: must be 1 to 64 lower case letters, digits, - and _"):
        new_scenario_text(name)


def test_unknown_scenario__is_told_what_is_near() -> None:
    with refused("unknown scenario 'paper-randon'; did you mean 'paper-random'?", UnknownName):
        load_scenario("paper-randon")
    with refused("unknown scenario 'zzz'; known: benchmark-all, ", UnknownName):
        load_scenario("zzz")


@pytest.mark.parametrize(("file", "name"), [("Wet Five.yml", "wet-five"), ("_a.b,c+d.yaml", "a-b-c-d")])
def test_file__gives_its_scenario_the_name(file: str, name: str, empty_folder: Path) -> None:
    Path(file).write_text(new_scenario_text("mine"))
    with pytest.warns(IgnoredName, match=f"line 12: name = mine is ignored: the file's name counts, so this is {name}"):
        assert load_scenario(file).name == name
    Path(file).write_text(new_scenario_text(name))
    assert load_scenario(file).name == name
