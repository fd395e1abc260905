"""Every bad input: exit status 2, one line that says where, what and what would be right, and nothing written."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from ethbrake_marl.search import ProfileProblem


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

    search = ProfileProblem.search

    def watched(*args, budget, **kwargs):
        budgets.append(budget)
        return search(*args, budget=budget, **kwargs)

    monkeypatch.setattr(ProfileProblem, "search", watched)
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


WRONG = [
    ("evaluate --episodes 20 --scenario paper-randm", "paper-randm", "did you mean 'paper-random'"),
    ("evaluate --episodes 20 --scenario nowhere/mine.yaml", "nowhere/mine.yaml"),
    ("evaluate --episodes 20 --agents full_brke", "full_brke", "did you mean 'full_brake'"),
    ("evaluate --episodes 20 --agents universl@shipped", "universl", "did you mean 'universal'"),
    ("evaluate --episodes 20 --agents constant", "constant", "m/s2"),
    ("evaluate --episodes 20 --agents constant:nan", "constant:nan"),
    ("evaluate --episodes 20 --agents constant:7.5", "constant:7.5", "7"),
    ("evaluate --episodes 20 --agents coast:1", "coast:1"),
    ("evaluate --episodes 20 --agents e_v2x_bm:coupld", "coupld", "coupled"),
    ("evaluate --episodes 20 --agents coast,coast", "coast", "twice"),
    ("evaluate --episodes 20 --agents coast,", "agent ''"),
    ("evaluate --episodes 20 --agents ppo", "'ppo'", "ppo@PATH"),
    ("evaluate --episodes 20 --agents ppo@runs/nothing-here", "runs/nothing-here"),
    ("evaluate --episodes 20 --agents ppo@runs/nothing-here+episode", "runs/nothing-here"),
    ("evaluate --episodes 20 --episodes 0", "0"),
    ("evaluate --episodes 20 --episodes 100000000000000", "100000000000000", "at most 10,000,000"),
    ("evaluate --episodes 20 --episodes many", "--episodes"),
    ("evaluate --episodes 20 --seed -1", "-1"),
    ("evaluate --episodes 20 --harm-count both", "--harm-count", "both", "first", "total"),
    ("evaluate --episodes 20 --vehicle vehicle_4", "vehicle_4", "vehicle_3"),
    ("evaluate --episodes 20 --initial-states nowhere.csv", "nowhere.csv"),
    (f"evaluate --episodes 20 --agents {'ppo@' + 5000 * 'a'}", "cannot be read", "File name too long"),
    ("evaluate --episodes 20 --per-world nowhere/out.csv", "nowhere"),
    ("evaluate --episodes 20 --per-world /proc/out.csv", "/proc/out.csv", "cannot be written"),
    (f"evaluate --episodes 20 --per-world {300 * 'a' + '.csv'}", "cannot be written", "File name too long"),
    ("evaluate --episodes 20 --per-world x.txt", "x.txt", "must end in .csv or .parquet"),
    ("evaluate --episodes 20 --per-world /dev/null --force", "/dev/null", "must end in .csv or .parquet"),
    ("evaluate --episodes 20 --per-world same.csv --report same.csv", "same.csv"),
    ("evaluate --episodes 20 --per-world same.html --report same.html", "same.html", "must end in"),
    ("evaluate --episodes 20 --frobnicate", "--frobnicate"),
    ("run --recipe pp", "recipe", "'pp'", "ppo"),
    ("run --recipe nowhere/ppo.yaml", "nowhere/ppo.yaml"),
    ("run --steps 0", "total_steps", "0"),
    ("run --seed -1", "seed", "-1"),
    ("run --name a/b", "a/b"),
    ("run --name ..", ".."),
    (f"run --name {300 * 'a'}", "up to 128"),
    ("run --output /proc/x", "/proc/x", "No such file"),
    ("train --recipe pp", "recipe", "'pp'", "ppo"),
    ("train --recipe nowhere/ppo.yaml", "nowhere/ppo.yaml"),
    ("train --steps 0", "total_steps", "0"),
    ("train --seed -1", "seed", "-1"),
    ("train --name a/b", "a/b"),
    ("train --name ..", ".."),
    (f"train --name {300 * 'a'}", "up to 128"),
    ("train --output /proc/x", "/proc/x", "No such file"),
    ("run --episodes 0", "0"),
    ("run --list-seed -1", "-1"),
    ("run --name a --output b", "'a'", "b"),
    ("", "Missing command", "ethbrake --help"),
    ("scenario", "Missing command", "ethbrake scenario --help"),
    ("scenario show", "scenario", "ethbrake scenario show --help"),
    ("scenario show paper-scenario-3", "paper-scenario-3", "did you mean"),
    ("scenario new 'Not Good'", "Not Good"),
    ("scenario new mine --based-on paper-randm", "paper-randm", "did you mean"),
    ("scenario new mine --output nowhere", "nowhere"),
    ("scenario new mine --output /proc", "/proc/mine.yaml", "cannot be written"),
    ("evaluate --jobs 2", "--jobs: is for an evaluation in parts"),
    ("evaluate --ray local", "--ray: is for an evaluation in parts"),
    ("evaluate --output kept", "--output: is for an evaluation in parts"),
    ("evaluate --rows", "--rows: is for an evaluation in parts"),
    ("evaluate --shards 2 --rows", "--rows: needs a folder"),
    ("evaluate --shards 2 --per-world x.csv", "--output FOLDER --rows"),
    ("evaluate --shards 2 --report x.html", "--report: needs every world at once"),
    ("evaluate --shards 2 --by scenario", "--by: needs every world at once"),
    ("evaluate --shards 0", "shards = 0: must be a whole number, at least 1"),
    ("evaluate --shards 2 --jobs 0", "jobs = 0: must be a whole number in 1..256"),
    ("evaluate --shards 2 --episodes 0", "episodes = 0: must be a whole number"),
    ("search falsify --agent coast --budget 10 --output worst.txt", "must end in .yaml"),
    ("search falsify --agent coast --budget 10 --measure bound", "tells no bound"),
    ("search falsify --agent coast --budget 10 --measure difference", "say which is the other one"),
    ("search falsify --agent coast --budget 10 --measure hram", "hram"),
    ("search falsify --agent coast --budget 10 --agent ppo@nowhere", "nowhere"),
    ("search falsify --agent coast --budget 10 --scenario mixture-delays", "is a mixture"),
    ("search falsify --agent coast --budget 10 --budget 0", "budget"),
    ("search falsify --agent ladder --measure harm --budget 8", "stands for several agents"),
    ("reproduce harm-delay", "did you mean 'harm-delays'?"),
    ("reproduce '<script>'", "unknown item '<script>'"),
    ("reproduce ../gaps", "unknown item"),
    ("reproduce gaps gaps", "given twice"),
    ("reproduce --quick --full", "give one of the two"),
    ("reproduce gaps --episodes 1", "episodes = 1: must be a whole number in 2..10000"),
    ("reproduce gaps --docs nowhere/page.md", "there is no folder nowhere"),
    ("reproduce gaps --docs page.html", "must end in .md"),
    (
        "evaluate --episodes 5 --agents ppo@shipped+robust",
        "agent 'ppo@shipped+robust': mode robust needs an uncertainty",
    ),
    ("evaluate --episodes 5 --agents coast --uncertainty gaps_m=1", "nobody uses it"),
    ("evaluate --episodes 5 --agents ppo@shipped+robust --uncertainty gap=1", "unknown uncertain quantity"),
    ("evaluate --episodes 5 --agents ppo@shipped+robust --uncertainty mass_t=9", "it must stay above 0"),
    (
        "evaluate --episodes 5 --agents ppo@shipped+robust --uncertainty latency_s=1000",
        "uncertainty: latency_s=1000: vehicle_2 may decide first at 1000.5 s; must be before the horizon, 8 s",
    ),
    (
        "watch picture criticality --output map.jpg",
        "pictures are written as PNG, SVG or PDF; end the name in .png, .svg or .pdf",
    ),
    (
        "watch picture deceleration --output map.jpg",
        "pictures are written as PNG, SVG or PDF; end the name in .png, .svg or .pdf",
    ),
    (
        "watch picture shield --output map.jpg",
        "pictures are written as PNG, SVG or PDF; end the name in .png, .svg or .pdf",
    ),
    (
        "watch picture shield-modes --output map.jpg",
        "pictures are written as PNG, SVG or PDF; end the name in .png, .svg or .pdf",
    ),
    (
        "watch picture robustness --output map.jpg",
        "pictures are written as PNG, SVG or PDF; end the name in .png, .svg or .pdf",
    ),
    ("watch picture shield --output map", "end the name in .png, .svg or .pdf"),
    ("watch picture shield --output map.png.eps", "end the name in .png, .svg or .pdf"),
    ("watch picture criticality --scenario paper-random --output map.png", "speed_1_mps is random"),
    ("benchmark v22 --agent coast", "unknown suite 'v22'; did you mean 'v2'?"),
    ("benchmark v2 --agent coost", "can drive no list of it: unknown agent 'coost'"),
    ("benchmark v2 --agent coast --output x.yaml", "an entry must end in .json"),
    ("benchmark table none.json", "none.json: no such file"),
    ("benchmark table none.json --output x.pdf", "the table must end in .md"),
    ("benchmark table", "Missing argument"),
    (
        "evaluate --set recipe.gamma=1 --episodes 3",
        "--set recipe.gamma: this command takes no recipe, so nothing of one can be set",
    ),
    (
        "evaluate --scenario realistic-mixed --agents coast --episodes 5 --by vehicle_9_type",
        "unknown group 'vehicle_9_type'; did you mean 'vehicle_",
    ),
    ("evaluate --agents coast --episodes 5 --by scenario", "by 'scenario': these worlds have no groups"),
    ("shield --agents ful_brake --episodes 3", "did you mean 'full_brake'"),
    ("shield --agents ppo@shipped+episode --episodes 3", "agent 'ppo@shipped+episode': has a shield already"),
    ("shield --agents full_brake+step --episodes 3", "agent 'full_brake+step': has a shield already"),
    ("shield --agents ppo@shipped+refined+step --episodes 3", "agent 'ppo@shipped+refined+step': has a shield already"),
    (
        "watch picture shield --output x.png --agents ppo@shipped+episode --episodes 3",
        "agent 'ppo@shipped+episode': has a shield already",
    ),
    (
        "watch picture shield --output x.png --agents full_brake+step --episodes 3",
        "agent 'full_brake+step': has a shield already",
    ),
    (
        "watch picture shield --output x.png --agents ppo@shipped+refined+step --episodes 3",
        "agent 'ppo@shipped+refined+step': has a shield already",
    ),
    (
        "watch picture robustness --output x.png --agent ppo@shipped+episode --episodes 3",
        "agent 'ppo@shipped+episode': has a shield already",
    ),
    (
        "watch picture robustness --output x.png --agent full_brake+step --episodes 3",
        "agent 'full_brake+step': has a shield already",
    ),
    (
        "watch picture robustness --output x.png --agent ppo@shipped+refined+step --episodes 3",
        "agent 'ppo@shipped+refined+step': has a shield already",
    ),
]


@pytest.mark.parametrize("call", WRONG, ids=lambda call: call[0][:60])
def test_wrong_call__is_one_line_that_says_what_would_be_right_and_writes_nothing(
    ethbrake, tmp_path, monkeypatch, call
):
    monkeypatch.chdir(tmp_path)
    line, *fragments = call
    refused(ethbrake(*shlex.split(line)), *fragments)
    assert list(tmp_path.iterdir()) == []


def test_defect_of_the_program__keeps_its_traceback(ethbrake, monkeypatch):
    def broken() -> None:
        raise RuntimeError("a defect")

    monkeypatch.setattr("ethbrake_marl.scenario.list_scenarios", broken)
    with pytest.raises(RuntimeError, match="a defect"):
        ethbrake("scenario", "list")
