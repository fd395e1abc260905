"""The frame of all commands: names, help, completion, streams, signals, exit statuses; and plug-ins in one file."""

import hashlib
import io
import json
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import nullcontext
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import typer
import yaml
from numba.core import event
from rich.console import Console

from ethbrake_marl import __version__
from ethbrake_marl.cli import app as frame
from ethbrake_marl.cli.app import app, run_command, whole_command
from ethbrake_marl.cli.command import Out
from ethbrake_marl.evaluation import EPISODES, LIST_SEED
from ethbrake_marl.files import plugins
from ethbrake_marl.learning.training import Training, load_recipe
from ethbrake_marl.physics.compiling import compiled
from ethbrake_marl.scenario import load_scenario, new_scenario_text
from ethbrake_marl.studies.trainings import TrainingJob, train_all
from tests.cli.conftest import TINY_RECIPE, Command, check_refused, told_json
from tests.fixtures.registered import restore, tables

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = [""]  # every one, groups too
for name, found in whole_command().commands.items():
    COMMANDS += [name, *(f"{name} {each}" for each in getattr(found, "commands", ()))]


@pytest.mark.parametrize("words", COMMANDS)
def test_help__has_examples_that_parse_and_a_short_name(
    ethbrake: Command, monkeypatch: pytest.MonkeyPatch, words: str
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    answer = ethbrake(*words.split(), "--help")
    assert (answer.status, answer.err) == (0, "") and "-h, --help" in answer.out
    assert not re.search(r"^  [a-z][a-z-]* .*\.\.\.$", answer.out, re.MULTILINE)  # no command's sentence is cut
    assert ethbrake(*words.split(), "-h").out == answer.out
    examples = [" ".join(each.split()) for each in re.findall(r"Example: ethbrake ((?:.|\n(?!\n))+)", answer.out)]
    assert len(examples) == (2 if "\nCommands:" in answer.out else 1)
    for example in examples:
        arguments = shlex.split(example.partition(" >")[0])
        assert " ".join(arguments).startswith(words)
        assert ethbrake(*arguments, "--help").status == 0


def test_command_line__is_small_enough_to_be_read() -> None:
    leaves = [each for each in _leaves(whole_command())]
    assert len(leaves) <= 24
    for command in leaves:
        options = {option for each in command.params for option in each.opts if option.startswith("--")}
        assert len(options - {"--plugin"}) <= 12, command.name


def _leaves(command: Any) -> Iterator[Any]:
    inside = getattr(command, "commands", None)
    yield from [command] if inside is None else (leaf for each in inside.values() for leaf in _leaves(each))


def test_help__says_the_list_that_the_package_has(ethbrake: Command) -> None:
    told = " ".join(ethbrake("evaluate", "--help").out.split())
    assert f"[default: ({EPISODES})]" in told and f"[default: ({LIST_SEED})]" in told
    assert all(
        f"[default: {each}]" in " ".join(ethbrake("run", "--help").out.split()) for each in (EPISODES, LIST_SEED)
    )
    assert f"[default: {LIST_SEED}]" in ethbrake("watch", "--help").out


@pytest.mark.parametrize(
    ("asked", "answered"),
    [
        (
            {"_ETHBRAKE_COMPLETE": "complete_bash", "COMP_WORDS": "ethbrake scenario val", "COMP_CWORD": "2"},
            "validate\n",
        ),
        ({"_ETHBRAKE_COMPLETE": "complete_zsh", "_TYPER_COMPLETE_ARGS": "ethbrake doctor --comp"}, '"--compile"'),
        ({"_ETHBRAKE_COMPLETE": "bash_source"}, None),  # no shell sets these: nothing changes
        ({"_ETHBRAKE_COMPLETE": "1"}, None),
        ({"_ETHBRAKE_COMPLETE": "complete_bash"}, None),
        ({"_ETHBRAKE_COMPLETE": "complete_bash", "COMP_WORDS": "ethbrake", "COMP_CWORD": "x"}, None),
        ({"_ETHBRAKE_COMPLETE": "complete_tcsh", "_TYPER_COMPLETE_ARGS": "ethbrake"}, None),
    ],
)
def test_completion__a_shell_that_asks_gets_what_can_follow(monkeypatch, capsys, asked, answered) -> None:
    for name, value in asked.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit) if answered else nullcontext() as ended:
        run_command(["--version"] if answered is None else [])
    assert ended is None or ended.value.code == 0
    assert (answered or f"ethbrake {__version__}\n") in capsys.readouterr().out


