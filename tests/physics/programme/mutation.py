"""Mutation testing of ``ethbrake_marl/physics`` and ``harm.py``: small changes to the code that some test must notice.

``make mutation`` (or ``python -m tests.physics.programme.mutation``; ``--help`` names the options).

Every mutant changes one node of the syntax tree: an arithmetic or comparison operator, a constant, a condition negated,
a statement removed, min and max swapped, a sign. It is written into a temporary copy of the repository, never into the
working tree. A process forked from one that has numpy, numba and pytest loaded then runs a quick suite there with
compilation switched off (a mutant dies in about a second). A mutant that lives through it meets a second suite,
compiled. A mutant is killed by a failed test, by an exception, or by running out of time or memory. ``tolerances.py``
is not mutated: it is the yardstick.

Mutants that no test can kill, because they compute the same, stand in ``equivalents.py``, each with its reason. They
are tried like all others (one that dies makes the run fail: the reason was wrong) and left out of the score.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from multiprocessing import get_context
from pathlib import Path

from tests.physics.programme.equivalents import EQUIVALENT
from tests.physics.programme.mutants import ROOT, Mutant, mutants

PHYSICS = "ethbrake_marl/physics"
NOT_MUTATED = {"__init__.py", "tolerances.py"}
PATIENCE = 3.0  # times the processor time of a test file without a mutant, and
SHORTEST_LIMIT_S = 2.0
WALL_PER_CPU = 20  # a process that waits instead of computing ends after this many times its processor time
COMPILED_LIMIT_S = 600
MOST_MEMORY_BYTES = 8 * 2**30
SECONDS_PER_MUTANT = 1.2  # one process, for the estimate
THRESHOLD = 0.95

KERNEL = (
    "tests/physics/test_advance.py", "tests/physics/test_ties.py", "tests/golden/test_physics_hash.py",
    "tests/physics/test_completeness.py", "tests/physics/test_manufactured.py", "tests/physics/test_clusters.py",
    "tests/physics/test_against_exact.py", "tests/physics/test_obstacle.py",
)  # fmt: skip
QUICK = {
    "worlds.py": ("tests/physics/test_worlds.py", "tests/physics/test_advance.py"),
    "compiled.py": ("tests/physics/test_compiled.py",),
    "obstacle.py": ("tests/physics/test_obstacle.py", "tests/test_engine_hazard.py"),
    "packed.py": ("tests/physics/test_packed.py", "tests/test_engine.py", "tests/test_engine_hazard.py"),
    "parallel.py": ("tests/physics/test_parallel.py",),
    "sampled.py": (
        "tests/physics/test_sampled_edges.py", "tests/physics/test_sampled.py", "tests/physics/test_sampled_input.py",
        "tests/physics/test_obstacle.py",
    ),
    "events.py": ("tests/physics/test_events.py", *KERNEL),
    "segment.py": (*KERNEL[:3], "tests/physics/test_segment.py", *KERNEL[3:]),
    "forecast.py": ("tests/physics/test_forecast.py", "tests/physics/test_obstacle.py"),
    "harm.py": ("tests/test_harm.py", "tests/physics/test_ledger.py", "tests/physics/test_obstacle.py"),
    "advance.py": (
        "tests/physics/test_advance.py", "tests/golden/test_physics_hash.py", "tests/physics/test_parallel.py",
        "tests/physics/test_manufactured.py", "tests/physics/test_ties.py", "tests/physics/test_obstacle.py",
    ),
}  # fmt: skip
COMPILED = ("tests/physics", "tests/golden/test_physics_hash.py", "tests/test_harm.py")
PYTEST = ("-x", "-q", "-p", "no:cacheprovider", "--rootdir=.")
# tests that take seconds each without compilation
SECONDS_EACH = ("oracle", "order_one", "50-1", "long_lines", "ten_thousand", "none_missed", "scan", "fresh_worlds")
LEFT_TO_COMPILED = ("-k", " and ".join(f"not {name}" for name in SECONDS_EACH))
SLOW = ("tests/physics/test_against_reference.py",)


# ---------------------------------------------------------------- one mutant


def copy_repository(folder: Path) -> Path:
    """What the tests need, in a folder of its own."""
    ignore = shutil.ignore_patterns("__pycache__", ".venv", "runs", ".git", "*.pyc")
    for name in ("ethbrake_marl", "tests", "scenarios", "train"):
        shutil.copytree(ROOT / name, folder / name, ignore=ignore)
    shutil.copy(ROOT / "pyproject.toml", folder / "pyproject.toml")
    return folder


def quick_files(file: str) -> tuple[str, ...]:
    """Test files of the quick suite for a mutated file."""
    return QUICK.get(Path(file).name, KERNEL)


def quick_run(folder: Path, limit_s: dict[str, float]) -> tuple[str, float]:
    """Run test files, each within its processor time, in a forked process until the first failure.

    Returns "passed", "failed" or "timeout", and the processor time of all.
    """
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY_BYTES, MOST_MEMORY_BYTES))
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(round(WALL_PER_CPU * sum(limit_s.values())))
        _run_pytest(folder, limit_s)
    _, status, used = os.wait4(child, 0)
    code = os.waitstatus_to_exitcode(status)
    limits = (-signal.SIGXCPU, -signal.SIGKILL, -signal.SIGALRM)
    verdict = "passed" if code == 0 else "timeout" if code in limits else "failed"
    return verdict, used.ru_utime + used.ru_stime


def _run_pytest(folder: Path, limit_s: dict[str, float]) -> None:
    """In the child: the tests, silently; never returns."""
    import pytest

    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    os.chdir(folder)
    sys.dont_write_bytecode = True
    for name in [name for name in sys.modules if name.split(".")[0] == "tests"]:
        del sys.modules[name]  # those of the working tree
    options = [*PYTEST, *LEFT_TO_COMPILED, "-W", "ignore::pytest.PytestAssertRewriteWarning"]
    code = 3
    try:
        for file, limit in limit_s.items():  # most mutants die in the first, before the others are even imported
            seconds = math.ceil(time.process_time() + limit)
            resource.setrlimit(resource.RLIMIT_CPU, (seconds, resource.RLIM_INFINITY))
            code = int(pytest.main([*options, file]))
            if code != 0:
                break
    finally:
        os._exit(code)


def compiled_run(folder: Path) -> str:
    """The compiled suite in a process of its own."""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "0", "NUMBA_CACHE_DIR": str(folder / "numba")}
    ignored = [f"--ignore={name}" for name in SLOW]
    command = [sys.executable, "-B", "-m", "pytest", *PYTEST, *ignored, *COMPILED]
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, timeout=COMPILED_LIMIT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return "timeout"
    finally:
        shutil.rmtree(folder / "numba", ignore_errors=True)
    return "passed" if done.returncode == 0 else "failed"


class Worker:
    """One temporary copy of the repository in which mutants are tried one after another."""

    def __init__(self, folder: Path, journal: Path | None) -> None:
        self.folder = copy_repository(folder)
        self.journal = journal
        self.limit_s: dict[str, float] = {}

    def try_mutant(self, mutant: Mutant, *, compiled: bool) -> str:
        """The verdict of one suite on one mutant; the copy is whole again afterwards."""
        file = self.folder / mutant.file
        original = file.read_text("utf-8")
        try:
            file.write_text(mutant.source, "utf-8")
            seconds = 0.0
            if compiled:
                verdict = compiled_run(self.folder)
            else:
                limits = {file: self.limit_s[file] for file in quick_files(mutant.file)}
                verdict, seconds = quick_run(self.folder, limits)
        finally:
            file.write_text(original, "utf-8")
        if self.journal is not None:
            suite = "compiled" if compiled else "quick"
            line = {"digest": mutant.digest, "suite": suite, "verdict": verdict, "cpu_s": round(seconds, 2)}
            line["mutant"] = mutant.name
            with self.journal.open("a", encoding="utf-8") as out:
                out.write(json.dumps(line) + "\n")
        return verdict

    def check_whole(self, share: list[Mutant]) -> None:
        """The suites must pass without a mutant, or nothing would mean anything; how long they take sets the limit."""
        for file in sorted({file for mutant in share for file in quick_files(mutant.file)}):
            verdict, seconds = quick_run(self.folder, {file: COMPILED_LIMIT_S})
            if verdict != "passed":
                raise RuntimeError(f"fails without any mutant: {file}")
            self.limit_s[file] = PATIENCE * seconds + SHORTEST_LIMIT_S

    def check_whole_compiled(self) -> None:
        """As ``check_whole``, for the second suite."""
        if compiled_run(self.folder) != "passed":
            raise RuntimeError("the compiled suite fails without any mutant")


# ---------------------------------------------------------------- all of them


def preload() -> None:
    """Load what every test process needs once, before forking; nothing of the package itself."""
    os.environ["NUMBA_DISABLE_JIT"] = "1"
    os.environ["OMP_NUM_THREADS"] = "1"
    sys.path[:] = [p for p in sys.path if Path(p or ".").resolve() != ROOT]
    import hypothesis
    import numba
    import numpy
    import pytest

    assert numba.config.DISABLE_JIT and hypothesis and numpy and pytest


def try_share(share: list[Mutant], compiled: bool, journal: Path | None) -> list[str]:
    """Verdicts of one suite on some mutants, one after another, in a copy of their own."""
    if not share:
        return []
    with tempfile.TemporaryDirectory() as folder:
        worker = Worker(Path(folder), journal)
        if compiled:
            worker.check_whole_compiled()
        else:
            worker.check_whole(share)
        return [worker.try_mutant(mutant, compiled=compiled) for mutant in share]


def try_all(chosen: list[Mutant], jobs: int, *, compiled: bool, journal: Path | None) -> dict[Mutant, str]:
    """Verdicts of one suite, in ``jobs`` processes. Mutants whose verdict stands in the journal are not tried again."""
    known = verdicts_of(journal, compiled=compiled)
    old = {mutant: known[mutant.digest] for mutant in chosen if mutant.digest in known}
    fresh = [mutant for mutant in chosen if mutant not in old]
    shares = [fresh[k::jobs] for k in range(jobs)]
    with get_context("fork").Pool(jobs) as pool:
        verdicts = pool.starmap(try_share, [(share, compiled, journal) for share in shares], chunksize=1)
    found = {m: v for share, many in zip(shares, verdicts, strict=True) for m, v in zip(share, many, strict=True)}
    return old | found


def verdicts_of(journal: Path | None, *, compiled: bool) -> dict[str, str]:
    """Verdicts of one suite in the journal of earlier runs, by digest; the last one counts."""
    if journal is None or not journal.exists():
        return {}
    lines = [json.loads(line) for line in journal.read_text("utf-8").splitlines()]
    return {line["digest"]: line["verdict"] for line in lines if line["suite"] == ("compiled" if compiled else "quick")}


def chosen_mutants(only: str, sample: int, seed: int) -> list[Mutant]:
    """All mutants in a random order, or the first of them: a smaller sample is part of a larger one."""
    files = [f for f in sorted((ROOT / PHYSICS).glob("*.py")) if f.name not in NOT_MUTATED]
    every = [m for f in (*files, ROOT / "ethbrake_marl/harm.py") if only in f.name for m in mutants(f)]
    random.Random(seed).shuffle(every)
    return every[: sample or None]


def options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sample", type=int, default=0, help="try only K mutants, chosen at random")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", default="", help="only files whose name contains this")
    parser.add_argument("--quick", action="store_true", help="leave out the compiled suite for those that live")
    parser.add_argument("--journal", type=Path, help="note every verdict here, and take those noted before as they are")
    return parser.parse_args()


def main() -> int:
    """Try the mutants and print what lived."""
    given = options()
    chosen = chosen_mutants(given.only, given.sample, given.seed)
    estimate = len(chosen) * SECONDS_PER_MUTANT / given.jobs / 60.0
    print(f"{len(chosen)} mutants, about {estimate:.0f} min, and the compiled runs of those that live", flush=True)
    preload()
    begin = time.monotonic()
    verdicts = try_all(chosen, given.jobs, compiled=False, journal=given.journal)
    alive = [m for m in chosen if verdicts[m] == "passed"]
    minutes = (time.monotonic() - begin) / 60
    print(f"quick suite: {len(chosen) - len(alive)}/{len(chosen)} killed in {minutes:.1f} min", flush=True)
    if not given.quick:
        verdicts |= try_all(alive, given.jobs, compiled=True, journal=given.journal)
    return report(chosen, verdicts, time.monotonic() - begin)


def report(chosen: list[Mutant], verdicts: dict[Mutant, str], seconds: float) -> int:
    """Print killed by file, the survivors and the score; the exit status."""
    equal = [m for m in chosen if m.key in EQUIVALENT]
    refuted = [m for m in equal if verdicts[m] != "passed"]
    judged = [m for m in chosen if m.key not in EQUIVALENT]
    alive = [m for m in judged if verdicts[m] == "passed"]
    total, lived = Counter(m.file for m in judged), Counter(m.file for m in alive)
    for file in sorted(total):
        print(f"{file:42s} {total[file] - lived[file]:4d}/{total[file]}")
    for mutant in sorted(alive, key=lambda mutant: mutant.name):
        print(f"survived  {mutant.name}")
    for mutant in refuted:
        print(f"ERROR     listed as equivalent, but killed: {mutant.name}")
    killed, timeouts = len(judged) - len(alive), sum(verdicts[m] == "timeout" for m in judged)
    good = killed >= THRESHOLD * len(judged) and not refuted
    share = 100 * killed / max(len(judged), 1)
    print(
        f"mutation: {killed}/{len(judged)} killed ({share:.1f} %, {timeouts} by running out of time), {len(equal)}"
        f" equivalent ones left out, threshold {100 * THRESHOLD:.0f} %, {seconds / 60:.1f} min:"
        f" {'PASS' if good else 'FAIL'}"
    )
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
