"""What command lines refuse: one line on stderr, nothing on stdout, exit status 2, and no file touched."""

import shlex
from collections.abc import Callable
from pathlib import Path

import pytest

from ethbrake_marl.scenario.catalogue import new_scenario_text
from tests.cli.test_printed import STORIES
from tests.fixtures.commands import Command, check_refused

Refuse = Callable[..., None]


@pytest.fixture
def refuse(ethbrake: Command, empty_folder: Path) -> Refuse:
    """Runs a command line in an empty folder, and checks how it is refused."""

    def run(line: str, *fragments: str) -> None:
        before = {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}
        check_refused(ethbrake(*shlex.split(line)), *fragments)
        assert {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()} == before

    return run


USAGE = [
    ("", "Missing command. (see: ethbrake --help)"),
    ("evalute", "No such command 'evalute'. Did you mean 'evaluate'? (see: ethbrake --help)"),
    ("scenario show", "Missing argument 'NAME|PATH'. (see: ethbrake scenario show --help)"),
    (
        "evaluate --frobnicate",
        "No such option: --frobnicate (Possible options: --force) (see: ethbrake evaluate --help)",
    ),
    (
        "evaluate --episodes many",
        "Invalid value for '--episodes': must be a whole number (see: ethbrake evaluate --help)",
    ),
    (
        "evaluate --jobs 0",
        "Invalid value for '--jobs': must be greater than or equal to 1 (see: ethbrake evaluate --help)",
    ),
    (
        "evaluate --per-world txt --output new",
        "Invalid value for '--per-world': 'txt' is not one of 'csv', 'parquet'. (see",
    ),
    ("study falsify --agent coast --budget 0", "Invalid value for '--budget': must be greater than or equal to 1 (see"),
]


@pytest.mark.parametrize(("line", "message"), USAGE, ids=lambda value: value[:60])
def test_usage__is_refused_with_where_help_is(line: str, message: str, refuse: Refuse) -> None:
    refuse(line, message)


SCENARIOS = [
    ("scenario show paper-scenario-3", "unknown scenario 'paper-scenario-3'; did you mean 'paper-scenario-2'?"),
    (
        "scenario new 'Not Good'",
        "scenario name 'Not Good': must be 1 to 64 lower case letters, digits, - and _, beginning",
    ),
    ("scenario new mine --based-on paper-randm", "unknown scenario 'paper-randm'; did you mean 'paper-random'?"),
    ("scenario new mine --output nowhere", "nowhere/mine.yaml: there is no folder nowhere; make it first"),
    ("scenario new mine --output /proc", "/proc/mine.yaml: cannot be written (No such file or directory)"),
    ("scenario sample paper-random --episodes 0", "number of worlds = 0: must be a whole number, at least 1"),
    ("scenario sample paper-random --output x.txt", "x.txt: worlds must end in .csv or .png or .svg or .pdf"),
    ("evaluate --scenario nowhere/mine.yaml", "nowhere/mine.yaml: no such file"),
]


@pytest.mark.parametrize(("line", "message"), SCENARIOS, ids=lambda value: value[:60])
def test_scenario_command__is_refused(line: str, message: str, refuse: Refuse) -> None:
    refuse(line, message)