@pytest.mark.parametrize(
    ("loaded", "temporary", "told"),
    [
        ([], False, "compiling the physics, once: minutes of one core, then it is kept\n"),
        (["advance-1"], False, "compiling what was not used before, once, then it is kept\n"),
        ([], True, "no folder can be written"),
    ],
)
def test_first_compilation__is_told_once(tmp_path, monkeypatch, capsys, loaded, temporary, told) -> None:
    folder = tmp_path / ("ethbrake_marl-x" if temporary else "kept")
    folder.mkdir()
    monkeypatch.setattr("ethbrake_marl.kernel_store.cache_folder", lambda: folder)
    monkeypatch.setattr("ethbrake_marl.physics.compiling.cache_folder", lambda: folder)
    monkeypatch.setattr("ethbrake_marl.physics.compiling._loaded", loaded)
    monkeypatch.setattr("ethbrake_marl.kernel_store._tellers", [])
    monkeypatch.setitem(event._registered, "numba:compile", [])  # nobody listens any more after this test
    monkeypatch.setattr("warnings.showwarning", None)
    monkeypatch.setattr(frame, "EVERY_S", 0.001)
    frame.prepare_streams()

    @compiled
    def next_number(x: int) -> int:
        return x + 1

    assert (next_number(1), next_number(1.5)) == (2, 2.5)
    captured = capsys.readouterr()
    first, *more = captured.err.splitlines()
    assert captured.out == "" and told in f"{first}\n" and more  # each as long as it lasts
    assert all(re.fullmatch(r"still compiling: \d+ kernels are done, after \d+ s", line) for line in more)
    time.sleep(0.1)
    assert capsys.readouterr().err == ""  # nothing is compiled any more


def test_results__stand_alone_on_stdout_whatever_a_file_of_the_users_prints(ethbrake: Command, tmp_path: Path) -> None:
    (tmp_path / "noise.py").write_text('print("noise of a plug-in")\n')
    (tmp_path / "mine.py").write_text(
        "import numpy as np, ethbrake_marl as eb\n"
        "def act(seen):\n"
        '    print("noise of a policy")\n'
        "    return np.full((len(seen), 1), -1.0)\n"
        "def make(): return eb.policy_agent(act)\n"
    )
    files = ["--plugin", tmp_path / "noise.py", "--agents", f"full_brake,{tmp_path}/mine.py:make"]
    told = ethbrake("evaluate", *files, "--episodes", "3", "--json")
    assert len(told_json(told)) == 2
    assert "noise of a plug-in" in told.err and "noise of a policy" in told.err
    assert "noise" not in ethbrake("evaluate", *files, "--episodes", "3").out


def test_a_command_of_a_plug_in__prints_where_it_likes(ethbrake: Command, monkeypatch) -> None:
    monkeypatch.setattr(app, "registered_commands", [*app.registered_commands])
    app.command("my-words")(lambda: print("words"))
    assert ethbrake("my-words").out == "words\n"


def test_defect_of_the_program__keeps_its_traceback_and_missing_memory_is_one_line(ethbrake, monkeypatch) -> None:
    monkeypatch.setattr("ethbrake_marl.scenario.list_scenarios", Mock(side_effect=RuntimeError("a defect")))
    with pytest.raises(RuntimeError, match="a defect"):
        ethbrake("scenario", "list")
    short = Mock(side_effect=MemoryError("Unable to allocate 9 TiB"))
    monkeypatch.setattr("ethbrake_marl.evaluation.evaluate_held", short)
    check_refused(ethbrake("evaluate"), "not enough memory (Unable to allocate 9 TiB)", "fewer worlds")


def program(source: str, **environment: str) -> tuple[int, str, str]:
    """Exit status, stdout and stderr of Python source in a process of its own."""
    process = subprocess.run(
        [sys.executable, "-c", source],
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        encoding=environment.get("PYTHONIOENCODING", "utf-8"),
        check=False,
    )
    return process.returncode, process.stdout, process.stderr


