"""Mutation testing: small changes to the code that some test must notice.

``make mutation`` (or ``python -m tests.physics.programme.mutation``; ``--help`` names the options). Without options it
tries the physics; ``--modules`` names others (``tests/programme/suites.py`` lists them and the tests that try each
file), ``--sample K`` takes K mutants of each.

Every mutant changes one node of the syntax tree: an arithmetic or comparison operator, a constant, a condition negated,
a statement removed, min and max swapped, a sign. It is written into a temporary copy of the repository, never into the
working tree. A process forked from one that has numpy, numba and pytest loaded then runs a quick suite there: that of
files with kernels with compilation switched off (a mutant dies in about a second), that of others with kernels that
were compiled once for all mutants. A mutant that lives through it meets a second, larger suite, compiled. A mutant is
killed by a failed test, by an exception, or by running out of time or memory.

Mutants that no test can kill, because they compute the same, stand in ``equivalents.py`` (here those of the physics, in
``tests/programme`` all others), each with its reason. They are tried like all others (one that dies makes the run fail:
the reason was wrong) and left out of the score.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from tests.physics.programme import equivalents as of_physics
from tests.physics.programme.mutants import Mutant, mutants
from tests.programme import equivalents as of_others
from tests.programme.copies import KERNELS, mutated, working_copy
from tests.programme.suites import ROOT, SUITES, suite_of

PATIENCE = 3.0  # times the processor time of a test file without a mutant, and
SHORTEST_LIMIT_S = 2.0
WALL_PER_CPU = 20  # a process that waits instead of computing ends after this many times its processor time
MOST_CPU_S = 600
MOST_MEMORY_BYTES = 8 * 2**30
SECONDS_PER_MUTANT = {True: 1.2, False: 5.0}  # one process, for the estimate: without and with compilation
THRESHOLD = 0.95
EQUIVALENT = of_physics.EQUIVALENT | of_others.EQUIVALENT

PYTEST = ("-x", "-q", "-m", "not long", "-p", "no:cacheprovider", "-p", "no:randomly", "--rootdir=.")
# tests that take seconds each without compilation
SECONDS_EACH = ("oracle", "order_one", "50-1", "long_lines", "ten_thousand", "none_missed", "scan", "fresh_worlds")
LEFT_TO_COMPILED = ("-k", " and ".join(f"not {name}" for name in SECONDS_EACH))
SLOW = ("tests/physics/test_against_reference.py",)


# ---------------------------------------------------------------- one mutant


def quick_run(folder: Path, limit_s: dict[str, float], *, compiled: bool) -> tuple[str, float]:
    """Run test files, each within its processor time, in a forked process until the first failure.

    Returns "passed", "failed" or "timeout", and the processor time of all.
    """
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY_BYTES, MOST_MEMORY_BYTES))
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(round(WALL_PER_CPU * sum(limit_s.values())))
        _run_pytest(folder, limit_s, compiled)
    _, status, used = os.wait4(child, 0)
    code = os.waitstatus_to_exitcode(status)
    limits = (-signal.SIGXCPU, -signal.SIGKILL, -signal.SIGALRM)
    verdict = "passed" if code == 0 else "timeout" if code in limits else "failed"
    return verdict, used.ru_utime + used.ru_stime


def _run_pytest(folder: Path, limit_s: dict[str, float], compiled: bool) -> None:
    """In the child: the tests, silently; never returns."""
    import numba
    import pytest

    numba.config.DISABLE_JIT = not compiled
    os.environ |= {"NUMBA_DISABLE_JIT": str(int(not compiled)), "NUMBA_CACHE_DIR": str(folder / KERNELS)}
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    os.chdir(folder)
    sys.dont_write_bytecode = True
    for name in [name for name in sys.modules if name.split(".")[0] == "tests"]:
        del sys.modules[name]  # those of the working tree
    options = [*PYTEST, *(() if compiled else LEFT_TO_COMPILED), "-W", "ignore::pytest.PytestAssertRewriteWarning"]
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


def whole_run(folder: Path, tests: Sequence[str]) -> str:
    """The second suite, compiled, in a process of its own."""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "0", "NUMBA_CACHE_DIR": str(folder / KERNELS)}
    ignored = [f"--ignore={name}" for name in SLOW]
    command = [sys.executable, "-B", "-m", "pytest", *PYTEST, *ignored, *tests]
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, timeout=MOST_CPU_S, check=False
        )
    except subprocess.TimeoutExpired:
        return "timeout"
    return "passed" if done.returncode == 0 else "failed"


class Worker:
    """One temporary copy of the repository in which mutants of one module are tried one after another."""

    def __init__(self, folder: Path, module: str, journal: Path | None) -> None:
        self.folder = folder
        self.suite = SUITES[module]
        self.journal = journal
        self.limit_s: dict[str, float] = {}

    def try_mutant(self, mutant: Mutant, *, whole: bool) -> str:
        """The verdict of one suite on one mutant; the copy is whole again afterwards."""
        seconds = 0.0
        with mutated(self.folder, mutant.file, mutant.source):
            if whole:
                verdict = whole_run(self.folder, self.suite.whole)
            else:
                compiled = not self.suite.without_compiler(mutant.file)
                limits = {test: self.limit_s[test] for test in self.suite.tests_of(mutant.file)}
                verdict, seconds = quick_run(self.folder, limits, compiled=compiled)
        self._note(mutant, "compiled" if whole else "quick", verdict, seconds)
        return verdict

    def _note(self, mutant: Mutant, suite: str, verdict: str, seconds: float) -> None:
        if self.journal is not None:
            line = {"digest": mutant.digest, "suite": suite, "verdict": verdict, "cpu_s": round(seconds, 2)}
            line["mutant"] = mutant.name
            with self.journal.open("a", encoding="utf-8") as out:
                out.write(json.dumps(line) + "\n")

    def check_whole(self, share: list[Mutant]) -> None:
        """The suites must pass without a mutant, or nothing would mean anything; how long they take sets the limit."""
        tests = {(t, self.suite.without_compiler(m.file)) for m in share for t in self.suite.tests_of(m.file)}
        for test, interpreted in sorted(tests):
            for _ in range(1 if interpreted else 2):  # the first time kernels are compiled
                verdict, seconds = quick_run(self.folder, {test: MOST_CPU_S}, compiled=not interpreted)
                if verdict != "passed":
                    raise RuntimeError(f"fails without any mutant: {test}")
            self.limit_s[test] = max(PATIENCE * seconds + SHORTEST_LIMIT_S, self.limit_s.get(test, 0.0))

    def check_second(self) -> None:
        """As ``check_whole``, for the second suite."""
        if whole_run(self.folder, self.suite.whole) != "passed":
            raise RuntimeError("the second suite fails without any mutant")


# ---------------------------------------------------------------- all of them


def preload(names: Iterable[str]) -> None:
    """Load what every test process needs once, before forking; nothing of the package itself."""
    os.environ |= {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    sys.path[:] = [p for p in sys.path if Path(p or ".").resolve() != ROOT]
    for name in ("hypothesis", "numba", "numpy", "pytest", *names):
        importlib.import_module(name)


def try_share(module: str, share: list[Mutant], whole: bool, journal: Path | None) -> list[str]:
    """Verdicts of one suite on some mutants of a module, one after another, in a copy of their own."""
    if not share:
        return []
    with working_copy() as folder:
        worker = Worker(folder, module, journal)
        if whole:
            worker.check_second()
        else:
            worker.check_whole(share)
        return [worker.try_mutant(mutant, whole=whole) for mutant in share]


def try_all(module: str, chosen: list[Mutant], jobs: int, *, whole: bool, journal: Path | None) -> dict[Mutant, str]:
    """Verdicts of one suite, in ``jobs`` processes. Mutants whose verdict stands in the journal are not tried again."""
    known = verdicts_of(journal, whole=whole)
    old = {mutant: known[mutant.digest] for mutant in chosen if mutant.digest in known}
    fresh = [mutant for mutant in chosen if mutant not in old]
    shares = [fresh[k::jobs] for k in range(jobs)]
    with ProcessPoolExecutor(jobs, mp_context=get_context("fork")) as pool:  # its processes may have children
        futures = [pool.submit(try_share, module, share, whole, journal) for share in shares]
        verdicts = [future.result() for future in futures]
    found = {m: v for share, many in zip(shares, verdicts, strict=True) for m, v in zip(share, many, strict=True)}
    return old | found


def verdicts_of(journal: Path | None, *, whole: bool) -> dict[str, str]:
    """Verdicts of one suite in the journal of earlier runs, by digest; the last one counts."""
    if journal is None or not journal.exists():
        return {}
    lines = [json.loads(line) for line in journal.read_text("utf-8").splitlines()]
    return {line["digest"]: line["verdict"] for line in lines if line["suite"] == ("compiled" if whole else "quick")}


def chosen_mutants(module: str, only: str, sample: int, seed: int) -> list[Mutant]:
    """All mutants of a module in a random order, or the first of them: a smaller sample is part of a larger one."""
    every = [mutant for file in SUITES[module].sources() if only in file.name for mutant in mutants(file)]
    random.Random(seed).shuffle(every)
    return every[: sample or None]


def options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--modules", default="physics", help=f"comma list, or all: {', '.join(SUITES)}")
    parser.add_argument("--sample", type=int, default=0, help="try only K mutants of each module, chosen at random")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", default="", help="only files whose name contains this")
    parser.add_argument("--quick", action="store_true", help="leave out the second suite for those that live")
    parser.add_argument("--journal", type=Path, help="note every verdict here, and take those noted before as they are")
    given = parser.parse_args()
    given.modules = list(SUITES) if given.modules == "all" else given.modules.split(",")
    for name in given.modules:
        if name not in SUITES:
            parser.error(f"--modules {name}: must be of {', '.join(SUITES)}")
    return given


def main() -> int:
    """Try the mutants and print what lived."""
    given = options()
    chosen = {module: chosen_mutants(module, given.only, given.sample, given.seed) for module in given.modules}
    every = [mutant for some in chosen.values() for mutant in some]
    seconds = sum(SECONDS_PER_MUTANT[suite_of(mutant.file).without_compiler(mutant.file)] for mutant in every)
    minutes = seconds / given.jobs / 60.0
    print(f"{len(every)} mutants, about {minutes:.0f} min, and the second runs of those that live", flush=True)
    preload(dict.fromkeys(name for module in chosen for name in SUITES[module].preloaded))
    begin, verdicts = time.monotonic(), {}
    for module, some in chosen.items():
        found = try_all(module, some, given.jobs, whole=False, journal=given.journal)
        alive = [mutant for mutant in some if found[mutant] == "passed"]
        minutes = (time.monotonic() - begin) / 60
        print(f"{module}, quick suite: {len(some) - len(alive)}/{len(some)} killed after {minutes:.1f} min", flush=True)
        if not given.quick:
            found |= try_all(module, alive, given.jobs, whole=True, journal=given.journal)
        verdicts |= found
    return report(every, verdicts, time.monotonic() - begin)


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
