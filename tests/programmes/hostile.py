"""Hostile files: what somebody could try who sends a scenario, a recipe, a table, a policy or a run.

Each file is read in its own process and folder. It must be refused (with ``may_be_valid``: may succeed) with one line
of error without control characters, whose message has at most 1,500 characters, within 10 s of processor time and 2 GiB
of memory. An audit hook of Python reports code that is executed, and prevents changes of files elsewhere.
"""

import io
import json
import os
import pickle
import resource
import shutil
import signal
import struct
import sys
import tempfile
import threading
import traceback
import zipfile
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import LINE_LIMIT, EthBrakeError
from ethbrake_marl.extensions.search.best_harm import best_harm
from ethbrake_marl.extensions.search.tables import BestHarmTable
from ethbrake_marl.policies.bundle import shipped_policies
from ethbrake_marl.training.recipe import shipped_recipes
from tests.programmes import Cases, Given, Told

CPU_LIMIT_S, WALL_LIMIT_S = 10, 90.0
MEMORY_LIMIT_BYTES = 2 << 30  # in addition to the memory of the loaded libraries
LONGEST_LINE = len("ethbrake: error: ") + LINE_LIMIT  # characters
REFUSED, BROKEN = 2, 99  # exit status of an error, and of a traceback
DEED = "DEED: "
OUTSIDE, PRECIOUS = "outside", "precious.txt"  # beside a run: what nothing may touch
# What may stand in a run as a link out of it -> where it leads, and whether the run must be refused then.
LINKS = {
    "checkpoints": ("", True),
    "tensorboard": ("", True),
    "run.lock": (PRECIOUS, True),
    "progress.csv": (PRECIOUS, False),
    "config.json": (PRECIOUS, True),
    "policy": ("", False),
    "tensorboard/events.out.tfevents.1.x": (PRECIOUS, False),
}

Command = tuple[str, ...] | Callable[[], object]
Build = Callable[[Path], object]


class Case(NamedTuple):
    """One attempt: ``build`` fills a folder, in which ``command`` runs (a command line, or a function that reads)."""

    name: str
    command: Command
    build: Build
    may_be_valid: bool = False


# ---------------------------------------------------------------- YAML and CSV