def test_program__exit_status_and_streams_and_a_full_disk_behind_stdout() -> None:
    calling = (
        "import os, runpy, sys; sys.argv = ['ethbrake', {!r}];{} runpy.run_module('ethbrake_marl', run_name='__main__')"
    )
    assert program(calling.format("--version", "")) == (0, f"ethbrake {__version__}\n", "")
    status, out, err = program(calling.format("evalute", ""))
    assert (status, out, err.count("\n")) == (2, "", 1)
    full = program(calling.format("--version", " os.dup2(os.open('/dev/full', os.O_WRONLY), 1);"))
    assert full == (2, "", "ethbrake: error: output: No space left on device\n")


@pytest.mark.parametrize("encoding", [pytest.param("latin-1", marks=pytest.mark.slow), "ascii"])
def test_program__prints_a_table_on_a_narrow_stdout_and_needs_no_torch(encoding: str) -> None:
    status, out, err = program(
        "import sys; from ethbrake_marl.cli.app import main\n"
        "sys.argv[1:] = ['evaluate', '--episodes', '5', '--agents', 'coast']\n"
        "try:\n    main()\n"
        "except SystemExit as end:\n    assert not end.code\n"
        "print('loaded:', *{'torch', 'stable_baselines3', 'matplotlib'} & set(sys.modules))\n"
        "import ethbrake_marl.studies.reproduction\n"
        "print('with the items of the paper:', *{'torch'} & set(sys.modules))",
        PYTHONIOENCODING=encoding,
    )
    assert status == 0 and "coast" in out, err
    assert out.endswith("loaded:\nwith the items of the paper:\n"), out


def test_kernels__a_temporary_cache_is_told_and_removed_at_the_end(tmp_path: Path) -> None:
    _, out, _ = program(
        "from ethbrake_marl.kernel_store import cache_folder; print(cache_folder(), cache_folder().is_dir())\n"
        "from ethbrake_marl.cli.doctor import _kernel_cache; print(_kernel_cache()[1])",
        NUMBA_CACHE_DIR="/dev/null/x",
        TMPDIR=str(tmp_path),
    )
    where, told = out.splitlines()
    assert where.startswith(str(tmp_path / "ethbrake_marl-")) and where.endswith(" True") and "temporary" in told
    assert list(tmp_path.iterdir()) == []


def test_progress__without_a_terminal_is_lines_and_every_ten_seconds_the_time_that_is_left(capsys, monkeypatch) -> None:
    out = Out()
    out.progress("training", 0, 1000, "total harm 9.00")
    out.progress("training", 500, 1000, "total harm 8.00")
    out.progress("training", 1000, 1000, "total harm 8.00", note="stopped")
    times, out = iter((100.0, 105.0, 110.5, 111.0, 121.0, 140.0)), Out()
    monkeypatch.setattr("ethbrake_marl.cli.command.time.monotonic", lambda: next(times))
    for done in (0, 100, 210, 220, 420):
        out.progress("ppo", done, 1000)
    out.progress("report: figures", 1, 5)
    assert capsys.readouterr().err.splitlines() == [
        "training, total harm 9.00: 0 of 1,000",
        "stopped",
        "ppo: 0 of 1,000",
        "ppo: 210 of 1,000, about 40 s left",
        "ppo: 420 of 1,000, about 29 s left",
        "report: figures: 1 of 5",
    ]


def test_progress__on_a_terminal_each_part_has_one_bar_above_what_comes_next(monkeypatch, capsys) -> None:
    screen, out = io.StringIO(), Out()
    monkeypatch.setattr(out, "_stderr", Console(file=screen, force_terminal=True, width=100))
    for part, done, total, more in (
        ("training", 10, 1000, {}),
        ("training", 1024, 1000, {}),  # a training ends after the update in which its steps are reached
        ("ppo", 5, 10, {"note": "said once"}),
        ("report: figures", 1, 5, {}),
        ("report: the page", 2, 5, {}),
    ):
        out.progress(part, done, total, **more)
    bars = out._bars
    assert bars is not None
    tasks = [(task.description, task.completed, task.total) for task in bars.tasks]
    assert tasks == [("training", 1000, 1000), ("ppo", 5, 10), ("report: the page", 2, 5)]
    out.note("written")
    assert screen.getvalue().count("said once") == 1 and not bars.live.is_started and out._bars is None
    assert capsys.readouterr().err.endswith("written\n")


def test_command__ctrl_c_is_one_line_and_the_status_of_an_interruption(capsys) -> None:
    with pytest.raises(typer.Exit) as raised, Out(kept="what was found is kept"):
        raise KeyboardInterrupt
    assert raised.value.exit_code == 130
    assert capsys.readouterr().err == "interrupted; what was found is kept\n"


