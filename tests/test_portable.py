"""What Windows and macOS lack or do otherwise, as far as Linux can imitate it."""

import io
import os
import py_compile
import shutil
import subprocess
import sys
import zipfile
from contextlib import redirect_stdout
from importlib.util import cache_from_source
from pathlib import Path

import pytest

import ethbrake_marl as eb
from ethbrake_marl import kernel_cache
from ethbrake_marl.cli.app import whole_command
from ethbrake_marl.files import store
from ethbrake_marl.parallel import run_each
from ethbrake_marl.worlds.scenario_file import new_scenario_text

ROOT = Path(__file__).resolve().parents[1]
WITHOUT = """
import os, signal, sys, sysconfig
sysconfig.get_config_vars()
for module, names in ((os, {os_names!r}), (signal, {signal_names!r}), (sys, ("abiflags",))):
    for name in names:
        vars(module).pop(name, None)
import ethbrake_marl.cli.app as app
sys.exit(str([app.run_command(each) for each in {commands!r}]))
"""
OS_NAMES = ("fork", "getuid", "geteuid", "sched_getaffinity", "mkfifo", "killpg", "getpgid", "O_NOFOLLOW")
if sys.version_info < (3, 14):  # from then on shutil on Unix needs it
    OS_NAMES += ("O_NONBLOCK",)
SIGNAL_NAMES = ("pthread_sigmask", "SIGHUP", "SIGKILL", "SIGPIPE", "SIGALRM", "setitimer", "SIGUSR1")


def test_commands__without_functions_that_only_unix_has(empty_folder: Path) -> None:
    Path("short.yaml").write_text("name: short\nbased_on: paper-random\nhorizon_s: 0.9\n")
    lines = (
        "evaluate --episodes 3 --agents full_brake,ppo --jobs 2 --output out", "doctor",
        "watch --scenario short.yaml --output film.gif",
    )  # fmt: skip
    # watch is an extension's
    commands = [line.split() for line in lines if line.split()[0] in whole_command().commands]
    program = WITHOUT.format(os_names=OS_NAMES, signal_names=SIGNAL_NAMES, commands=commands)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.stderr.splitlines()[-1] == str([0] * len(commands)) and len(commands) >= 2


PARTS = """
from importlib import import_module
import ethbrake_marl as eb
from ethbrake_marl.registry import points
from ethbrake_marl.worlds.catalogue import scenario_paths
print(sorted(eb.__all__), [sorted(points(group)) for group in ("agents", "shields", "measures")], dir(eb))
print(sorted(scenario_paths()), eb.load_scenario("standards-ccrs"), eb.load_shipped("ppo"))
print([import_module(name).__all__ for name in {doors!r}])
"""


def parts(folder: Path, place: Path) -> list[str]:
    """What a program finds in the package at ``place``."""
    texts = {path: path.read_text("utf-8") for path in ROOT.glob("ethbrake_marl/extensions/*/__init__.py")}
    doors = [f"ethbrake_marl.extensions.{path.parent.name}" for path, text in texts.items() if "front_door(" in text]
    environment = {**os.environ, "PYTHONPATH": str(place), "TMPDIR": str(folder)}
    command = [sys.executable, "-c", PARTS.format(doors=doors)]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.slow
def test_package__without_source_files_has_all_its_parts(tmp_path: Path) -> None:
    """Compiled only, and in a zip file."""
    compiled, zipped = tmp_path / "compiled", tmp_path / "app.zip"
    package = compiled / "ethbrake_marl"
    shutil.copytree(ROOT / "ethbrake_marl", package, ignore=shutil.ignore_patterns("__pycache__", "*.npz"))
    for name in ("scenarios", "train"):  # as in a wheel
        shutil.copytree(ROOT / name, package / "_data" / name)
    with zipfile.ZipFile(zipped, "w") as archive:
        for path in package.rglob("*"):
            archive.write(path, path.relative_to(compiled))
    for path in package.rglob("*.py"):
        known = Path(cache_from_source(ROOT / path.relative_to(compiled)))
        if known.is_file():
            shutil.copy(known, path.with_suffix(".pyc"))
        else:
            py_compile.compile(str(path), str(path.with_suffix(".pyc")), doraise=True)
        path.unlink()
    expected = parts(tmp_path, ROOT)
    assert parts(tmp_path, compiled) == parts(tmp_path, zipped) == expected
    assert len(expected) == 3 and not [*tmp_path.glob("ethbrake_marl-*")]


