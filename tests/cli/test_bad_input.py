"""Every bad input: exit status 2, one line that says where, what and what would be right, and nothing written."""

from __future__ import annotations

from pathlib import Path

import pytest

from ethbrake_marl.search import search_profiles


def refused(answer, *fragments: str) -> None:
    assert answer.status == 2
    assert answer.out == ""
    assert answer.err.startswith("ethbrake: error: ")
    assert answer.err.count("\n") == 1
    for fragment in fragments:
        assert fragment in answer.err


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_command_line__a_variable_of_shell_completion_changes_nothing(ethbrake, monkeypatch):
    monkeypatch.setenv("_ETHBRAKE_COMPLETE", "bash_source")
    answer = ethbrake("scenario", "list")
    assert (answer.status, answer.err) == (0, "")
    assert "paper-random" in answer.out
    refused(ethbrake("scenario", "show", "nowhere"), "nowhere")


SCENARIO_DEFECTS = [
    ("\ngaps_m: ", "\ngap_m: ", ["gap_m", "gaps_m"]),
    ("\nmass_t: [4.5, 5.5, 5.9]\n", "\n", ["mass_t", "missing"]),
    ("\nmass_t: ", "\nmass_kg: ", ["mass_kg", "mass_t", "tonnes"]),
    ("\nmass_t: [4.5, ", "\nmass_t: [-4.5, ", ["mass_t", "-4.5"]),
    ("\nrestitution: 0.1", "\nrestitution: .nan", ["restitution", "nan"]),
    ("\ngaps_m: {uniform: [5, 10]}", "\ngaps_m: [-1, 7]", ["gaps_m", "-1"]),
    ("\nlatency_s: [0, 0.5, 0.8]", "\nlatency_s: [0, 9, 0.8]", ["latency_s", "9", "horizon_s"]),
    ("\n  vehicle_3: full_brake\n", "\n  vehicle_3: full_brake\n  vehicle_4: coast\n", ["vehicle_4", "3"]),
    ("\n  vehicle_3: full_brake\n", "\n  vehicle_3: ful_brake\n", ["ful_brake", "did you mean full_brake?"]),
    ("\nname: mine", "\nname: mine\nname: mine", ["name", "mine.yaml"]),
    ("\nvehicles: 3", "\nvehicles: [", ["mine.yaml", "line"]),
]


@pytest.mark.parametrize(("old", "new", "fragments"), SCENARIO_DEFECTS)
def test_scenario_validate__a_defect_is_named_with_its_file(ethbrake, scenario_file, old, new, fragments):
    path = scenario_file(old, new)
    refused(ethbrake("scenario", "validate", path), str(path), *fragments)


IMPOSSIBLE_ROLES = [
    ("vehicle_3", "full_break", "unknown agent 'full_break'; did you mean 'full_brake'?"),
    ("vehicle_3", "gentlest_front:4", "gentlest_front takes no argument"),
    ("vehicle_1", "copy_leader", "vehicle_1 has no vehicle in front of it"),
]


@pytest.mark.parametrize(("role", "script", "reason"), IMPOSSIBLE_ROLES)
@pytest.mark.parametrize("command", ["validate", "run", "train", "evaluate"])
def test_scenario__a_script_that_cannot_play_is_named_with_its_line(
    ethbrake, scenario_file, tmp_path, command, role, script, reason
):
    path = scenario_file(f"\n  {role}: full_brake\n", f"\n  {role}: {script}\n")
    path.write_text(path.read_text().replace("early_impacts: reject", "early_impacts: keep"))
    line = path.read_text().splitlines().index(f"  {role}: {script}") + 1
    arguments = ["scenario", "validate", path] if command == "validate" else [command, "--scenario", path]
    output = ["--output", tmp_path / "new"] if command in ("run", "train") else []
    refused(ethbrake(*arguments, *output), f"{path}, line {line}: roles.{role} = {script}: ", reason)
    assert not (tmp_path / "new").exists()


def test_scenario__a_script_with_a_state_is_in_order_when_early_impacts_are_kept(ethbrake, scenario_file):
    path = scenario_file("\n  vehicle_3: full_brake\n", "\n  vehicle_3: e_v2x_bm\n")
    path.write_text(path.read_text().replace("early_impacts: reject", "early_impacts: keep"))
    assert ethbrake("scenario", "validate", path).out.startswith("OK  mine: 3 vehicles, learners: vehicle_2;")


