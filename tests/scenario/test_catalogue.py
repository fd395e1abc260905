from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.files.yaml import flow_text, read_yaml
from ethbrake_marl.learning.training import TrainingRecipe
from ethbrake_marl.scenario import (
    Scenario,
    list_scenarios,
    load_scenario,
    new_scenario_text,
    parse_yaml,
    scenario_json_schema,
    scenario_path,
    schema as shipped_files,
    shipped_folder,
)
from ethbrake_marl.scenario.sampling import QUANTITY

SHIPPED = [entry.path for entry in list_scenarios()]
ROOT = Path(__file__).resolve().parents[2]

# gaps, speeds, latencies as the paper states them (or as our labelled defaults for its three delays).
PAPER = {
    "paper-random": ({"uniform": [5, 10]}, {"uniform": [18, 22]}, [0, 0.5, 0.8]),
    "paper-random-early": ({"uniform": [5, 10]}, {"uniform": [18, 22]}, [0, 0.2, 0.8]),
    "paper-distance": ({"uniform": [5, 10]}, [20, 18, 20], [0, 0.5, 0.8]),
    "paper-scenario-1": ([10, 8], [20, 18, 20], [0, 0.5, 0.8]),
    "paper-scenario-2": ([5, 9], [22, 18, 20], [0, 0.5, 0.8]),
    "paper-delay-low": ({"uniform": [5, 10]}, {"uniform": [18, 22]}, [0, 0.1, 0.3]),
    "paper-delay-middle": ({"uniform": [5, 10]}, {"uniform": [18, 22]}, [0, 0.3, 0.6]),
    "paper-delay-high": ({"uniform": [5, 10]}, {"uniform": [18, 22]}, [0, 0.8, 1.2]),
}


def not_used(scenario: Scenario) -> set[str]:
    """The keys of the ways to declare gaps, speeds and an obstacle that it does not use; what it does not choose."""
    if scenario.members:
        return set(Scenario.model_fields) - {"name", "title", "description", "source", "mixture"}
    gaps = "gaps_m" if scenario.gaps_m is None else "time_gaps_s"
    speeds = {"speeds_mps"} if scenario.speeds_mps is None else {"line_speed_mps", "speed_deviations_mps"}
    obstacle = {key for key in ("obstacle_gap_m", "obstacle_margin_m") if getattr(scenario, key) is None}
    chosen = ("observation", "vehicle_types", "types", "mixture", *QUANTITY.needed)
    return {gaps, *speeds, *obstacle, *(key for key in chosen if getattr(scenario, key) is None)}


def test_list__is_sorted_and_has_the_papers_scenarios():
    entries = list_scenarios()
    names = [entry.name for entry in entries]
    assert names == sorted(names)
    assert set(PAPER) <= set(names)
    assert all(entry.title and entry.path.is_file() for entry in entries)


def test_shipped_names__are_unique():
    stems = [path.stem for path in shipped_folder().rglob("*.yaml")]
    assert len(stems) == len(set(stems))


@pytest.mark.parametrize("name", list(PAPER))
def test_paper_scenarios__have_the_papers_values(name):
    scenario = load_scenario(name)
    gaps, speeds, latencies = PAPER[name]
    declared = scenario.declared()
    assert declared["gaps_m"] == gaps
    assert declared["speeds_mps"] == speeds
    assert declared["latency_s"] == latencies
    assert declared["braking_capacity_mps2"] == declared["driving_capacity_mps2"] == [6, 7, 6]
    assert declared["mass_t"] == [4.5, 5.5, 5.9]
    assert (scenario.vehicles, scenario.restitution, scenario.early_impacts) == (3, 0.1, "reject")
    assert (scenario.time_step_s, scenario.horizon_s, scenario.speed_limit_mps) == (0.1, 8.0, 40.0)
    assert scenario.learners == (1,)
    assert scenario.scripts == {0: "full_brake", 2: "full_brake"}


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_files__round_trip(path):
    scenario = load_scenario(path.stem)
    assert load_scenario(path) == scenario
    text = "\n".join(f"{key}: {flow_text(value)}" for key, value in scenario.declared().items())
    assert Scenario.from_document(parse_yaml(text)) == scenario
    assert scenario.sample(3, 0).worlds.n == 3
    assert scenario.title
    assert scenario.description
    assert scenario.source