# ---------------------------------------------------------------- plug-ins


PLUGIN = '''
import numpy as np
import ethbrake_marl as eb


def calm(step):
    """Minus the square of the own command in force."""
    return -(step.command_mps2**2)


def time_gap(worlds, vehicle):
    """Time to where the vehicle ahead is now, 1 m/s at the least."""
    return worlds.gaps_m[:, vehicle - 1] / np.maximum(worlds.speeds_mps[:, vehicle], 1.0)


def make_gentle(argument: str, settings):
    share = float(argument or 0.5)
    return eb.policy_agent(lambda seen: np.full((len(seen), 1), -share), name="gentle", scenario=settings.scenario)


eb.register_term("calm", calm, unit="m2/s4")
eb.register_feature("time_gap_s", time_gap, unit="s", scale=1.0, low=0.0, high=10.0)
eb.register_preset("hilly", {"preset": "nominal", "lost": 0.3})
eb.register_agent("gentle", make_gentle, about="brakes with a constant share")
assert make_gentle.__annotations__ == {"argument": str}  # a plug-in means what Python says it means
'''


@pytest.fixture
def again():
    """Call it to go on as in a new process."""
    before = tables()
    return lambda: restore(before)


@pytest.fixture
def parts(tmp_path: Path) -> Path:
    path = tmp_path / "my_parts.py"
    path.write_text(PLUGIN)
    return path


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    """A scenario with the plug-in's preset."""
    path = tmp_path / "hills.yaml"
    content = yaml.safe_load(new_scenario_text("hills"))
    path.write_text(yaml.safe_dump(content | {"v2x": "hilly", "early_impacts": "keep"}))
    return path


def write_recipe(folder: Path, **changes: object) -> Path:
    path = folder / "calm.yaml"
    path.write_text(yaml.safe_dump({**TINY_RECIPE, "name": "calm", "reward": {"harm": 1.0, "calm": 0.01}, **changes}))
    return path


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    """A recipe with the plug-in's term and feature."""
    return write_recipe(tmp_path, observation=["own", "front_1", "rear_1", "time_gap_s"])


@pytest.mark.filterwarnings(
    "ignore::ethbrake_marl.evaluation.measures.IncompleteTable"
)  # a list that shares worlds with a table
@pytest.mark.usefixtures("undrawn")
def test_one_file__adds_agent_term_feature_and_preset_and_is_seen_in_the_report(
    ethbrake, tmp_path, parts, scenario, recipe, again
):
    assert len(PLUGIN.strip().splitlines()) <= 40
    run = tmp_path / "run"
    named = ("--plugin", parts)
    made = ethbrake("run", *named, "--scenario", scenario, "--recipe", recipe, "--episodes", "20", "--output", run)
    assert made.status == 0, made.err
    config = json.loads((run / "config.json").read_text())
    sha256 = hashlib.sha256(parts.read_bytes()).hexdigest()
    assert config["plugins"] == [{"name": "my_parts.py", "source": str(parts), "sha256": sha256}]
    assert config["recipe"]["reward"]["terms"] == {"calm": 0.01} and config["scenario"]["v2x"] == {"preset": "hilly"}
    page = (run / "report.html").read_text()
    assert f"my_parts.py (SHA-256 {sha256})" in page and "calm" in page
    again()
    driven = ethbrake(
        "evaluate", *named, "--scenario", scenario, "--episodes", "20", "--agents", f"gentle,gentle:0.2+step,ppo@{run}"
    )
    assert driven.status == 0 and "gentle:0.2+step" in driven.out


def test_agents_from_a_file__drive_on_the_command_line_behind_a_shield(ethbrake, parts):
    spec = f"{parts}:make_gentle:0.3"
    answer = ethbrake("evaluate", "--episodes", "10", "--agents", f"{spec},{spec}+step", "--json")
    assert [row["agent"] for row in json.loads(answer.out)] == [spec, f"{spec}+step"]
    assert ethbrake("shield", "--episodes", "10", "--agents", spec).status == 0


@pytest.fixture
def stopped(ethbrake, tmp_path, parts, again):
    """A training with the plug-in, stopped before its end, and a new process."""
    folder = tmp_path / "stopped"
    recipe = write_recipe(tmp_path, checkpoint_every_updates=1)
    assert ethbrake("train", "--plugin", parts, "--recipe", recipe, "--output", folder).status == 0
    status = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(status | {"status": "interrupted"}))
    again()
    return folder


