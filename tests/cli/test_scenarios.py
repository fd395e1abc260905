"""``ethbrake scenario`` and ``ethbrake recipe``, ``--set``, and the pages that show them."""

import csv
import json
import re
import runpy
from pathlib import Path

import pytest

import ethbrake_marl as eb
from ethbrake_marl.evaluation.trial import load_runnable
from ethbrake_marl.files.yaml import flow_text, parse_yaml
from ethbrake_marl.scenario.catalogue import list_scenarios, load_scenario, shipped_folder
from ethbrake_marl.scenario.fields import QUANTITY
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.scenario.tables import read_worlds
from ethbrake_marl.training.recipe import TrainingRecipe, load_recipe
from tests.fixtures.commands import Answer, Command, check_refused, rows_of, told_json

ROOT = Path(__file__).resolve().parents[2]
TUTORIAL = (ROOT / "docs" / "first-ten-minutes.md").read_text("utf-8")
OWN_DATA = (ROOT / "docs" / "scenarios.md").read_text("utf-8").partition("\n## Your own vehicle data\n")[2]


SCRIPTS = """
import numpy as np
import ethbrake_marl as eb


class Own:
    def __init__(self, name):
        self.name, self.state_free = name, name == "own_fixed"

    def act(self, worlds, vehicle):
        own = worlds.vehicles.braking_capacity_mps2[:, vehicle]
        if self.name == "own_fails" and worlds.time_s.max() > 1.0:
            raise ZeroDivisionError("no gap")
        return -own * np.where((self.name == "own_greedy") & (worlds.speeds_mps[:, 0] > 16.0), 2.0, 0.5)


for name in ("own_calm", "own_fixed", "own_greedy", "own_fails"):
    eb.register_agent(name, lambda argument, settings: Own(settings.spec))
"""


@pytest.mark.usefixtures("core_alone")
def test_validate__drives_scripts_and_tells_what_refuses_them(ethbrake: Command, scenario_file, tmp_path) -> None:
    (tmp_path / "scripts.py").write_text(SCRIPTS)
    runpy.run_path(str(tmp_path / "scripts.py"))

    def tried(script: str, *more: str) -> Answer:
        path = scenario_file("\n  vehicle_3: full_brake\n", f"\n  vehicle_3: {script}\n")
        path.write_text(path.read_text().replace("early_impacts: reject", "early_impacts: keep"))
        return ethbrake("scenario", "validate", path, *more)

    calm = told_json(tried("own_calm", "--json"))
    assert calm["not_state_free"] == {"vehicle_3": "own_calm"} and not calm["commands_out_of_range"]
    assert {"e_v2x_bm", "+step"} < calm["refused_by"].keys()
    assert "command is not fixed at the alert" in calm["refused_by"]["+step"]
    assert told_json(tried("own_fixed", "--json"))["refused_by"].keys() == {"early_impacts: reject"}
    greedy = tried("own_greedy")
    (many,) = re.findall(r"the command of vehicle_3 exceeds its capacity in (\d+) of 200 worlds", greedy.out)
    fast = load_scenario("paper-random").sample(200, 7).worlds.speeds_mps[:, 0]
    braked = fast - 0.8 * 6.0  # when Vehicle 3 may act
    assert greedy.status == 2 and greedy.out.startswith("NOT OK") and int(many) == (braked > 16.0).sum() > 0
    check_refused(tried("own_fails"), "of vehicle_3: act on 200 worlds at 1.", "ZeroDivisionError: no gap")


def test_validate_and_explain__stay_short_where_each_vehicle_draws_alone(ethbrake: Command, tmp_path: Path) -> None:
    each = [{"uniform": [4, 5 + 0.1 * i]} for i in range(40)]
    drawn = dict.fromkeys(("braking_capacity_mps2", "driving_capacity_mps2", "mass_t"), each)
    roles = {"vehicle_1": "coast", "vehicle_2": "learner", "vehicle_3": "coast"}
    usual = {"vehicles": 40, "latency_s": 0.4, "early_impacts": "keep", "roles": roles}
    declared = {**load_scenario("paper-random").declared(), "name": "long", **usual, **drawn}
    (tmp_path / "long.yaml").write_text(json.dumps(declared))
    lines = ethbrake("scenario", "validate", tmp_path / "long.yaml").out.splitlines()
    assert 0 < len(lines) <= 24 and max(map(len, lines)) <= 80
    sentences = told_json(ethbrake("scenario", "explain", tmp_path / "long.yaml", "--json"))["sentences"]
    assert len(sentences) <= 20 and len(ethbrake("scenario", "explain", tmp_path / "long.yaml").out.splitlines()) <= 40