def test_unknown_name__is_suggested():
    with pytest.raises(UnknownName, match="unknown scenario 'paper-randon'; did you mean 'paper-random'"):
        load_scenario("paper-randon")
    with pytest.raises(UnknownName, match=r"known: cooperation-0-sensors, .*paper-delay-high, "):
        load_scenario("zzz")


@pytest.mark.parametrize("path", ["missing.yaml", "missing.yml", "folder/missing", "./missing"])
def test_path__is_what_looks_like_one(path):
    with pytest.raises(InvalidInput, match=r"missing(\.ya?ml)?: no such file"):
        load_scenario(path)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_path__of_a_shipped_one_may_be_folder_and_short_name(path: Path):
    folder = path.parent.name
    assert path.stem.startswith(f"{folder}-")
    assert load_scenario(f"{folder}/{path.stem.removeprefix(f'{folder}-')}") == load_scenario(path.stem)
    with pytest.raises(InvalidInput, match="no such file"):
        load_scenario(f"{folder}/{path.stem}")


def test_path__a_file_that_exists_goes_before_the_shipped_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stress").mkdir()
    (tmp_path / "stress" / "wide").write_text(new_scenario_text("wide"))
    assert load_scenario("stress/wide").name == "wide"
    assert load_scenario("stress-wide").name == "stress-wide"


@pytest.mark.parametrize("suffix", [".yaml", ".yml"])
def test_path__the_users_own_file(tmp_path: Path, suffix: str):
    path = tmp_path / f"mine{suffix}"
    path.write_text(new_scenario_text("mine"))
    assert load_scenario(path) == load_scenario(str(path))
    assert load_scenario(path).name == "mine"


def test_path__name_and_file_must_agree(tmp_path: Path):
    path = tmp_path / "other.yaml"
    path.write_text(new_scenario_text("mine"))
    with pytest.raises(InvalidInput, match=r"other\.yaml, line \d+: name = mine: must be the file's name, other"):
        load_scenario(path)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_new__has_every_key_and_the_values_it_is_based_on(path):
    text = new_scenario_text("mine", based_on=path.stem)
    own = {"name", "title", "description", "source"}
    new, base = load_scenario(parse_yaml(text).content), load_scenario(path.stem)
    assert new.model_dump(exclude=own) == base.model_dump(exclude=own)
    assert new.name == "mine"
    assert all(re.search(rf"^# .*\n(# )?{key}:", text, re.MULTILINE) for key in Scenario.model_fields)
    assert {key for key in Scenario.model_fields if f"\n# {key}:" in text} == not_used(base)
    assert not re.search(r"[ \t]$", text, re.MULTILINE)


@pytest.mark.parametrize("name", ["", "My Scenario", "-x", "x" * 65, "../x", "x\n"])
def test_new__refuses_a_name_that_cannot_be_one(name):
    with pytest.raises(InvalidInput, match="must be 1 to 64 lower case letters"):
        new_scenario_text(name)


def test_json_schema__names_every_field_and_serialises():
    schema = json.loads(json.dumps(scenario_json_schema()))
    assert set(schema["properties"]) == set(Scenario.model_fields)
    assert schema["additionalProperties"] is False
    assert schema["required"] == ["name"]
    assert schema["if"] == {"not": {"required": ["mixture"]}}  # whose members say everything else
    every = schema["then"]["allOf"][-1]["anyOf"]
    assert [way["required"] for way in every] == [["vehicle_types"], [*QUANTITY.needed]]


@pytest.mark.parametrize("name", [entry.name for entry in list_scenarios()])
def test_json_schema__lets_shipped_and_new_scenarios_pass(name: str) -> None:
    editor = Draft202012Validator(scenario_json_schema())
    for content in (read_yaml(scenario_path(name)).content, parse_yaml(new_scenario_text("mine", name), "x").content):
        assert [error.message for error in editor.iter_errors(content)] == []