EVALUATIONS = [
    ("evaluate --set harm_count=both", "harm_count 'both': must be 'first' or 'total'"),
    ("evaluate --episodes 0", "number of worlds = 0: must be a whole number, at least 1"),
    ("evaluate --episodes 100000000000000", "episodes = 100000000000000: must be a whole number in 1..1000000000000"),
    ("evaluate --seed -1", "seed of the list = -1: must be a whole number, at least 0"),
    ("evaluate --set recipe.gamma=1", "--set recipe.gamma: this command takes no recipe, so nothing of one can be set"),
    ("evaluate --agents full_brke", "unknown agent 'full_brke'; did you mean 'full_brake'?"),
    ("evaluate --agents ladder,coast", "agent 'coast' is given twice; each agent drives every world once"),
    (
        "evaluate --agents coast,",
        "agent '': must be name or name:argument, the name in lower case letters, digits and _ @ . -",
    ),
    ("evaluate --agents constant:7.5", "agent 'constant:7.5': above the braking capacity 7 m/s2"),
    ("evaluate --agents ppo", "agent 'ppo': a policy is needed: ppo@PATH, where PATH is a run or a policy bundle"),
    (
        "evaluate --agents ppo@runs/nothing-here",
        "runs/nothing-here: is not a folder; give a policy bundle (manifest.json, weights.safetensors)",
    ),
    (
        "evaluate --scenario cooperation-0-sensors --agents team@shipped",
        "scenario 'cooperation-0-sensors' has no learner to drive; give the scenario",
    ),
    ("evaluate --agents team@.", ".: holds no team (team.json); give the folder of a run, or a bundle as ppo@."),
    (
        "evaluate --scenario cooperation-3-pair --agents ppo@shipped+episode",
        "shipped policy ppo for scenario 'cooperation-3-pair': there is none; shipped are",
    ),
    ("evaluate --agents ppo@shipped+robust", "agent 'ppo@shipped+robust': mode robust needs an uncertainty"),
    ("evaluate --output /proc/out", "/proc/out: cannot be written to (No such file or directory)"),
    ("evaluate --per-world csv", "--per-world: needs a folder for it: --output FOLDER"),
    ("evaluate --report", "--report: needs a folder for it: --output FOLDER"),
]


@pytest.mark.parametrize(("line", "message"), EVALUATIONS, ids=lambda value: value[:60])
def test_evaluation__is_refused(line: str, message: str, refuse: Refuse) -> None:
    refuse(line, message)


TRAININGS = [
    ("run --recipe pp", "unknown recipe 'pp'; did you mean 'ppo'?"),
    ("run --list-seed -1", "seed of the list = -1: must be a whole number, at least 0"),
    ("train --recipe nowhere/ppo.yaml", "nowhere/ppo.yaml: no such file"),
    ("train --steps 0", "recipe 'ppo': total_steps = 0: must be greater than or equal to 1"),
    ("train --output /proc/x", "/proc/x: No such file or directory"),
    (
        "train --scenario cooperation-3-pair --set scheme=single --output no",
        "scheme single: scenario 'cooperation-3-pair' has 2 learners; use shared, independent or centralised",
    ),
    (
        "train --scenario cooperation-3-pair --set scheme=centralized --output no",
        "recipe 'ppo': scheme = centralized: must be single, shared, independent or centralised",
    ),
    ("train --resume .", ".: holds no training; give the folder of a run"),
    ("agent export shipped/ppo --onnx none/policy.onnx", "none/policy.onnx: there is no folder none; make it first"),
    (
        "shield --agents ppo@shipped+episode",
        "agent 'ppo@shipped+episode': has a shield already; this command puts its own around each agent",
    ),
    ("watch --agents nobody --output x.txt", "a film that ends in '.txt': films are written as .gif, .mp4, .svg"),
]


@pytest.mark.parametrize(("line", "message"), TRAININGS, ids=lambda value: value[:60])
def test_run_training_export_shield_or_film__is_refused(line: str, message: str, refuse: Refuse) -> None:
    refuse(line, message)