def test_table__can_be_printed_on_every_console() -> None:
    """By the command, and in Python."""
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0", "COLUMNS": "100"}
    command = [sys.executable, "-m", "ethbrake_marl", "evaluate", "--episodes", "3", "--agents", "full_brake"]
    done = subprocess.run(command, capture_output=True, env=environment, check=False)
    assert done.returncode == 0 and "full_brake" in done.stdout.decode("ascii"), done.stderr
    table = eb.summarise(eb.evaluate("paper-random", "full_brake", episodes=3))
    for encoding in ("cp1252", "ascii", "cp437"):
        console = io.TextIOWrapper(io.BytesIO(), encoding)
        with redirect_stdout(console):
            print(table)
        console.flush()
        assert "full_brake" in console.buffer.getvalue().decode(encoding)  # type: ignore[attr-defined]


def test_files__with_windows_line_ends_are_read_alike(empty_folder: Path) -> None:
    text = new_scenario_text("mine")
    rows = "gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps\n7,8,20,18,20\n6,9,19,20,21\n"
    agent = "import ethbrake_marl as eb\n\ndef make():\n    return eb.make_agent('coast')\n"
    results = []
    for end in ("\n", "\r\n"):
        for name, content in (("mine.yaml", text), ("rows.csv", rows), (f"mine{len(end)}.py", agent)):
            Path(name).write_bytes(content.replace("\n", end).encode())
        worlds = eb.read_worlds("paper-random", "rows.csv")
        result = eb.evaluate("mine.yaml", f"mine{len(end)}.py:make", episodes=2)[f"mine{len(end)}.py:make"]
        content = eb.load_scenario("mine.yaml").content()
        results.append((content, result["total_harm"].tolist(), worlds.gaps_m.tolist()))
    assert results[0] == results[1]


def test_stored_code__that_another_process_reads_stays_without_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    """Windows refuses to replace a file that is open."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(kernel_cache, "_warned", [])
    kernel_cache.save_data("a", b"code")

    def refuse(source: object, target: object) -> None:
        raise PermissionError(13, "The process cannot access the file", str(target))

    monkeypatch.setattr(store.os, "replace", refuse)
    kernel_cache.save_data("a", b"code")
    assert not recwarn.list and kernel_cache.load_data("a", bytes) == b"code"
    kernel_cache.save_data("b", b"code")
    assert "every process compiles the physics again" in str(recwarn.pop().message)


def test_run__is_replaced_without_an_open_file_in_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows refuses to move a folder with an open file, such as a lock that is held."""
    from ethbrake_marl.training.run import RunFolder

    run = RunFolder(tmp_path / "run")
    run.create({})
    moved = store.remove_folder

    def check(path: Path) -> None:
        opened = {os.path.realpath(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd")}
        assert not [name for name in opened if name.startswith(f"{path}{os.sep}")]
        moved(path)

    monkeypatch.setattr(store, "remove_folder", check)
    run.create({"new": 1}, force=True)
    assert "new" in run.config.read_text()


def test_written_file__is_flushed_through_a_handle_that_can_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import fcntl

    modes = []
    monkeypatch.setattr(store.os, "fsync", lambda fd: modes.append(fcntl.fcntl(fd, fcntl.F_GETFL) & os.O_ACCMODE))
    store.write_file(tmp_path / "file", b"x")
    assert modes == [os.O_RDWR]


def test_names_of_files__differ_in_more_than_case_and_have_no_character_that_windows_forbids() -> None:
    listed = subprocess.run(["git", "ls-files"], capture_output=True, text=True, check=False).stdout.splitlines()
    if not listed:
        pytest.skip("not in a git repository")
    assert len({name.lower() for name in listed}) == len(listed)
    assert not [name for name in listed if set('<>:"|?*\\') & {*name} or len(name) > 120]
    parts = {Path(part).stem.lower() for name in listed for part in name.split("/")}
    assert not parts & {"con", "prn", "aux", "nul", "com1", "lpt1"}


def test_workers__are_started_without_fork(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on Windows and macOS: no memory of the parent is shared."""
    pytest.importorskip("joblib")
    monkeypatch.setattr(os, "fork", lambda: pytest.fail("fork"))
    assert [*run_each([(divmod, 7, 2), (divmod, 9, 4)], 2)] == [(3, 1), (2, 1)]