def test_explain__tells_every_quantity_that_is_declared(ethbrake: Command) -> None:
    for entry in list_scenarios():
        told = " ".join(told_json(ethbrake("scenario", "explain", entry.name, "--json"))["sentences"])
        scenario = load_scenario(entry.name)
        keys = set(scenario.declared()) & set(QUANTITY.declared)
        assert all(QUANTITY.declared[key].meaning in told for key in keys), entry.name
        assert scenario.title in told and f"truncated after {scenario.horizon_s:g} s" in told
    assert "Time gaps (s): 0.19 to 1.75 (normal, mean 0.97, sd 0.26), drawn for each pair" in " ".join(
        ethbrake("scenario", "explain", "realistic-motorway").out.split()
    )


def test_show_and_new__are_the_files_and_force_replaces_one(ethbrake: Command, tmp_path: Path) -> None:
    shipped = {entry["name"]: entry["path"] for entry in told_json(ethbrake("scenario", "list", "--json"))}
    assert ethbrake("scenario", "show", "stress/wide").out == Path(shipped["stress-wide"]).read_text()
    path = tmp_path / "mine.yaml"
    path.write_text("precious")
    words = ("scenario", "new", "mine", "--based-on", "paper-scenario-1", "--output", tmp_path, "--force")
    assert ethbrake(*words).status == 0 and "gaps_m: [10, 8]" in path.read_text()
    assert ethbrake("scenario", "show", path).out == path.read_text()


def test_sample__draws_the_worlds_that_evaluate_draws(ethbrake: Command, tmp_path: Path) -> None:
    table, drawn = tmp_path / "worlds.csv", ("--episodes", "20", "--seed", "4")
    table.write_text(ethbrake("scenario", "sample", "paper-random", *drawn).out)
    (one,) = told_json(ethbrake("evaluate", "--agents", "full_brake", "--json", *drawn))
    paper = eb.load_scenario("paper-random")
    (row,) = eb.summarise(eb.evaluate(read_worlds(paper, table), "full_brake", scenario=paper))
    other = row.to_json()
    assert all(one[name] == other[name] for name in ("first_impact_harm", "worlds_sha256"))


@pytest.mark.parametrize(
    "name", [name for name, file in TrainingRecipe.shipped().items() if file.parent == shipped_folder("train")]
)
def test_new_recipe__has_every_key_with_a_comment_and_the_same_values(name: str, tmp_path: Path) -> None:
    check_new_recipe(name, tmp_path / "mine.yaml")


def check_new_recipe(based_on: str, file: Path) -> None:
    text = load_recipe(based_on).new_text("mine")
    file.write_text(text)
    made, base = load_recipe(file), load_recipe(based_on)
    words = {"name", "title", "description", "source"}
    assert made.model_dump(exclude=words) == base.model_dump(exclude=words)
    lines = text.splitlines()
    for key in type(base).model_fields:
        (number,) = (k for k, line in enumerate(lines) if line.removeprefix("# ").startswith(f"{key}:"))
        assert lines[number - 1].startswith("# "), key


def test_set__is_noted_in_a_training(ethbrake: Command, tiny_recipe: Path, tmp_path: Path) -> None:
    settings = ("--set", "seed=5", "--set", "restitution=0.2")
    assert ethbrake("train", "--recipe", tiny_recipe, *settings, "--output", tmp_path / "run").status == 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    told = config["settings"], config["recipe"]["seed"], config["scenario"]["restitution"]
    assert told == (["seed=5", "restitution=0.2"], 5, 0.2)