STUDIES = [
    (
        "study falsify --agent coast --budget 10 --output worst.txt",
        "worst.txt: a file of worlds must end in .yaml or .yml",
    ),
    (
        "study falsify --agent coast --budget 10 --measure bound",
        "agent 'coast': tells no bound; --measure bound is for an agent behind a shield",
    ),
    (
        "study falsify --agent coast --budget 10 --measure difference",
        "--measure difference: compares two agents; say which is the other one, --against AGENT",
    ),
    (
        "study falsify --agent coast --against coast --budget 10",
        "agent 'coast' is given twice; each agent drives every world once",
    ),
    (
        "study falsify --agent full_brake --measure harm --against coast --budget 10",
        "--against coast: --measure harm compares with nobody; use regret or difference",
    ),
    ("study falsify --agent coast --budget 10 --measure hram", "unknown measure 'hram'; did you mean 'harm'?"),
    (
        "study falsify --agent ppo@nowhere --budget 10",
        "nowhere: is not a folder; give a policy bundle (manifest.json, weights.safetensors) or a run",
    ),
    (
        "study falsify --agent coast --budget 10 --scenario mixture-delays",
        "scenario 'mixture-delays': is a mixture; take one of its scenarios: paper-delay-low",
    ),
    (
        "study falsify --agent coast --budget 10 --scenario cooperation-2-blocked",
        "scenario 'cooperation-2-blocked': v2x: draws delays and losses, which no table of worlds holds",
    ),
    (
        "study falsify --agent coast --budget 10 --scenario paper-scenario-1",
        "scenario 'paper-scenario-1': draws nothing: all its worlds are the same",
    ),
    (
        "study falsify --agent ladder --measure harm --budget 8",
        "agent ladder: stands for several agents; one is needed here",
    ),
    ("reproduce harm-delay", "unknown item 'harm-delay'; did you mean 'harm-delays'?"),
    ("reproduce gaps gaps", "item 'gaps' is given twice"),
    ("reproduce --quick --full", "--quick and --full: give one of the two"),
    (
        "reproduce gaps --episodes 1",
        "Invalid value for '--episodes': must be greater than or equal to 2 (see: ethbrake reproduce --help)",
    ),
    ("reproduce gaps --docs nowhere/page.md", "nowhere/page.md: there is no folder nowhere; make it first"),
    ("reproduce gaps --docs page.html", "page.html: must end in .md"),
    (
        "study ablate --output new --levels cooperation-3-par,cooperation-2-paper",
        "unknown scenario 'cooperation-3-par'; did you mean 'cooperation-3-pair'?",
    ),
    (
        "study ablate --output new --levels cooperation-3-pair,cooperation-3-pair",
        "levels: 'cooperation-3-pair' is given twice",
    ),
    ("study ablate --output new --levels cooperation-3-pair", "levels: 1 given; at least two are needed to compare"),
    (
        "study ablate --output new --levels cooperation-0-sensors,paper-distance",
        "level 'paper-distance': its speeds_mps differs from that of 'cooperation-0-sensors' (20, 18, 20",
    ),
    (
        "study ablate --output new --levels cooperation-3-pair,cooperation-3-five",
        "level 'cooperation-3-five': its vehicles differs from that of 'cooperation-3-pair' (5; there 3)",
    ),
    (
        "study ablate --output new --episodes 10 --search-episodes 11",
        "search-episodes 11: must be at most the 10 worlds of --episodes",
    ),
    (
        "study ablate --output new --set scheme=shard",
        "recipe 'cooperation': scheme = shard: must be single, shared, independent or centralised",
    ),
    (
        "study ablate --output new --shield robust",
        "shield 'robust': must be step; episode and robust shield one vehicle",
    ),
    ("study ablate --output new --recipes ppo,ppo", "recipes ppo, ppo: give at least one, each with a name of its own"),
    ("study sweep nowhere.yaml --output new", "nowhere.yaml: no such file"),
]


@pytest.mark.parametrize(("line", "message"), STUDIES, ids=lambda value: value[:60])
def test_study_or_reproduction__is_refused(line: str, message: str, refuse: Refuse) -> None:
    refuse(line, message)


