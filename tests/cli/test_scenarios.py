"""``ethbrake scenario``, new recipes, and ``--set``."""

import json
import re
import runpy
from pathlib import Path

import pytest

import ethbrake_marl as eb
from ethbrake_marl.cli import trial
from tests.fixtures.commands import Answer, Command, check_refused, told_json

SCRIPTS = """
import ethbrake_marl as eb


class Own:
    knows = "own sensors"

    def __init__(self, name):
        self.name = name

    def begin(self, alert, body):
        return None

    def act(self, state, memory, body):
        own = state.braking_capacity_mps2[:, body - 1]
        if self.name == "own_fails" and state.time_s.max() > 1.0:
            raise ZeroDivisionError("no gap")
        return -own * (2.0 if self.name == "own_greedy" else 0.5), memory


for name in ("own_calm", "own_greedy", "own_fails"):
    eb.register_agent(name, lambda argument, settings: Own(settings.spec))
"""


@pytest.mark.usefixtures("core_alone")
def test_validate__drives_scripts_and_tells_which_fails_where(ethbrake: Command, scenario_file, tmp_path) -> None:
    (tmp_path / "scripts.py").write_text(SCRIPTS)
    runpy.run_path(str(tmp_path / "scripts.py"))

    def tried(script: str, *more: str) -> Answer:
        path = scenario_file("vehicle_3: full_brake", f"vehicle_3: {script}")
        path.write_text(path.read_text().replace("early_impacts: reject", "early_impacts: keep"))
        return ethbrake("scenario", "validate", path, *more)

    calm, braked = (told_json(tried(script, "--json")) for script in ("own_calm", "full_brake"))
    assert (calm["learners"], calm["worlds"], braked["refused_by"]) == (["vehicle_2"], 200, {})
    assert calm["harm"]["full braking"]["total"] > braked["harm"]["full braking"]["total"]
    assert "vehicle_3 is driven by 'own_calm', whose commands are not known" in calm["refused_by"]["e_v2x_bm"]
    check_refused(tried("own_greedy"), "'own_greedy', world 0, vehicle_3 at 0.", "command -12 m/s2; must be in [-6, 6]")
    check_refused(tried("own_fails"), "'own_fails', vehicle_3: act fails: ZeroDivisionError: no gap (scripts.py, line")


@pytest.mark.usefixtures("core_alone")
def test_validate__of_a_wet_line_of_five_tells_all_capacities_on_this_road(ethbrake: Command, tmp_path: Path) -> None:
    path, shipped = tmp_path / "wet-five.yaml", ethbrake("scenario", "show", "cooperation-2-five").out
    path.write_text(shipped.replace("name: cooperation-2-five", "name: wet-five\nfriction: 0.4"))
    told = [line.split() for line in ethbrake("scenario", "validate", path).out.splitlines()]
    wet = [[f"{what}_capacity_{i}_mps2", "3.924"] for what in ("braking", "driving") for i in range(1, 6)]
    assert all(line in told for line in [*wet, ["friction", "0.400"]])


def test_show__prints_all_values_and_force_replaces_a_new_file(ethbrake: Command, tmp_path: Path) -> None:
    shipped = {entry["name"]: entry["path"] for entry in told_json(ethbrake("scenario", "list", "--json"))["scenarios"]}
    assert ethbrake("scenario", "show", "stress-wide").out == Path(shipped["stress-wide"]).read_text()
    path = tmp_path / "mine.yaml"
    path.write_text("precious")
    words = ("scenario", "new", "mine", "--based-on", "paper-scenario-1", "--output", tmp_path, "--force")
    assert ethbrake(*words).status == 0 and "# gaps_m: [10, 8]" in path.read_text()
    assert "\ngaps_m: [10, 8]\n" in ethbrake("scenario", "show", path).out


def test_list__has_the_names_that_files_can_use(ethbrake: Command) -> None:
    parts = told_json(ethbrake("scenario", "list", "--json"))["parts"]
    told = "".join(ethbrake("scenario", "list").out.split())
    assert {"own", "front_K"} <= {*parts["Observation"]} and {"nominal"} <= {*parts["V2X presets"]}
    assert {"ppo", "sac"} <= {*parts["Algorithms"]} and {"first", "total", "honest"} == {*parts["Counts of harm"]}
    assert all(name.replace(" ", "") in told for names in parts.values() for name in names)


def test_sample__draws_the_worlds_that_evaluate_draws(ethbrake: Command, tmp_path: Path) -> None:
    table, drawn = tmp_path / "worlds.csv", ("--episodes", "20", "--seed", "4")
    table.write_text(ethbrake("scenario", "sample", "paper-random", *drawn).out)
    (one,) = told_json(ethbrake("evaluate", "--agents", "full_brake", "--json", *drawn))
    paper = eb.load_scenario("paper-random")
    (other,) = eb.summarise(eb.evaluate(eb.read_worlds(paper, table), "full_brake", scenario=paper)).to_json()
    assert all(one[name] == other[name] for name in ("first_impact_harm", "total_harm", "scenario_sha256"))


def test_set__is_noted_in_a_training(ethbrake: Command, tiny_recipe: Path, tmp_path: Path) -> None:
    settings = ("--set", "seed=5", "--set", "restitution=0.2")
    assert ethbrake("train", "--recipe", tiny_recipe, *settings, "--output", tmp_path / "run").status == 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    told = config["settings"], config["recipe"]["seed"], config["scenario"]["restitution"]
    assert told == (["seed=5", "restitution=0.2"], 5, 0.2)


def test_new__on_a_table_has_its_rows(ethbrake: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "WORLDS", 10)
    rows = ", ".join(f"[{k}, 6, r{k}]" for k in range(7, 17))
    table = f"{{columns: [gap_1_m, gap_2_m, recording], rows: [[9, 8, a], [7, 6, 'b, c'], {rows}]}}"
    base = tmp_path / "base.yaml"
    base.write_text(f"name: base\ntable: {table}\nspeeds_mps: 20\nbraking_capacity_mps2: 6\n"
                    "driving_capacity_mps2: 6\nmass_t: 2\nlatency_s: 0.5\n")  # fmt: skip
    for name, based_on in (("mine", "recorded-openacc"), ("own", str(base))):
        ethbrake("scenario", "new", name, "--based-on", based_on, "--output", str(tmp_path))
        answer = ethbrake("scenario", "validate", str(tmp_path / f"{name}.yaml"))
        assert answer.status == 0 and re.search(r"\nrecording .* \.\.\.\s*\n", answer.out, re.DOTALL)
        new, old = (eb.load_scenario(path) for path in (str(tmp_path / f"{name}.yaml"), based_on))
        assert new.table == old.table
    refused = ethbrake("scenario", "new", "own", "--based-on", str(base), "--output", str(tmp_path))
    assert refused.status == 2 and "own.yaml" in refused.err
