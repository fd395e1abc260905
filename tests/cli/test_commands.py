"""What each command prints, and where."""

from __future__ import annotations

import csv
import json
import re
import shlex
from pathlib import Path

import pytest

from ethbrake_marl.cli.app import whole_command
from ethbrake_marl.cli.command import DEFAULTS, MOVED

IMPLIED = {f"{group} {default}": group for group, default in DEFAULTS.items()}
COMMANDS = [""]  # every one, groups too
for name, found in whole_command().commands.items():
    COMMANDS += [name, *(f"{name} {each}" for each in getattr(found, "commands", ()))]
COMMANDS += [f"watch picture {each}" for each in whole_command().commands["watch"].commands["picture"].commands]


@pytest.mark.parametrize("command", COMMANDS)
def test_help__has_examples_that_parse_and_a_short_name(ethbrake, command):
    answer = ethbrake(*command.split(), "--help")
    assert (answer.status, answer.err) == (0, "")
    assert ethbrake(*command.split(), "-h").out == answer.out and "-h, --help" in answer.out
    examples = [" ".join(each.split()) for each in re.findall(r"Example: ethbrake ((?:.|\n(?!\n))+)", answer.out)]
    assert len(examples) == (2 if "\nCommands:" in answer.out else 1)
    for example in examples:
        arguments = shlex.split(example.partition(" >")[0])
        assert " ".join(arguments).startswith(
            command.removesuffix(f" {DEFAULTS.get(command.split()[0]) if command else None}")
        )
        assert ethbrake(*arguments, "--help").status == 0


@pytest.mark.parametrize("old", sorted(MOVED))
def test_old_name__is_told_its_new_place(ethbrake, old):
    answer = ethbrake(old, "--frob")
    assert (answer.status, answer.out) == (2, "") and MOVED[old] in COMMANDS
    assert answer.err == f"ethbrake: error: {old} is now: {MOVED[old]} (see: ethbrake --help)\n"


@pytest.mark.parametrize(
    ("wrong", "place"),
    [
        ("evalute", "did you mean: ethbrake evaluate?"),
        ("falsfy", "did you mean: ethbrake search falsify?"),
        ("learning-curve", "did you mean: ethbrake train curves?"),
        ("train resum", "did you mean: ethbrake train resume?"),
        ("study resume", "did you mean: ethbrake train resume?"),
        ("watch pictures", "did you mean: ethbrake watch picture?"),
        ("watch picture map", "known: criticality, deceleration, shield, shield-modes, robustness"),
        ("doctor please", "known: check, speed"),
    ],
)
def test_wrong_name__is_told_the_nearest_place(ethbrake, wrong, place):
    answer = ethbrake(*wrong.split())
    told = f"unknown command {wrong.split()[-1]!r}; {place}"
    group = " ".join(["ethbrake", *wrong.split()[:-1]])
    assert (answer.status, answer.err) == (2, f"ethbrake: error: {told} (see: {group} --help)\n")


def test_default_command__has_its_options_on_the_page_of_its_group_and_behind_its_name(ethbrake):
    for group, default in DEFAULTS.items():
        page, own = ethbrake(group, "--help").out, ethbrake(group, default, "--help").out
        options = own.partition("\nOptions:\n")[2].partition("\n\n")[0]
        assert "--json" in options and options in page
    assert ethbrake("doctor", "check", "--json").out == ethbrake("doctor", "--json").out
    assert "Missing option '--agent'" in ethbrake("benchmark", "v2").err


def test_scenario_sample__draws_the_worlds_that_evaluate_draws(ethbrake, tmp_path):
    table, scenario = tmp_path / "worlds.csv", "paper-random"
    told = ethbrake("scenario", "sample", scenario, "--episodes", "20", "--seed", "4", "--output", table, "--json")
    assert told.status == 0 and told.err == f"worlds: {table}\n"
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert [{name: float(value) for name, value in row.items()} for row in rows] == json.loads(told.out)
    assert ethbrake("scenario", "sample", scenario, "--episodes", "20", "--seed", "4").out == table.read_text()
    agents = ("evaluate", "--agents", "full_brake", "--json")
    (drawn,) = json.loads(ethbrake(*agents, "--episodes", "20", "--seed", "4").out)
    (given,) = json.loads(ethbrake(*agents, "--initial-states", table).out)
    assert drawn["first_impact_harm"] == given["first_impact_harm"] and drawn["worlds_sha256"] == given["worlds_sha256"]
    again = ethbrake("scenario", "sample", scenario, "--output", table)
    assert again.status == 2 and "is there already" in again.err
    assert "must end in .csv" in ethbrake("scenario", "sample", scenario, "--output", tmp_path / "x.txt").err