def test_resume__needs_the_same_plugins_and_says_how_to_go_on(ethbrake, tmp_path, parts, stopped, again):
    def refuse(told: str, *files: Path) -> None:
        answer = ethbrake("train", "--resume", stopped, *(word for file in files for word in ("--plugin", file)))
        again()
        check_refused(answer, told)

    other, config = tmp_path / "other.py", (stopped / "config.json").read_text()
    other.touch()
    all_the_same = "or go on all the same with --other-versions"
    refuse(f"needs the plug-in my_parts.py, which is not loaded; name it: --plugin {parts}")
    refuse(f"was made without the plug-in {other}; leave it out, {all_the_same}", parts, other)
    parts.write_text(PLUGIN + "# changed\n")
    refuse("the plug-in my_parts.py was another file then (SHA-256 ", parts)
    refuse(f"put it back as it was, {all_the_same}", parts)
    assert ethbrake("train", "--resume", stopped, "--plugin", parts, "--other-versions").status == 0
    again()
    parts.write_text(PLUGIN)
    moved = parts.rename(tmp_path / "moved.py")  # the content counts, not the place
    (stopped / "config.json").write_text(json.dumps(json.loads(config) | {"plugins": [{"name": 3}]}))
    refuse("plugins must be a list of name, source and sha256", moved)
    (stopped / "config.json").write_text(config)
    refuse("this training has finished", moved)


def test_option__stands_on_every_command_and_before_it(ethbrake, parts):
    waiting = [whole_command()]
    for each in waiting:
        waiting += getattr(each, "commands", {}).values()
        assert [option.name for option in each.params].count("plugin") == 1, each.name
    answer = ethbrake("--plugin", parts, "agent", "list")
    assert answer.status == 0 and "gentle[:ARGUMENT]" in answer.out


def test_installed_plugin__is_loaded_only_when_it_is_named(ethbrake, tmp_path, monkeypatch):
    (tmp_path / "installed_parts.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(tmp_path)
    point = EntryPoint("hills", "installed_parts", plugins.GROUP)
    monkeypatch.setattr(plugins, "entry_points", lambda group: [point] if group == plugins.GROUP else [])
    assert "gentle[" not in ethbrake("agent", "list").out and "installed_parts" not in sys.modules
    assert "gentle[" in ethbrake("agent", "list", "--plugin", "hills").out
    (noted,) = plugins.noted_plugins()
    assert noted["name"] == "hills" and noted["sha256"] == hashlib.sha256(PLUGIN.encode()).hexdigest()
    assert "unknown plug-in 'hill'; did you mean 'hills'?" in ethbrake("agent", "list", "--plugin", "hill").err
    del sys.modules["installed_parts"]


@pytest.mark.slow
def test_worker_processes__load_the_plugins_of_their_parent(tmp_path, parts, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.getcwd())
    plugins.load_plugin(parts)
    recipe = load_recipe(str(write_recipe(tmp_path)))
    scenario = load_scenario("paper-random")
    wanted = [TrainingJob(Training.of(recipe, scenario, seed=seed), tmp_path / f"seed{seed}") for seed in (0, 1)]
    assert train_all(wanted, 2)
    for training in wanted:
        config = json.loads((training.folder / "config.json").read_text())
        assert [each["name"] for each in config["plugins"]] == ["my_parts.py"]


@pytest.mark.parametrize(("content", "told"), [(b"x = 1\n\0\n", "null bytes"), (b"def f(:\n", "line 1: SyntaxError")])
def test_plugin__that_is_no_python_names_no_line_that_is_not_there(ethbrake, tmp_path, content: bytes, told: str):
    (tmp_path / "bad.py").write_bytes(content)
    answer = ethbrake("agent", "list", "--plugin", tmp_path / "bad.py")
    check_refused(answer, f"plug-in '{tmp_path / 'bad.py'}'", told)
    assert "None" not in answer.err


def test_command__of_the_users_cannot_take_the_place_of_a_built_in_one(ethbrake, monkeypatch):
    monkeypatch.setattr(app, "registered_commands", [*app.registered_commands])

    @app.command()
    def evaluate() -> None:
        """Another one."""

    answer = ethbrake("evaluate", "--episodes", "3")
    check_refused(answer, "command 'evaluate' is there already; give yours another name: app.command('my-evaluate')")