@pytest.mark.parametrize("script", ["planner:1000001", "planner:60001ms", "best_harm:1000001", "planner:1e9"])
def test_scenario__a_search_without_bounds_is_refused(ethbrake, scenario_file, script):
    path = scenario_file("\n  vehicle_3: full_brake\n", f"\n  vehicle_3: {script}\n")
    path.write_text(path.read_text().replace("early_impacts: reject", "early_impacts: keep"))
    refused(ethbrake("scenario", "validate", path), f"roles.vehicle_3 = {script}", "at most 1,000,000")


@pytest.mark.parametrize("script", ["planner", "planner:1000000", "planner:60000ms", "best_harm", "best_harm:1000000"])
def test_scenario__trying_a_search_has_a_budget(ethbrake, scenario_file, monkeypatch, script):
    budgets = []

    def watched(*args, budget, **kwargs):
        budgets.append(budget)
        return search_profiles(*args, budget=budget, **kwargs)

    monkeypatch.setattr("ethbrake_marl.agents.planner.search_profiles", watched)
    monkeypatch.setattr("ethbrake_marl.agents.planner.search_profiles", watched)
    path = scenario_file("\n  vehicle_3: full_brake\n", f"\n  vehicle_3: {script}\n")
    path.write_text(path.read_text().replace("early_impacts: reject", "early_impacts: keep"))
    assert ethbrake("scenario", "validate", path).status == 0
    assert budgets and max(budgets) <= 16 and len(budgets) <= 2


@pytest.mark.parametrize("command", ["run", "train", "evaluate"])
def test_long_command__a_defect_of_the_scenario_is_found_before_any_work(ethbrake, scenario_file, tmp_path, command):
    path = scenario_file("\nmass_t: ", "\nmass_kg: ")
    before = files(tmp_path)
    output = [] if command == "evaluate" else ["--output", tmp_path / "new"]
    refused(ethbrake(command, "--scenario", path, *output), str(path), "mass_kg")
    assert files(tmp_path) == before


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["--scenario", "paper-randm"], ["paper-randm", "did you mean 'paper-random'"]),
        (["--scenario", "nowhere/mine.yaml"], ["nowhere/mine.yaml"]),
        (["--agents", "full_brke"], ["full_brke", "did you mean 'full_brake'"]),
        (["--agents", "universl@shipped"], ["universl", "did you mean 'universal'"]),
        (["--agents", "constant"], ["constant", "m/s2"]),
        (["--agents", "constant:nan"], ["constant:nan"]),
        (["--agents", "constant:7.5"], ["constant:7.5", "7"]),
        (["--agents", "coast:1"], ["coast:1"]),
        (["--agents", "e_v2x_bm:coupld"], ["coupld", "coupled"]),
        (["--agents", "coast,coast"], ["coast", "twice"]),
        (["--agents", "coast,"], ["agent ''"]),
        (["--agents", "ppo"], ["'ppo'", "ppo@PATH"]),
        (["--agents", "ppo@runs/nothing-here"], ["runs/nothing-here"]),
        (["--agents", "ppo@runs/nothing-here+episode"], ["runs/nothing-here"]),
        (["--episodes", "0"], ["0"]),
        (["--episodes", "100000000000000"], ["100000000000000", "at most 10,000,000"]),
        (["--episodes", "many"], ["--episodes"]),
        (["--seed", "-1"], ["-1"]),
        (["--harm-count", "both"], ["--harm-count", "both", "first", "total"]),
        (["--vehicle", "vehicle_4"], ["vehicle_4", "vehicle_3"]),
        (["--initial-states", "nowhere.csv"], ["nowhere.csv"]),
        (["--agents", "ppo@" + 5000 * "a"], ["cannot be read", "File name too long"]),
        (["--per-world", "nowhere/out.csv"], ["nowhere"]),
        (["--per-world", "/proc/out.csv"], ["/proc/out.csv", "cannot be written"]),
        (["--per-world", 300 * "a" + ".csv"], ["cannot be written", "File name too long"]),
        (["--per-world", "x.txt"], ["x.txt", "must end in .csv or .parquet"]),
        (["--per-world", "/dev/null", "--force"], ["/dev/null", "must end in .csv or .parquet"]),
        (["--per-world", "same.csv", "--report", "same.csv"], ["same.csv"]),
        (["--per-world", "same.html", "--report", "same.html"], ["same.html", "must end in"]),
        (["--frobnicate"], ["--frobnicate"]),
    ],
)
def test_evaluate__a_bad_option_is_refused_in_one_line(ethbrake, arguments, fragments):
    refused(ethbrake("evaluate", "--episodes", "20", *arguments), *fragments)


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["--recipe", "pp"], ["recipe", "'pp'", "ppo"]),
        (["--recipe", "nowhere/ppo.yaml"], ["nowhere/ppo.yaml"]),
        (["--steps", "0"], ["total_steps", "0"]),
        (["--seed", "-1"], ["seed", "-1"]),
        (["--name", "a/b"], ["a/b"]),
        (["--name", ".."], [".."]),
        (["--name", 300 * "a"], ["up to 128"]),
        (["--output", "/proc/x"], ["/proc/x", "No such file"]),
    ],
)
@pytest.mark.parametrize("command", ["run", "train"])
def test_training_command__a_bad_option_leaves_no_folder(
    ethbrake, tmp_path, monkeypatch, command, arguments, fragments
):
    monkeypatch.chdir(tmp_path)
    refused(ethbrake(command, *arguments), *fragments)
    assert list(tmp_path.iterdir()) == []