@pytest.mark.parametrize("command", ["run", "train", "evaluate"])
def test_help__long_commands_have_a_seed_and_json(ethbrake, command):
    out = ethbrake(command, "--help").out
    assert "--seed" in out
    assert "--json" in out
    assert "--force" in out


def test_evaluate__prints_a_table_with_the_papers_rows(ethbrake):
    answer = ethbrake("evaluate", "--episodes", "40", "--agents", "full_brake,e_v2x_bm")
    assert answer.status == 0
    assert "full_brake" in answer.out
    assert "Hybrid PPO" in answer.out
    assert "40 worlds, seed 7" in " ".join(answer.out.split())
    assert "40 of 40" in answer.err


def test_evaluate_json__is_pure_and_complete(ethbrake):
    answer = ethbrake("evaluate", "--episodes", "40", "--json")
    assert answer.status == 0
    rows = json.loads(answer.out)
    assert [row["agent"] for row in rows] == ["full_brake", "e_v2x_bm", "e_v2x_bm:pairwise"]
    for row in rows:
        assert row["episodes"] == 40
        assert 0.0 <= row["collision_rate"] <= 1.0
        assert row["total_harm"] >= row["first_impact_harm"]
    assert [("predicted_harm" in row) for row in rows] == [False, True, True]
    assert rows[0]["parameters"]["seed"] == 7


def test_evaluate__same_seed_same_figures_other_seed_others(ethbrake):
    first, again, other = (ethbrake("evaluate", "--episodes", "20", "--seed", s, "--json").out for s in "112")
    assert first == again
    assert first != other


def test_evaluate_count__total_never_has_more_total_harm(ethbrake):
    arguments = ("evaluate", "--episodes", "200", "--agents", "e_v2x_bm", "--json", "--harm-count")
    (first,), (total,) = (json.loads(ethbrake(*arguments, count).out) for count in ("first", "total"))
    assert total["total_harm"] < first["total_harm"]
    assert total["first_impact_harm"] > first["first_impact_harm"]


def test_evaluate_vehicle__the_driven_one_is_the_named_one(ethbrake):
    answer = ethbrake("evaluate", "--episodes", "20", "--agents", "full_brake", "--vehicle", "vehicle_3", "--json")
    (row,) = json.loads(answer.out)
    assert row["parameters"]["controlled_vehicle"] == "vehicle_3"
    assert row["parameters"]["scripts"] == {"vehicle_1": "full_brake", "vehicle_2": "full_brake"}


def test_evaluate_initial_states__a_world_computed_by_hand(ethbrake, tmp_path):
    # Vehicle 2 at 10 m/s coasts 5 m in its 0.5 s and brakes the last 3 m with 7 m/s2 towards a standing Vehicle 1:
    # closing speed squared 10^2 - 2 * 7 * 3 = 58. Vehicle 3 stands 5 km behind. In the second world nobody moves.
    worlds, out = tmp_path / "worlds.csv", tmp_path / "out.csv"
    worlds.write_text(
        "gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps,restitution\n8,5000,0,10,0,0\n8,5000,0,0,0,0\n"
    )
    answer = ethbrake("evaluate", "--initial-states", worlds, "--agents", "full_brake", "--per-world", out, "--json")
    assert answer.status == 0
    (row,) = json.loads(answer.out)
    assert (row["episodes"], row["collision_rate"]) == (2, 0.5)
    assert row["first_impact_harm"] == pytest.approx(29.0, rel=1e-12)
    hit, still = csv.DictReader(out.read_text().splitlines())
    assert float(hit["total_harm"]) == pytest.approx(58.0, rel=1e-12)
    assert (hit["collided"], hit["impacts"]) == ("1", "1")
    assert (still["collided"], still["total_harm"], still["final_gap_1_m"]) == ("0", "0.0", "8.0")


def test_evaluate_per_world__its_initial_states_give_the_same_harms(ethbrake, tmp_path):
    drawn, again, worlds = tmp_path / "drawn.csv", tmp_path / "again.csv", tmp_path / "worlds.csv"
    agents = ("--agents", "full_brake,e_v2x_bm", "--json")
    list_answer = ethbrake("evaluate", "--episodes", "30", "--seed", "4", *agents, "--per-world", drawn)
    rows = list(csv.DictReader(drawn.read_text().splitlines()))
    assert [row["agent"] for row in rows] == ["full_brake"] * 30 + ["e_v2x_bm"] * 30
    given = ["gap_1_m", "gap_2_m", "speed_1_mps", "speed_2_mps", "speed_3_mps"]
    lines = [",".join(row[column] for column in given) for row in rows[:30]]
    worlds.write_text("\n".join([",".join(given), *lines]) + "\n")
    given_answer = ethbrake("evaluate", "--initial-states", worlds, *agents, "--per-world", again)
    assert drawn.read_text() == again.read_text()
    for drawn_row, given_row in zip(json.loads(list_answer.out), json.loads(given_answer.out), strict=True):
        assert drawn_row["parameters"].pop("seed") == 4
        assert given_row["parameters"].pop("seed") is None
        assert (drawn_row["per_world"].pop("file"), given_row["per_world"].pop("file")) == ("drawn.csv", "again.csv")
        assert drawn_row == given_row