def test_tutorial__own_worlds_give_the_printed_harms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    worlds, out = Path("mine.csv"), Path("worlds.csv")
    worlds.write_text(
        "gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps\n10,8,20,18,20\n5,9,22,18,20\n7,7,20,18,20\n"
    )
    (program,) = re.findall(r"```python\n([^`]*mine\.csv[^`]*)```", TUTORIAL)
    exec(program, {})
    assert worlds.read_text() in TUTORIAL
    printed = re.search(r"\n(agent,world,[^`]+)```", TUTORIAL)
    for old, new in zip(csv.DictReader(printed[1].splitlines()), rows_of(out), strict=True):
        names, harms = ("agent", "world", "impacts"), ("total_harm", "first_impact_harm")
        assert [old[name] for name in names] == [new[name] for name in names]
        assert [float(old[harm]) for harm in harms] == pytest.approx([float(new[harm]) for harm in harms], rel=1e-9)


def test_tutorial__its_program_prints_what_stands_below_it(capsys) -> None:
    found = re.search(r"```python\n(import numpy.*?)```\n\n```\n(.*?)```", TUTORIAL, re.DOTALL)
    exec(found[1], {})
    now = [float(word) for word in capsys.readouterr().out.split()]
    assert now == pytest.approx([float(word) for word in found[2].split()], rel=1e-9)


def change_lines(path: str, page: str) -> None:
    """The lines of a scenario that the page's first YAML block changes."""
    block = re.search(r"```yaml\n(.*?)```", page, re.DOTALL)
    text = Path(path).read_text()
    for line in block[1].splitlines():
        text, count = re.subn(rf"(?m)^{line.partition(':')[0]}: .*$", line, text)
        assert count == 1
    Path(path).write_text(text)


def test_how_to_own_data__its_table_is_read_and_its_distributions_are_valid(tmp_path: Path) -> None:
    paper = load_runnable("paper-random")
    table = re.search(r"```text\n(gap_1_m.*?)```", OWN_DATA, re.DOTALL)
    (tmp_path / "mine.csv").write_text(table[1])
    vehicles = read_worlds(paper, tmp_path / "mine.csv").vehicles
    assert (vehicles.mass_t[:, 1].tolist(), vehicles.braking_capacity_mps2[:, 1].tolist()) == ([1.4, 12], [7.5, 5.5])
    blocks = (parse_yaml(text, "page").content for text in re.findall(r"```yaml\n(.*?)```", OWN_DATA, re.DOTALL))
    drawn, typed, rows = blocks
    assert set(paper.replace(**drawn).sample(100, 7).worlds.vehicles.mass_t.flat) == {1.3, 1.5, 1.9, 2.4}
    content = {key: value for key, value in paper.declared().items() if key not in typed["vehicle_types"]["car"]}
    assert set(Scenario(**content, **typed).sample(100, 7).types.flat) == {"car", "truck"}
    (tmp_path / "triples.csv").write_text(
        "seconds,gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps\n2,10,9,20,19,18\n"
    )
    keys = {key: value for key, value in paper.declared().items() if key not in ("name", "gaps_m", "speeds_mps")}
    text = "\n".join(f"{key}: {flow_text(value)}" for key, value in {"name": "mine", **keys, **rows}.items())
    (tmp_path / "mine.yaml").write_text(text)
    assert load_runnable(tmp_path / "mine.yaml").sample(2, 7).worlds.speeds_mps.tolist() == [[20, 19, 18]] * 2


def test_new__on_a_table_has_its_rows_beside_it(ethbrake: Command, tmp_path: Path) -> None:
    weighed = "{columns: [gap_1_m, gap_2_m, recording], rows: [[9, 8, a], [7, 6, 'b, c']], weights: [1, 3]}"
    base = tmp_path / "base.yaml"
    base.write_text(f"name: base\ntable: {weighed}\nspeeds_mps: 20\nbraking_capacity_mps2: 6\n"
                    "driving_capacity_mps2: 6\nmass_t: 2\nlatency_s: 0.5\n")  # fmt: skip
    for name, based_on in (("mine", "recorded-openacc"), ("own", str(base))):
        ethbrake("scenario", "new", name, "--based-on", based_on, "--output", str(tmp_path))
        assert ethbrake("scenario", "validate", str(tmp_path / f"{name}.yaml")).status == 0
        new, old = (eb.load_scenario(path) for path in (str(tmp_path / f"{name}.yaml"), based_on))
        assert new.table == old.table.model_copy(update={"file": ""}) and (tmp_path / f"{name}.csv").is_file()
    refused = ethbrake("scenario", "new", "own", "--based-on", str(base), "--output", str(tmp_path))
    assert refused.status == 2 and "own.yaml" in refused.err