SCENARIO = """name: mine
title: A line of three
description: What a stranger sends.
vehicles: 3
time_step_s: 0.1
horizon_s: 8
gaps_m: {uniform: [5, 10]}
speeds_mps: {uniform: [18, 22]}
braking_capacity_mps2: [6, 7, 6]
driving_capacity_mps2: [6, 7, 6]
mass_t: [4.5, 5.5, 5.9]
latency_s: [0, 0.5, 0.8]
speed_limit_mps: 40
restitution: 0.1
early_impacts: keep
roles:
  vehicle_1: full_brake
  vehicle_2: learner
  vehicle_3: full_brake
"""
RECIPE = shipped_recipes()["ppo"].read_text("utf-8").replace("name: ppo", "name: mine")
STATES = "gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps\n" + 3 * "7,7,20,18,20\n"
PYTHON = "from pathlib import Path\nPath('pwned').touch()\ndef make(**given): pass\n"
TITLE = "title: A line of three"
ROLE = "vehicle_3: full_brake"
BILLION = "a: &a [x, x]\n" + "".join(f"b{k}: &b{k} [*{f'b{k - 1}' if k else 'a'}, *a]\n" for k in range(40))
# Name of a case -> the old text, and the text that replaces it. An empty old text stands for the beginning of the file.
SCENARIOS: dict[str, tuple[str, str]] = {
    "a tag that calls a function": (TITLE, "title: !!python/object/apply:os.system ['touch pwned']"),
    "a tag that names a module": (TITLE, "title: !!python/module:os"),
    "a tag of its own": (TITLE, "title: !local thing"),
    "a billion laughs": ("", BILLION),
    "a merge key": (TITLE, "<<: {title: x}"),
    "a second document": (ROLE, f"{ROLE}\n---\n{SCENARIO}"),
    "a key twice": (TITLE, f"{TITLE}\n{TITLE}"),
    "deep brackets": (TITLE, f"title: {'[' * 30_000}"),
    "deep indents": ("", "".join(f"{' ' * k}k:\n" for k in range(300))),
    "many keys": ("", "".join(f"k{k}: 1\n" for k in range(4_000))),
    "a long key": (TITLE, f'? "{"b" * 60_000}"\n: 1'),
    "an escape sequence in a key": (TITLE, '"\\e[2Jtitle": x'),
    "an escape sequence in a name": ("name: mine", 'name: "\\e]0;x\\a"'),
    "a text from right to left": ("name: mine", 'name: "\\u202egnp.exe"'),
    "NUL": (TITLE, "title: a\0b"),
    "too large": ("", f"# {'x' * (10 << 20)}\n"),
    "not a number": ("restitution: 0.1", "restitution: .nan"),
    "infinite": ("speed_limit_mps: 40", "speed_limit_mps: 1e999"),
    "a number of 40,000 digits": ("horizon_s: 8", f"horizon_s: {'9' * 40_000}"),
    "a billion vehicles": ("vehicles: 3", "vehicles: 1000000000"),
    "a role that is a Python file": (ROLE, "vehicle_3: mine.py:make"),
    "a role that is code": (ROLE, "vehicle_3: __import__('os').system('touch pwned')"),
    "a role with a device as its policy": (ROLE, "vehicle_3: ppo@/dev/zero"),
    "a role that computes for ever": (ROLE, "vehicle_3: best_harm:99999999999"),
    "a step that is too short": ("time_step_s: 0.1", "time_step_s: 1e-300"),
}
RECIPES: dict[str, tuple[str, str]] = {
    "an algorithm in a Python file": ("\nalgorithm: ppo", "\nalgorithm: mine.py:make"),
    "an algorithm of Python's own": ("\nalgorithm: ppo", "\nalgorithm: os.system"),
    "a reward in a Python file": ("\nreward:", "\nreward: {'mine.py:make': 1}\nother:"),
    "more worlds than memory": ("\nn_envs: ", "\nn_envs: 99999999"),
    "a tag": ("\nalgorithm: ppo", "\nalgorithm: !!python/name:os.system"),
}
LISTS: dict[str, bytes] = {
    "a formula": STATES.replace("7,7", "=cmd|'/c calc'!A1,7").encode(),
    "an escape sequence in a column": STATES.replace("gap_1_m", "\x1b[2J").encode(),
    "100,000 columns": b",".join([b"gap_1_m"] * 100_000) + b"\n1\n",
    "a field of two million digits": STATES.replace("7,7", f"{'9' * 2_000_000},7").encode(),
    "not text": STATES.encode() + b"\xed\xa0\x80",
    "too large": b"7" * ((64 << 20) + 1),
}


def put(name: str, content: bytes | str, folder: Path) -> None:
    (folder / "mine.py").write_text(PYTHON, "utf-8")
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def texts() -> Iterator[Case]:
    read = partial(eb.load_recipe, "mine.yaml")
    kinds: tuple[tuple[str, str, Command, dict[str, tuple[str, str]]], ...] = (
        ("scenario", SCENARIO, ("scenario", "validate", "mine.yaml"), SCENARIOS),
        ("recipe", RECIPE, read, RECIPES),
    )
    for kind, text, command, changes in kinds:
        for name, (old, new) in changes.items():
            assert old in text, old
            yield Case(f"{kind}: {name}", command, partial(put, "mine.yaml", text.replace(old, new, 1)))
    for name, raw in (("UTF-16", SCENARIO.encode("utf-16")), ("not text", SCENARIO.encode() + b"\xff")):
        yield Case(f"scenario: {name}", kinds[0][2], partial(put, "mine.yaml", raw))
    for name, raw in LISTS.items():
        yield Case(f"table of states: {name}", read_states, partial(put, "mine.csv", raw))


def read_states() -> object:
    return eb.read_worlds(eb.load_scenario("paper-random"), Path("mine.csv"))


# ---------------------------------------------------------------- archives of arrays


class Touch:
    """Pickle that creates a file when it is loaded."""

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("pwned"),)