def test_scenario_list__names_every_shipped_scenario(ethbrake):
    lines = ethbrake("scenario", "list").out.splitlines()
    names = [entry["name"] for entry in json.loads(ethbrake("scenario", "list", "--json").out)]
    assert [line.split()[0] for line in lines] == names
    assert {"paper-random", "paper-random-early", "paper-scenario-1"} <= set(names)


def test_scenario_show__prints_the_file_itself(ethbrake, scenario_file):
    path = scenario_file("\nrestitution: 0.1", "\nrestitution: 0.2")
    assert ethbrake("scenario", "show", path).out == path.read_text()
    shipped = Path(next(e["path"] for e in json.loads(ethbrake("scenario", "list", "--json").out)))
    assert ethbrake("scenario", "show", shipped.stem).out == shipped.read_text()


def test_scenario_new__is_valid_and_carries_the_values_it_started_from(ethbrake, tmp_path):
    assert ethbrake("scenario", "new", "mine", "--based-on", "paper-scenario-1", "--output", tmp_path).status == 0
    path = tmp_path / "mine.yaml"
    answer = ethbrake("scenario", "validate", path)
    assert answer.status == 0
    assert answer.out.startswith("OK  mine: 3 vehicles, learners: vehicle_2; 1,000 worlds drawn")
    assert "gaps_m: [10, 8]" in path.read_text()


def test_scenario_validate__counts_the_refused_draws(ethbrake, scenario_file):
    path = scenario_file("\ngaps_m: {uniform: [5, 10]}", "\ngaps_m: {choice: [0.1, 10]}")
    answer = ethbrake("scenario", "validate", path)
    assert answer.status == 0
    refused = re.search(r"([\d,]+) more refused", answer.out)
    assert refused is not None
    assert int(refused[1].replace(",", "")) > 100


def test_scenario_schema__is_a_json_schema(ethbrake):
    schema = json.loads(ethbrake("scenario", "schema").out)
    assert schema["$schema"].startswith("https://json-schema.org/")
    assert schema["required"] == ["name"]
    assert {"oneOf": [{"required": ["gaps_m"]}, {"required": ["time_gaps_s"]}]} in schema["then"]["allOf"]


def test_scenario__folder_and_short_name_of_a_shipped_one(ethbrake):
    assert ethbrake("scenario", "show", "stress/wide").out == ethbrake("scenario", "show", "stress-wide").out
    assert ethbrake("scenario", "validate", "stress/wide").out.startswith("OK  stress-wide: 3 vehicles")


def test_evaluate__several_learners_and_objectives(ethbrake, tmp_path):
    worlds = tmp_path / "worlds.csv"
    words = ["evaluate", "--scenario", "cooperation-3-pair", "--episodes", "20", "--agents", "full_brake,e_v2x_bm"]
    words += ["--objective", "own", "--objective", "weighted:1,4,1"]
    rows = json.loads(ethbrake(*words, "--per-world", worlds, "--json").out)
    assert rows[0]["parameters"]["controlled_vehicles"] == ["vehicle_2", "vehicle_3"]
    told = [(one["objective"], one["harm_count"]) for one in rows[1]["objectives"]]
    assert told == [("own", "first"), ("weighted:1,4,1", "first"), ("own", "total"), ("weighted:1,4,1", "total")]
    own = rows[0]["objectives"][2]
    assert sum(own[f"vehicle_{i}"] for i in (1, 2, 3)) == pytest.approx(rows[0]["total_harm"])
    table = list(csv.DictReader(worlds.read_text().splitlines()))
    assert float(table[0]["own_total_3"]) == float(table[0]["total_harm_3"])
    answer = ethbrake(*words)
    assert "Objectives, first-impact harm" in answer.out and "weighted:1,4,1" in answer.out


def test_evaluate__what_drives_one_vehicle_only_is_refused_for_several(ethbrake, finished_run):
    answer = ethbrake("evaluate", "--scenario", "cooperation-3-pair", "--agents", f"ppo@{finished_run}+episode")
    assert answer.status == 2 and "vehicle_3 of scenario 'cooperation-3-pair' must be driven too" in answer.err
