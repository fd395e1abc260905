"""``ethbrake scenario`` and ``ethbrake recipe``, ``--set``, and the pages that show them."""

import json
import re
import runpy
from pathlib import Path

import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario, shipped_folder
from ethbrake_marl.first_edition.scenario.tables import read_worlds
from ethbrake_marl.first_edition.training.recipe import TrainingRecipe, load_recipe
from tests.fixtures.commands import Answer, Command, check_refused, told_json

ROOT = Path(__file__).resolve().parents[2]
TUTORIAL = (ROOT / "docs" / "first-ten-minutes.md").read_text("utf-8")


SCRIPTS = """
import numpy as np
import ethbrake_marl.first_edition as eb


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


def change_lines(path: str, page: str) -> None:
    """The lines of a scenario that the page's first YAML block changes."""
    block = re.search(r"```yaml\n(.*?)```", page, re.DOTALL)
    text = Path(path).read_text()
    for line in block[1].splitlines():
        text, count = re.subn(rf"(?m)^{line.partition(':')[0]}: .*$", line, text)
        assert count == 1
    Path(path).write_text(text)


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