def test_run__a_bad_list_leaves_no_folder(ethbrake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused(ethbrake("run", "--episodes", "0"), "0")
    refused(ethbrake("run", "--list-seed", "-1"), "-1")
    assert list(tmp_path.iterdir()) == []


def test_run__name_and_output_exclude_each_other(ethbrake, tmp_path):
    refused(ethbrake("run", "--name", "a", "--output", tmp_path / "b"), "'a'", "b")


def test_recipe__an_unknown_key_is_named_with_a_suggestion(ethbrake, tiny_recipe, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(tiny_recipe.read_text().replace("gamma:", "gama:"))
    refused(ethbrake("train", "--recipe", path, "--output", tmp_path / "new"), str(path), "gama", "gamma")


def test_scenario_with_two_learners__run_asks_who_is_driven(ethbrake, scenario_file, tmp_path):
    path = scenario_file("\n  vehicle_3: full_brake\n", "\n  vehicle_3: learner\n")
    answer = ethbrake("run", "--output", tmp_path / "new", "--scenario", path)
    refused(answer, "2 learners (vehicle_2, vehicle_3)", "--vehicle vehicle_2")
    assert not (tmp_path / "new").exists()


INITIAL_STATE_DEFECTS = [
    ("gap_1_m,gap_2_m,speed_1_mps,speed_2_mps\n7,7,20,18\n", ["speed_3_mps", "missing"]),
    ("gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_kmh\n7,7,20,18,20\n", ["speed_3_kmh", "speed_3_mps"]),
    ("gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps\n7,7,20,18,20\n7,-7,20,18,20\n", ["line 3", "gap_2_m", "-7"]),
    ("gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps\n7,7,20,nan,20\n", ["line 2", "speed_2_mps", "nan"]),
    ("gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps\n", ["no rows"]),
]


@pytest.mark.parametrize(("text", "fragments"), INITIAL_STATE_DEFECTS)
def test_initial_states__a_defect_is_named_by_line_and_column(ethbrake, tmp_path, text, fragments):
    path = tmp_path / "worlds.csv"
    path.write_text(text)
    answer = ethbrake("evaluate", "--initial-states", path, "--per-world", tmp_path / "out.csv")
    refused(answer, str(path), *fragments)
    assert not (tmp_path / "out.csv").exists()


def test_initial_states__an_endless_device_is_not_read_to_its_end(ethbrake):
    refused(ethbrake("evaluate", "--initial-states", "/dev/zero"), "/dev/zero", "not a plain file")


def test_initial_states__do_not_go_with_a_drawn_list(ethbrake, tmp_path):
    path = tmp_path / "worlds.csv"
    path.write_text("gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps\n7,7,20,18,20\n")
    refused(ethbrake("evaluate", "--initial-states", path, "--episodes", "5"), "worlds.csv", "episodes")
    refused(ethbrake("evaluate", "--initial-states", path, "--seed", "5"), "worlds.csv", "seed")


def test_policy__a_damaged_bundle_is_refused_by_file(ethbrake, finished_run, tmp_path):
    bundle = tmp_path / "policy"
    bundle.mkdir()
    for file in (finished_run / "policy").iterdir():
        (bundle / file.name).write_bytes(file.read_bytes())
    weights = bundle / "weights.safetensors"
    data = bytearray(weights.read_bytes())
    data[-1] ^= 1
    weights.write_bytes(data)
    for around in ("", "+episode", "+episode:pairwise"):
        answer = ethbrake("evaluate", "--episodes", "5", "--agents", f"ppo@{bundle}{around}")
        refused(answer, str(weights), "SHA-256")


@pytest.mark.parametrize("command", ["run", "train"])
def test_existing_run__is_refused_and_left_alone(ethbrake, tiny_recipe, finished_run, command):
    before = files(finished_run)
    refused(ethbrake(command, "--recipe", tiny_recipe, "--output", finished_run), str(finished_run), "force")
    assert files(finished_run) == before


def test_existing_folder__that_is_no_run_is_kept_even_with_force(ethbrake, tiny_recipe, tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    answer = ethbrake("train", "--recipe", tiny_recipe, "--output", tmp_path, "--force")
    refused(answer, str(tmp_path), "no run")
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


def test_agents__one_that_cannot_drive_is_refused_before_another_works(ethbrake, monkeypatch):
    monkeypatch.setattr("ethbrake_marl.evaluation.evaluate", lambda *args, **kwargs: pytest.fail("worked"))
    refused(ethbrake("evaluate", "--agents", "e_v2x_bm,constant:99", "--episodes", "5"), "constant:99", "7 m/s2")


def test_output__below_a_file_is_refused_in_one_line(ethbrake, tiny_recipe, tmp_path):
    (tmp_path / "worlds.csv").write_text("precious")
    answer = ethbrake("run", "--recipe", tiny_recipe, "--episodes", "5", "--output", tmp_path / "worlds.csv" / "x")
    refused(answer, "worlds.csv", "Not a directory")


def test_memory__that_is_not_there_is_said_in_one_line(ethbrake, monkeypatch):
    def short(*args: object, **kwargs: object) -> None:
        raise MemoryError("Unable to allocate 9 TiB")

    monkeypatch.setattr("ethbrake_marl.evaluation.inputs.choose_worlds", short)
    refused(ethbrake("evaluate"), "not enough memory (Unable to allocate 9 TiB)", "fewer worlds")


def test_per_world__an_existing_file_is_refused_before_the_work(ethbrake, tmp_path, monkeypatch):
    path = tmp_path / "out.csv"
    path.write_text("precious")
    monkeypatch.setattr("ethbrake_marl.evaluation.evaluate", lambda *args, **kwargs: pytest.fail("worked"))
    refused(ethbrake("evaluate", "--episodes", "5", "--per-world", path), str(path), "force")
    assert path.read_text() == "precious"


def test_scenario_new__overwrites_only_with_force(ethbrake, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("precious")
    refused(ethbrake("scenario", "new", "mine", "--output", tmp_path), str(path), "force")
    assert path.read_text() == "precious"
    assert ethbrake("scenario", "new", "mine", "--output", tmp_path, "--force").status == 0
    assert "name: mine" in path.read_text()


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        ([], ["Missing command", "ethbrake --help"]),
        (["evalute"], ["evalute", "evaluate"]),
        (["scenario"], ["Missing command", "ethbrake scenario --help"]),
        (["scenario", "show"], ["scenario", "ethbrake scenario show --help"]),
        (["scenario", "show", "paper-scenario-3"], ["paper-scenario-3", "did you mean"]),
        (["scenario", "new", "Not Good"], ["Not Good"]),
        (["scenario", "new", "mine", "--based-on", "paper-randm"], ["paper-randm", "did you mean"]),
        (["scenario", "new", "mine", "--output", "nowhere"], ["nowhere"]),
        (["scenario", "new", "mine", "--output", "/proc"], ["/proc/mine.yaml", "cannot be written"]),
        (["doctor", "please"], ["please"]),
    ],
)
def test_usage__a_mistake_is_answered_in_one_line(ethbrake, tmp_path, monkeypatch, arguments, fragments):
    monkeypatch.chdir(tmp_path)
    refused(ethbrake(*arguments), *fragments)
    assert list(tmp_path.iterdir()) == []


def test_defect_of_the_program__keeps_its_traceback(ethbrake, monkeypatch):
    def broken() -> None:
        raise RuntimeError("a defect")

    monkeypatch.setattr("ethbrake_marl.scenario.list_scenarios", broken)
    with pytest.raises(RuntimeError, match="a defect"):
        ethbrake("scenario", "list")