def write_scenario(old: str, new: str) -> None:
    """The template of a scenario with one piece of text replaced; early impacts are kept."""
    text = new_scenario_text("mine").replace("early_impacts: reject", "early_impacts: keep")
    assert text.count(old) == 1
    Path("mine.yaml").write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("\nmass_t: ", "\nmass_kg: ", "mine.yaml, line 67: mass_kg: unknown key; did you mean mass_t (tonnes)?"),
        (
            "\nrestitution: 0.1",
            "\nrestitution: .nan",
            "mine.yaml, line 76: restitution = .nan: must be a finite number",
        ),
        ("vehicle_3: full_brake\n", "vehicle_3: ful_brake\n", "unknown agent 'ful_brake'; did you mean 'full_brake'?"),
        ("\nname: mine", "\nname: mine\nname: mine", "line 14, column 1: key 'name' is given twice, first on line 13"),
        ("vehicle_3: full_brake\n", "vehicle_3: coast:4\n", "agent 'coast:4': coast takes no argument"),
        (
            "vehicle_1: full_brake\n",
            "vehicle_1: planner:0\n",
            "the argument must be a number of candidates per decision",
        ),
        (
            "vehicle_3: full_brake\n",
            "vehicle_3: best_harm:1000001\n",
            "must be a number of candidates, for instance 20000",
        ),
    ],
)
def test_validate__names_the_line_of_the_mistake(old: str, new: str, message: str, refuse: Refuse) -> None:
    write_scenario(old, new)
    refuse("scenario validate mine.yaml", message)


@pytest.mark.parametrize("command", ["run --output new", "train --output new", "evaluate"])
def test_role_that_cannot_drive__is_refused_before_anything_is_written(command: str, refuse: Refuse) -> None:
    write_scenario("vehicle_1: full_brake\n", "vehicle_1: planner:0\n")
    refuse(f"{command} --scenario mine.yaml", "mine.yaml, line 80: roles.vehicle_1 = planner:0: agent 'planner:0'")


def test_run__drives_one_vehicle(refuse: Refuse) -> None:
    write_scenario("vehicle_3: full_brake\n", "vehicle_3: learner\n")
    refuse("run --output new --scenario mine.yaml", "has 2 learners (vehicle_2, vehicle_3); give the others a script")


@pytest.mark.parametrize(
    ("file", "line"),
    [
        ("mine.yaml", "scenario new mine"),
        ("worlds.csv", "scenario sample paper-random --output worlds.csv"),
        ("out/worlds.csv", "evaluate --episodes 10000000 --output out"),
        ("policy.onnx", "agent export shipped/ppo --onnx policy.onnx"),
        ("film.gif", "watch --agents full_brake --output film.gif"),
        ("worst.yaml", "study falsify --agent coast --budget 100000 --output worst.yaml"),
    ],
)
def test_file_that_is_there__is_not_replaced_unasked(file: str, line: str, refuse: Refuse) -> None:
    Path(file).parent.mkdir(exist_ok=True)
    Path(file).write_text("precious")
    refuse(line, f"{file}: is there already; give another name or use force (--force)")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("evaluate --output file/x", "is no folder; give a folder of its own (--output)"),
        ("run --output file/x", "file: Not a directory"),
        ("study ablate --output file/new", "is no folder; give a folder of its own (--output)"),
        ("train --output . --force", ".: is there already, and is no run; give another name"),
    ],
)
def test_output__is_a_folder_of_its_own(line: str, message: str, refuse: Refuse) -> None:
    Path("file").write_text("precious")
    refuse(line, message)


def test_path_of_a_policy__that_is_too_long_is_refused(refuse: Refuse) -> None:
    refuse(f"evaluate --agents ppo@{'a' * 5000}", "cannot be read (File name too long)")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "scenario: paper-random",
            "scenario: paper-distance",
            "its worlds were found in scenario 'paper-distance', which",
        ),
        ("harm_count: first", "harm_count: second", "worst.yaml, line 8: harm_count = second: must be first or total"),
        ("    score: 120", "    skore: 120", "worst.yaml, line 12: worlds[0].skore: unknown key; did you mean score?"),
        ("name: regret-2", "name: regret-1", "worst.yaml: world 'regret-1' is given twice; names must differ"),
        ("{gap_1_m: 9.9251", "{gap_3_m: 9.9251", "worlds[1].state has other columns than worlds[0]; all need the same"),
        ("version: 1", "version: 2", "worst.yaml, line 2: version = 2: must be less than or equal to 1"),
    ],
)
def test_worlds_that_were_found__are_refused_where_the_file_was_changed(
    old: str, new: str, message: str, refuse: Refuse
) -> None:
    (story,) = (file.read_text("utf-8") for file in STORIES if file.stem == "searches")
    text = story.partition("$ cat worst.yaml\n")[2].partition("\n\n$ ")[0]
    assert text.count(old) == 1
    Path("worst.yaml").write_text(text.replace(old, new) + "\n")
    refuse("study falsify --again worst.yaml", message)