def test_json_schema__asks_for_one_of_two_ways_and_knows_no_null():
    schema = scenario_json_schema()
    pairs = [[way["required"] for way in pair["oneOf"]] for pair in schema["then"]["allOf"][:2]]
    assert pairs == [[["gaps_m"], ["time_gaps_s"]], [["speeds_mps"], ["line_speed_mps"]]]
    optional = schema["then"]["allOf"][2]
    assert optional == {"not": {"required": ["obstacle_gap_m", "obstacle_margin_m"]}}  # not both
    assert schema["dependentRequired"] == {"speed_deviations_mps": ["line_speed_mps"]}
    assert "null" not in json.dumps(schema)
    assert schema["properties"]["time_step_s"]["default"] == 0.1


def test_docs__the_table_of_keys_has_every_field_with_its_default():
    page = (ROOT / "docs" / "scenarios.md").read_text()
    rows = dict(re.findall(r"^\| `(\w+)` \|(.*)\|$", page, re.MULTILINE))
    assert set(rows) == set(Scenario.model_fields)
    for key, field in Scenario.model_fields.items():
        cells = [cell.strip() for cell in rows[key].split("|")]
        if field.is_required():
            assert cells[0] == "required", key
        elif field.default is None:
            other = {"gaps_m": "time_gaps_s", "speeds_mps": "line_speed_mps"}
            other |= {new: usual for usual, new in other.items()}
            assert cells[0] == (f"this or `{other[key]}`" if key in other else "none")
        elif field.default_factory is None:
            assert cells[0] == (f"`{flow_text(field.default)}`" if field.default != "" else "empty"), key


def test_docs__the_example_is_a_valid_scenario():
    page = (ROOT / "docs" / "scenarios.md").read_text()
    examples = re.findall(r"^```yaml\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    whole = [text for text in examples if text.startswith("name:")]
    assert whole
    for text in whole:
        assert Scenario.from_document(parse_yaml(text, "docs/scenarios.md")).sample(10, 0).worlds.n == 10


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("gaps_m: {uniform: [5, 10]}", "gaps_km: 0.007"),
        ("mass_t: [4.5, 5.5, 5.9]", "mass_t: [4.5, -5.5, 5.9]"),
        ("speeds_mps: {uniform: [18, 22]}", "speeds_mps: {uniform: [18, 45]}"),
        ("\n# Every gap and every speed is drawn on its own.", "time_gaps_s: 1"),
        ("speeds_mps: {uniform: [18, 22]}", "line_speed_mps: 39\nspeed_deviations_mps: {uniform: [-2, 2]}"),
    ],
)
def test_docs__the_mistakes_are_answered_as_printed(old, new):
    text = (shipped_folder() / "paper" / "paper-random.yaml").read_text()
    assert old in text
    with pytest.raises(InvalidInput) as caught:
        Scenario.from_document(parse_yaml(text.replace(old, new), "my.yaml"))
    assert f"\n{caught.value}\n" in (ROOT / "docs" / "scenarios.md").read_text()


def test_folder__of_an_installed_package_is_inside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(shipped_files, "_PACKAGE", tmp_path / "ethbrake_marl")
    with pytest.raises(InvalidInput, match=r"the shipped scenarios are missing: .*reinstall"):
        shipped_folder()
    installed = tmp_path / "ethbrake_marl" / "_data" / "scenarios"
    installed.mkdir(parents=True)
    (tmp_path / "scenarios").mkdir()  # somebody else's folder: no pyproject.toml beside it
    assert shipped_folder() == installed
    (tmp_path / "pyproject.toml").touch()
    assert shipped_folder() == tmp_path / "scenarios"


def test_folder__of_recipes_follows_the_same_rule(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(shipped_files, "_PACKAGE", tmp_path / "ethbrake_marl")
    with pytest.raises(InvalidInput, match=r"the shipped recipes are missing: .*reinstall"):
        TrainingRecipe.shipped()
    installed = tmp_path / "ethbrake_marl" / "_data" / "train"
    installed.mkdir(parents=True)
    (installed / "mine.yaml").touch()
    assert TrainingRecipe.shipped() == {"mine": installed / "mine.yaml"}


def test_new__says_that_a_latency_must_be_below_the_horizon():
    (line,) = (line for line in new_scenario_text("mine").splitlines() if "3600" in line and "commands" in line)
    assert line.endswith("below horizon_s")
