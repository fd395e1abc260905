"""What a scenario may not say, and what its methods refuse."""

import copy
import pickle
from collections.abc import Callable
from pathlib import Path

import pytest

from ethbrake_marl.errors import UnknownName
from ethbrake_marl.files.yaml import parse_yaml
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario, new_scenario_text
from ethbrake_marl.first_edition.scenario.roles import ScriptSpec
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.tables import worlds_from_state
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


QUANTITIES_AND_ROLES: dict[str, Callable[[], object]] = {
    "line 15: road_friction: unknown key;": lambda: given(gaps_m=None, road_friction="0.7"),
    "line 15: gaps_km: unknown key; did you": lambda: given(gaps_m=None, gaps_km="0.007"),
    "line 15: zzz: unknown key": lambda: given(restitution=None, zzz="0.1"),
    "bad.yaml: gaps_m: missing; write, for": lambda: given(gaps_m=None),
    "bad.yaml: name: missing; write, for": lambda: given(name=None),
    "line 5: gaps_m = -1: must be finite and": lambda: given(gaps_m="-1"),
    "line 5: gaps_m: has 3 entries; must": lambda: given(gaps_m="[7, 7, 7]"),
    "line 5: gaps_m = []: must not be empty": lambda: given(gaps_m="[]"),
    'line 5: gaps_m = "7": must be a number,': lambda: given(gaps_m='"7"'),
    "line 5: gaps_m = true: must be a number": lambda: given(gaps_m="true"),
    "line 5: gaps_m = {unifrom: [5, 9]}:": lambda: given(gaps_m="{unifrom: [5, 9]}"),
    "line 5: gaps_m.uniform[1]: missing; two": lambda: given(gaps_m="{uniform: [5]}"),
    "line 5: gaps_m.uniform = [5, 6, 7]:": lambda: given(gaps_m="{uniform: [5, 6, 7]}"),
    "line 5: gaps_m.uniform = [9, 6]: low": lambda: given(gaps_m="{uniform: [9, 6]}"),
    "line 5: gaps_m.choice: cannot be": lambda: given(gaps_m="{uniform: [5, 9], choice: [7]}"),
    "line 5: gaps_m.normal.high: missing; a": lambda: given(gaps_m="{normal: {mean: 7, sd: 1, low: 5}}"),
    "line 5: gaps_m.normal = {mean: 7, sd:": lambda: given(gaps_m="{normal: {mean: 7, sd: 0, low: 5, high: 9}}"),
    "line 5: gaps_m.normal = {mean: 7, sd: 1, low: 9,": lambda: given(
        gaps_m="{normal: {mean: 7, sd: 1, low: 9, high: 9}}"
    ),
    "line 5: gaps_m.normal = {mean: 7, sd: 1, low: 20,": lambda: given(
        gaps_m="{normal: {mean: 7, sd: 1, low: 20, high: 99}}"
    ),
    "line 5: gaps_m.weights = [1]: must have": lambda: given(gaps_m="{choice: [7, 8], weights: [1]}"),
    "every weight must be above 0, and their": lambda: given(gaps_m="{choice: [7, 8], weights: [1, 0]}"),
    "must not be above speed_limit_mps of": lambda: given(speed_limit_mps="{uniform: [19, 40]}"),
    "line 10: latency_s[2] (vehicle_3) = 8:": lambda: given(latency_s="[0, 0.5, 8]"),
    "line 4: horizon_s = -8: must be greater": lambda: given(horizon_s="-8"),
    "unknown vehicle; this scenario has": lambda: given(roles="{vehicle_2: learner, vehicle_4: coast}"),
    "line 13: roles.vehicel_2 = learner:": lambda: given(roles="{vehicel_2: learner}"),
    "line 13: roles.vehicle_2 = Learner:": lambda: given(roles="{vehicle_2: Learner}"),
    "line 13: roles.vehicle_2 = learner:1:": lambda: given(roles="{vehicle_2: learner:1}"),
}


@pytest.mark.parametrize("message", QUANTITIES_AND_ROLES)
def test_key__is_refused_with_its_line_and_what_would_be_right(message: str) -> None:
    with refused(message):
        QUANTITIES_AND_ROLES[message]()


VEHICLE_TYPES: dict[str, Callable[[], object]] = {
    "line 15: vehicle_types.any: any means": lambda: given(vehicle_types="{any: {}}"),
    "line 15: vehicle_types.car.load = 2: a": lambda: given(vehicle_types="{car: {load: 2}}"),
    "line 10: latency_s = [0, 0.5, 0.8]:": lambda: given(vehicle_types="{car: {latency_s: 3}}"),
    "line 9: mass_t = {with_load: [1, 2]}:": lambda: given(mass_t="{with_load: [1, 2]}"),
}


@pytest.mark.parametrize("message", VEHICLE_TYPES)
def test_vehicle_types__that_say_too_little_or_twice_are_refused(message: str) -> None:
    with refused(message):
        VEHICLE_TYPES[message]()


V2X: dict[str, Callable[[], object]] = {
    "must be a preset: paper, clear,": lambda: given(v2x="papr"),
    "line 15: v2x.sensing_s = [2, 1]: low": lambda: given(v2x="{preset: clear, sensing_s: [2, 1]}"),
    "line 15: v2x.radio_s = 0.1: has no": lambda: given(v2x="{preset: clear, hears: none, radio_s: 0.1}"),
    "must be a preset (paper, clear,": lambda: given(v2x="5"),
    "persistence: perio...: a message takes": lambda: given(
        v2x="{preset: nominal, link_latency_s: 1.5, persistence: periodic}", time_step_s="1e-3", latency_s="0"
    ),
}


