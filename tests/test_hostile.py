"""Hostile files: what a stranger's scenario, recipe or list could execute or cost.

Each file is read in its own process. It must be refused with one line of error, within 10 s of processor time and 2 GiB
of memory, and nothing is executed. Refusal tests read other hostile files: policies, checkpoints, links, devices.
"""

import os
import resource
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

import ethbrake_marl as eb
from ethbrake_marl.errors import LINE_LIMIT, EthBrakeError
from ethbrake_marl.training.recipe import shipped_recipes

CPU_LIMIT_S = 10
MEMORY_LIMIT_BYTES = 2 << 30  # in addition to the memory of the loaded libraries
REFUSED, BROKEN = 2, 99  # exit status of an error, and of a traceback
EXECUTING = ("os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "pickle.find_class")
KINDS: dict[str, tuple[str, str, Callable[[], object]]] = {  # kind -> name and text of a sound file, and what reads it
    "scenario": (
        "paper-random.yaml",
        (Path(__file__).resolve().parents[1] / "scenarios" / "paper" / "paper-random.yaml").read_text("utf-8"),
        lambda: eb.open_game("paper-random.yaml")[0].sample(2, seed=7),
    ),
    "recipe": ("ppo.yaml", shipped_recipes()["ppo"].read_text("utf-8"), lambda: eb.load_recipe("ppo.yaml")),
    "list": (
        "mine.csv",
        "gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps\n" + 3 * "7,7,20,18,20\n",
        lambda: eb.read_worlds(eb.load_scenario("paper-random"), Path("mine.csv")),
    ),
}
ROLE = "vehicle_3: full_brake}"
FILES: dict[str, list[tuple[str, str]]] = {  # kind -> replacements; an empty old text is the beginning of the file
    "scenario": [
        ("title: Random", "title: !!python/object/apply:os.system ['touch pwned']\nsource: Random"),
        ("", "a: &a [x, x]\n" + "".join(f"b{k}: &b{k} [*{f'b{k - 1}' if k else 'a'}, *a]\n" for k in range(40))),
        ("title: Random", f"title: {'[' * 30_000}"),
        ("", "".join(f"{' ' * k}k:\n" for k in range(300))),
        ("", "".join(f"k{k}: 1\n" for k in range(4_000))),
        ("title: Random", f'? "{"b" * 60_000}"\n: 1'),
        ("horizon_s: 8", f"horizon_s: {'9' * 40_000}"),
        ("vehicles: 3", "vehicles: 1000000000"),
        ("time_step_s: 0.1", "time_step_s: 1e-300"),
        (ROLE, "vehicle_3: 'mine.py:make'}"),
        (ROLE, """vehicle_3: "__import__('os').system('touch pwned')"}"""),
        (ROLE, "vehicle_3: 'ppo@/dev/zero'}"),
    ],
    "recipe": [
        ("\nalgorithm: ppo", "\nalgorithm: 'mine.py:make'"),
        ("\nalgorithm: ppo", "\nalgorithm: os.system"),
        ("\nreward: {", "\nreward: {'mine.py:make': 1, "),
        ("\nn_envs: ", "\nn_envs: 99999999"),
    ],
    "list": [
        ("", ",".join(["gap_1_m"] * 100_000) + "\n1\n"),
        ("7,7", f"{'9' * 2_000_000},7"),
        ("", "7" * ((64 << 20) + 1)),
    ],
}  # fmt: skip
CASES = [(kind, *change) for kind, changes in FILES.items() for change in changes]


class Ended(NamedTuple):
    status: int
    told: str  # in one line each


def caged(folder: Path, read: Callable[[], object]) -> Ended:
    """How a child process ends that calls ``read`` in a folder, with limits, telling what it executes."""
    told = folder / "told"
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        status = BROKEN
        try:
            os.dup2(os.open(told, os.O_CREAT | os.O_WRONLY | os.O_APPEND), 2)
            os.chdir(folder)
            size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            spent = int(sum(resource.getrusage(resource.RUSAGE_SELF)[:2]))
            for what, most in (
                (resource.RLIMIT_AS, size + MEMORY_LIMIT_BYTES),
                (resource.RLIMIT_CPU, spent + CPU_LIMIT_S),
            ):
                resource.setrlimit(what, (most, most))
            sys.addaudithook(tell_executed)
            read()
            status = 0
        except EthBrakeError as error:
            os.write(2, f"{error}\n".encode())
            status = REFUSED
        except BaseException:
            os.write(2, traceback.format_exc().encode())
        finally:
            os._exit(status)
    _, ended = os.waitpid(child, 0)
    lines = told.read_text("utf-8", "backslashreplace")
    return Ended(os.waitstatus_to_exitcode(ended), lines + "pwned" * (folder / "pwned").exists())


def tell_executed(event: str, arguments: tuple[Any, ...]) -> None:
    if event in EXECUTING:
        os.write(2, f"executed {event} {arguments!r:.60}\n".encode())


@pytest.fixture(scope="module", autouse=True)
def _warm(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Read sound files: late modules are imported and kernels compiled, so that a case is charged for its own work."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("sound"))
        for name, text, read in KINDS.values():
            Path(name).write_text(text, "utf-8")
            read()


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "old", "new"), CASES, ids=lambda text: ascii(text)[1:30])
def test_hostile_file__is_refused_at_little_cost_and_executes_nothing(kind: str, old: str, new: str, tmp_path: Path):
    name, text, read = KINDS[kind]
    assert old in text
    (tmp_path / "mine.py").write_text("from pathlib import Path\nPath('pwned').touch()\ndef make(**given): pass\n")
    (tmp_path / name).write_text(text.replace(old, new, 1), "utf-8")
    ended = caged(tmp_path, read)
    assert ended.status == REFUSED and ended.told.count("\n") == 1 and len(ended.told) < LINE_LIMIT + 2, ended
    assert not ended.told.startswith("executed") and "not enough memory" not in ended.told


@pytest.mark.parametrize(
    ("read", "status", "told"),
    [
        (lambda: os.system("true"), 0, "executed os.system"),
        (lambda: Path("pwned").touch(), 0, "pwned"),
        (lambda: bytes(2 * MEMORY_LIMIT_BYTES), BROKEN, "MemoryError"),
    ],
)
def test_cage__tells_what_breaks_a_rule(read: Callable[[], object], status: int, told: str, tmp_path: Path) -> None:
    ended = caged(tmp_path, read)
    assert ended.status == status and told in ended.told