SWEEP = "grid: {scenario: paper-random, recipe: %s}"
TUNING = "scenario: paper-random\nrecipe: ppo\nsearch: {%s: {low: 1, high: 4}}\n"


@pytest.mark.parametrize(
    ("plan", "line", "message"),
    [
        (
            SWEEP % "pppo",
            "sweep",
            "plan.yaml, line 1: grid (paper-random, pppo, seed 0): unknown recipe 'pppo'; did you mean",
        ),
        (SWEEP % "ppo", "sweep --jobs 0", "Invalid value for '--jobs': must be greater than or equal to 1"),
        (SWEEP % "ppo", "sweep --retries -1", "Invalid value for '--retries': must be greater than or equal to 0"),
        (TUNING % "n_epoch", "tune", "plan.yaml, line 3: unknown setting 'n_epoch'; did you mean 'n_epochs'?"),
        (TUNING % "n_epochs", "tune --trials 0", "Invalid value for '--trials': must be greater than or equal to 1"),
        (TUNING % "n_epochs", "tune --export best.txt", "export best.txt: must end in .yaml, as recipes do"),
        (TUNING % "n_epochs", "tune --export 'Best One.yaml'", "recipe name 'Best One': must be 1 to 64 lower case"),
        (TUNING % "n_epochs", "tune --export plan.yaml", "plan.yaml: is there already; give another name or use force"),
    ],
    ids=lambda value: value[:30],
)
def test_plan_of_a_study__is_refused(plan: str, line: str, message: str, refuse: Refuse) -> None:
    Path("plan.yaml").write_text(plan)
    command, *options = line.split(" ", 1)
    refuse(" ".join(["study", command, "plan.yaml", "--output", "new", *options]), message)


@pytest.mark.parametrize(
    ("code", "line", "message"),
    [
        ("x = 1\nraise KeyError('secret')\n", "--agents bad.py:make", "file 'bad.py', line 2: KeyError: 'secret'"),
        ("import sys\n\nsys.exit(3)\n", "--set measures=bad.py:worst", "file 'bad.py', line 3: SystemExit: 3"),
        (
            "import ethbrake_marl as eb\neb.register_agent('planner', print)\n",
            "--agents bad.py:make",
            "file 'bad.py', line 2: agent 'planner' is registered already; give another name",
        ),
        (
            "import ethbrake_marl as eb\neb.make_agent('bad.py:make')\n",
            "--agents bad.py:make",
            "file 'bad.py', line 2: file 'bad.py': loads itself",
        ),
        ("worst = 3\n", "--set measures=bad.py:worst", "measure 'worst': needs a function with a docstring"),
        (
            "worst = 3\n",
            "--agents bad.py:worst",
            "file 'bad.py': 'worst' is no function; name the one that makes the agent",
        ),
        ("", "--set measures=injur", "unknown measure 'injur'; did you mean 'injury'?"),
        (
            "import ethbrake_marl as eb\ndef slow(): return eb.policy_agent(lambda seen: exit(0))\n",
            "--agents bad.py:slow --episodes 3",
            "code of yours ended the process: SystemExit: 0",
        ),
    ],
    ids=["fails", "exits", "takes a name", "loads itself", "no function", "no maker", "unknown measure", "exits later"],
)
def test_file_of_the_user__is_refused_with_its_line(code: str, line: str, message: str, refuse: Refuse) -> None:
    Path("bad.py").write_text(code)
    refuse(f"evaluate {line}", message)