@pytest.mark.parametrize("message", V2X)
def test_v2x__that_has_no_effect_or_leaves_somebody_without_news_is_refused(message: str) -> None:
    with refused(message):
        V2X[message]()


MIXTURES: dict[str, Callable[[], object]] = {
    "mixture[0].scenario = paper-randon:": lambda: loaded("mixture:\n  - scenario: paper-randon"),
    "mine.yaml, line 2: mixture[0].scenario": lambda: loaded("mixture: [{scenario: mixture-delays}]"),
    "mine.yaml, line 2: mixture[1]:": lambda: loaded("mixture: [{scenario: paper-random}, {scenario: paper-random}]"),
    "mine.yaml, line 2: mixture: horizon_s": lambda: loaded(
        "mixture: [{scenario: paper-random}, {scenario: stress-wide}]"
    ),
    "mine.yaml, line 2: mixture: vehicles": lambda: loaded(
        "mixture: [{scenario: paper-random}, {scenario: cooperation-4-five}]"
    ),
    "mine.yaml, line 2: mixture: vehicles =": lambda: loaded("mixture: [{scenario: paper-random}]\nvehicles: 5"),
    "mine.yaml, line 2: mixture:": lambda: loaded(
        f"mixture: [{{scenario: {{name: a, {WHOLE}, v2x: nominal}}}},"
        f" {{scenario: {{name: b, {WHOLE}, v2x: {{preset: nominal, persistence: periodic}}}}}}]"
    ),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", MIXTURES)
def test_file_of_a_mixture_or_of_types__is_refused(message: str) -> None:
    with refused(message):
        MIXTURES[message]()


CALLS: dict[str, Callable[[], object]] = {
    "scenario 'mixture-delays': is a mixture": lambda: DELAYS.quantities("mass_t"),
    "initial_state: scenario": lambda: worlds_from_state(DELAYS, {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}),
    "learners: 3: must be the name of a": lambda: PAPER.with_learners([3]),
    "learners: vehicle_2 is listed twice": lambda: PAPER.with_learners(["vehicle_2", 1]),
    "learners: 'vehicle_2': must be a list": lambda: PAPER.with_learners("vehicle_2"),
    "scenario 'paper-random': does not": lambda: PAPER.replace(time_gaps_s=1).quantities("gaps_m"),
    "roles of a scenario cannot be changed;": lambda: given(roles=None).roles.clear(),
    "agent 'constant:6.01': brakes harder": lambda: ScriptSpec.parse("constant:6.01").command([7.0, 6.0], [3.0, 2.0]),
    "agent 'constant:-2.01': drives harder": lambda: ScriptSpec.parse("constant:-2.01").command([7.0, 6.0], [3.0, 2.0]),
    "agent 'constant:nan': constant needs a": lambda: ScriptSpec.parse("constant:nan").command([7.0, 6.0], [3.0, 2.0]),
    "agent 'full_brake:3': full_brake takes": lambda: ScriptSpec.parse("full_brake:3").command([7.0, 6.0], [3.0, 2.0]),
    "agent '': must be name or": lambda: ScriptSpec.parse(""),
    "scenario name '': must be 1 to 64 lower": lambda: new_scenario_text(""),
}


@pytest.mark.parametrize("message", CALLS)
def test_call_with_a_scenario__is_refused(message: str) -> None:
    with refused(message):
        CALLS[message]()


def test_first_mistake__is_shown_with_the_number_of_others() -> None:
    with refused(
        "braking_capacity_mps2 = 0: must be finite and in (0, 100] m/s2 (metres per second squared) (and 2 more mist"
    ):
        given(braking_capacity_mps2="0", mass_t="0", restitution="2")


ROLES = {"__setitem__": ("vehicle_3", "learner"), "setdefault": ("vehicle_4", "learner"), "clear": ()}


@pytest.mark.parametrize("method", ROLES)
def test_roles__are_frozen(method: str) -> None:
    with refused("roles of a scenario cannot be changed; make a new scenario with"):
        getattr(PAPER.roles, method)(*ROLES[method])


@pytest.mark.parametrize(
    "scenario",
    [pickle.loads(pickle.dumps(PAPER)), copy.deepcopy(PAPER), PAPER.replace(title="Mine")],
    ids=["pickled", "copied", "replaced"],
)
def test_roles__of_a_copy_are_frozen(scenario: Scenario) -> None:
    with refused("roles of a scenario cannot be changed; make a new scenario with"):
        scenario.roles.clear()


@pytest.mark.parametrize("name", ["My Scenario", "-x", "x" * 65, "../x", "x\n"])
def test_name_of_a_new_scenario__is_a_plain_word(name: str) -> None:
    with refused(f"scenario name {name!r}: must be 1 to 64 lower case letters, digits, - and _"):
        new_scenario_text(name)


def test_unknown_vehicle_or_scenario__is_told_what_is_near() -> None:
    with refused("unknown vehicle 'vehicle_4'; did you mean 'vehicle_3'?", UnknownName):
        PAPER.with_learners(["vehicle_4"])
    with refused("unknown scenario 'paper-randon'; did you mean 'paper-random'?", UnknownName):
        load_scenario("paper-randon")
    with refused("unknown scenario 'zzz'; known: cooperation-0-sensors, ", UnknownName):
        load_scenario("zzz")


def test_file__has_the_name_of_its_scenario(empty_folder: Path) -> None:
    Path("other.yaml").write_text(new_scenario_text("mine"))
    with refused("other.yaml, line 13: name = mine: must be the file's name without ending, other; change the name"):
        load_scenario("other.yaml")