@cache
def good_table() -> bytes:
    """Return a valid table of best known harm, of three worlds."""
    scenario, game = eb.open_game("paper-random")
    return best_harm(game, scenario.sample(3, 7), budget=1, threads=1).content()


def tables() -> dict[str, bytes]:
    """Return tables of best known harm, as attackers might write them."""
    good = good_table()
    with np.load(io.BytesIO(good)) as arrays:
        members = {f"{name}.npy": npy(array) for name, array in arrays.items()}
    shape = members["identity.npy"].replace(b"(3,)", b"(1<<40,)")
    return {
        "pickled objects": packed({**members, "identity.npy": npy(np.array([Touch()] * 3, object))}),
        "code in a header": packed({**members, "identity.npy": members["identity.npy"].replace(b"'<u8'", b"exit()")}),
        "a shape that is code": packed({**members, "identity.npy": shape}),
        "a bomb": packed({**members, "identity.npy": npy(np.zeros(1 << 27, np.uint64))}),
        "a path outside": packed({**members, "../pwned.npy": members["identity.npy"]}),
        "3,000 members": packed({**members, **{f"a{k}.npy": b"" for k in range(3_000)}}),
        "sizes that lie": good.replace(b"PK\x01\x02", b"PK\x01\x02" + bytes(4), 1),
        "a pickle": pickle.dumps(Touch()),
        "cut off": good[: len(good) // 2],
    }


def archives() -> Iterator[Case]:
    for name, content in tables().items():
        yield Case(f"archive: {name}", partial(BestHarmTable.load, Path("t.npz")), partial(put, "t.npz", content))


def npy(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asanyarray(array), allow_pickle=True)
    return buffer.getvalue()


def packed(members: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


# ---------------------------------------------------------------- policies, runs, places and command lines

EVALUATE = ("evaluate", "--episodes", "2", "--agents", "ppo@policy")
MANIFEST, WEIGHTS = "manifest.json", "weights.safetensors"


def policies() -> Iterator[Case]:
    def with_policy(change: Callable[[Path], object], folder: Path) -> None:
        shutil.copytree(shipped_policies()["ppo"] / "policy", folder / "policy", copy_function=shutil.copyfile)
        change(folder / "policy")

    def edited(name: str, change: Callable[[bytes], bytes], policy: Path) -> None:
        (policy / name).write_bytes(change((policy / name).read_bytes()))

    attacks: dict[str, Callable[[Path], object]] = {
        "another number in the manifest": partial(
            edited, MANIFEST, lambda data: data.replace(b'"steps": ', b'"steps": 9')
        ),
        "a manifest that is deep": partial(edited, MANIFEST, lambda data: b"[" * 99_999),
        "other weights": partial(edited, WEIGHTS, lambda data: data[:-1] + b"\x99"),
        "a pickle as weights": partial(edited, WEIGHTS, lambda data: pickle.dumps(Touch())),
        "a header of 2^63 bytes": partial(edited, WEIGHTS, lambda data: struct.pack("<Q", 2**63) + data[8:]),
        "a file of code more": lambda policy: (policy / "policy.py").write_text(PYTHON),
        "weights that are a link": lambda policy: (policy / WEIGHTS).symlink_to(
            (policy / WEIGHTS).rename(policy.parent / WEIGHTS)
        ),
    }
    for name, change in attacks.items():
        yield Case(f"policy: {name}", EVALUATE, partial(with_policy, change))


def runs(stopped: Path) -> Iterator[Case]:
    """Yield an interrupted training that was changed before it is resumed."""

    def with_run(change: Callable[[Path], object], folder: Path) -> None:
        change(Path(shutil.copytree(stopped, folder / "run")))

    def pickled(run: Path) -> None:
        for file in run.glob("checkpoints/*/*"):
            file.write_bytes(pickle.dumps(Touch()))

    attacks: dict[str, tuple[Callable[[Path], object], bool]] = {
        **{f"{name} is a link outside": (partial(link_out, name), not sure) for name, (_, sure) in LINKS.items()},
        "checkpoints that are pickles": (pickled, True),
        "settings that are deep": (lambda run: (run / "config.json").write_text("[" * 99_999), False),
        "a status that lists files outside": (list_outside, True),
    }
    for name, (change, may_be_valid) in attacks.items():
        yield Case(f"run: {name}", ("train", "--resume", "run"), partial(with_run, change), may_be_valid)


def link_out(name: str, run: Path) -> None:
    """Put a link out of the run in the place of something in it."""
    path = run / name
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    path.symlink_to(run.parents[1] / OUTSIDE / LINKS[name][0])


def list_outside(run: Path) -> None:
    status = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps({**status, "written": [f"../../{OUTSIDE}/{PRECIOUS}", "..", 7]}))


def stopped_run(folder: Path) -> Path:
    """Train, interrupt the training after its second evaluation, and return its folder."""
    seen = []

    def measure(policy: object) -> dict[str, float]:
        seen.append(policy)
        if len(seen) == 3:
            signal.raise_signal(signal.SIGINT)
        return {"first_impact_harm": 1.0, "total_harm": 1.0}

    small = {"policy": [4], "value": [4]}
    evaluation = {"every_updates": 2, "worlds": 2, "seed": 7}
    recipe = eb.load_recipe("ppo").replace(
        n_envs=4, batch_size=16, n_steps=8, n_epochs=1, total_steps=256, checkpoint_every_updates=2, network=small,
        evaluation=evaluation,
    )  # fmt: skip
    eb.train(recipe, "paper-random", folder / "run", measure=lambda training: measure)
    assert json.loads((folder / "run" / "run.json").read_text())["status"] == "interrupted"
    return folder / "run"


PLACES: dict[str, Callable[[Path], object]] = {
    "a pipe": os.mkfifo,
    "a folder": Path.mkdir,
    "a link to itself": lambda path: path.symlink_to(path.name),
    "a link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "ten gigabytes of nothing": lambda path: (path.touch(), os.truncate(path, 10 << 30)),
}
LINES: dict[str, tuple[str, ...]] = {
    "an agent with an escape sequence": ("evaluate", "--agents", "\x1b[2J"),
    "a setting that is code": ("evaluate", "--episodes", "3", "--set", "mass_t=__import__('os').system('touch pwned')"),
    "an output that is a link outside": ("scenario", "new", "mine", "--output", "link"),
}


def places_and_lines() -> Iterator[Case]:
    for name, place in PLACES.items():
        yield Case(
            f"scenario: {name}", ("scenario", "show", "mine.yaml"), lambda f, place=place: place(f / "mine.yaml")
        )
    for name, words in LINES.items():
        yield Case(f"command: {name}", words, lambda f: (f / "link").symlink_to(f"../{OUTSIDE}/{PRECIOUS}"))


# ---------------------------------------------------------------- the cage


def cases(given: Given) -> Cases:
    with tempfile.TemporaryDirectory(prefix="hostile-", ignore_cleanup_errors=True) as folder:
        tempfile.tempdir = folder
        os.chdir(folder)
        warm_up(Path(folder))
        for k, case in enumerate(
            (*texts(), *archives(), *policies(), *places_and_lines(), *runs(stopped_run(Path(folder))))
        ):
            yield case.name, partial(judge, case, Path(folder) / f"case-{k}")


def warm_up(folder: Path) -> None:
    """Read valid files: late modules are imported and kernels compiled, so that a case is charged for its own work."""
    put("mine.yaml", SCENARIO, folder)
    put("mine.csv", STATES, folder)
    with redirect_stdout(io.StringIO()):
        for words in (("scenario", "validate", "mine.yaml"), ("evaluate", "--episodes", "2", "--agents", "ppo")):
            assert run_command(words) == 0, words
    read_states()
    eb.parallel_env().reset(seed=0)
    put("mine.yaml", RECIPE, folder)
    eb.load_recipe("mine.yaml")


def judge(case: Case, folder: Path) -> Told:
    """Build the case in the new ``folder``, run it in a child process, and check the rules."""
    inside, told = folder / "inside", folder.with_suffix(".told")
    (folder / OUTSIDE).mkdir(parents=True)
    (folder / OUTSIDE / PRECIOUS).write_text("years of work")
    inside.mkdir()
    case.build(inside)
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        status = BROKEN
        try:
            status = caged(case, inside, told)
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(status)
    timer = threading.Timer(WALL_LIMIT_S, os.kill, (child, signal.SIGKILL))
    timer.start()
    _, ended, _ = os.wait4(child, 0)
    timer.cancel()
    faults = [*broken_rules(case, os.waitstatus_to_exitcode(ended), told.read_text("utf-8", "backslashreplace"))]
    faults += ["code was executed"] if (inside / "pwned").exists() or (folder / "pwned").exists() else []
    kept = [path.name for path in (folder / OUTSIDE).iterdir()]
    if kept != [PRECIOUS] or (folder / OUTSIDE / PRECIOUS).read_text() != "years of work":
        faults.append(f"changed outside: {kept}")
    shutil.rmtree(folder)
    return Told(not faults, "; ".join(faults))


def caged(case: Case, inside: Path, told: Path) -> int:
    """In the child: set limits and hooks, read the file, and return the exit status."""
    for stream in (1, 2):
        os.dup2(os.open(told, os.O_CREAT | os.O_WRONLY | os.O_APPEND), stream)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.chdir(inside)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    for what, most in ((resource.RLIMIT_AS, size + MEMORY_LIMIT_BYTES), (resource.RLIMIT_CPU, CPU_LIMIT_S)):
        resource.setrlimit(what, (most, most))
    sys.addaudithook(partial(watch, os.path.realpath(inside) + os.sep))
    if isinstance(case.command, tuple):
        return run_command(case.command)
    try:
        case.command()
    except EthBrakeError as error:
        print(f"ethbrake: error: {error}", file=sys.stderr)
        return REFUSED
    return 0


EXECUTING = (
    "os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "pickle.find_class", "socket.connect",
)  # fmt: skip
CHANGING = {  # event -> which of its arguments is the changed path, and which the open folder that it is relative to
    "os.mkdir": (0, 2), "os.remove": (0, 1), "os.rmdir": (0, 1), "os.truncate": (0, 0), "os.rename": (1, 3),
    "os.symlink": (1, 2), "os.link": (1, 3), "shutil.rmtree": (0, 1),
}  # fmt: skip
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


def watch(own: str, event: str, arguments: tuple[Any, ...]) -> None:
    """Report what is executed; refuse and report changes of files outside the folder ``own``."""
    if event in EXECUTING:
        os.write(2, f"{DEED}executed {event} {arguments!r:.60}\n".encode())
    writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & WRITING
    if not writes and event not in CHANGING:
        return
    path, folder = CHANGING.get(event, (0, 0))
    if isinstance(arguments[path], int):
        return
    name, base = os.fsdecode(arguments[path]), arguments[folder]
    if folder and isinstance(base, int) and base >= 0:
        name = os.path.join(os.readlink(f"/proc/self/fd/{base}"), name)
    place = os.path.realpath(name if writes and not arguments[2] & os.O_NOFOLLOW else os.path.dirname(name) or ".")
    if place != os.devnull and not f"{place}{os.sep}".startswith(own):
        os.write(2, f"{DEED}{event} {place}\n".encode())
        raise PermissionError("outside the case's folder", place)


def broken_rules(case: Case, status: int, told: str) -> Iterator[str]:
    lines = told.split("\n")
    errors = [line for line in lines if line.startswith("ethbrake: error: ")]
    if status != REFUSED and (status != 0 or not case.may_be_valid):
        yield f"exit status {status}: {lines[-2:]}"[:300]
    if status == REFUSED and len(errors) != 1:
        yield f"not one line of error: {told!r:.300}"
    if status == REFUSED and "not enough memory" in told:
        yield "the file was unpacked before it was refused"
    yield from (line for line in lines if line.startswith(DEED))
    if any(len(line) > LONGEST_LINE or not line.isprintable() for line in (errors if status == 0 else lines)):
        yield "a line is too long, or has control characters"
