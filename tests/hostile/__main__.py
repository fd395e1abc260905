"""The attack: thousands of files that a stranger wrote or a disk damaged, each met by the command that reads it.

    python -m tests.hostile [--only KIND] [--sample N] [--seed 0]

Every case must end within 10 s of processor time and 2 GiB of memory, with exit status 2 and one line of error of at
most 2,000 characters without control characters (or, where that cannot be said beforehand, in order), and through
Python with an exception of the project's family; nothing may be executed, and nothing written but what the command is
for. Every place that a case names lies in the programme's own folder, which is removed at the end: a case that names
another is not run, and the kernel keeps the whole attack, the superuser's too, from writing elsewhere. Prints one row
per category and exits with status 1 when a rule was broken.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
import tempfile
import time
import traceback
from collections import defaultdict
from pathlib import Path

from tests.hostile.cage import Verdict, judge
from tests.hostile.confined import can_confine, confine, die_with_parent
from tests.hostile.gates import gate_rows, kind_rows
from tests.hostile.kinds import KINDS, cases_of, warm_up
from tests.hostile.surroundings import gained, listing

HEADING = f"{'kind':12} {'category':34} {'cases':>6} {'refused':>8} {'in order':>9} {'broken':>7} {'CPU s':>6}  longest"


def main() -> int:
    """Run the cases."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", choices=KINDS, action="append", help="this kind alone; repeatable")
    parser.add_argument("--category", help="categories whose name contains this")
    parser.add_argument("--sample", type=int, help="so many cases of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--list", action="store_true", help="how many cases there are, and run none")
    parser.add_argument("--verbose", action="store_true", help="also print each case's message")
    arguments = parser.parse_args()
    if arguments.list:
        print("\n".join((*kind_rows(arguments.seed), *gate_rows())))
        return 0
    with tempfile.TemporaryDirectory(prefix="hostile-", ignore_cleanup_errors=True) as name:
        child = os.fork()  # what confines the attack cannot be undone, and this process has its folder to remove
        if child:
            return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        status = 1
        try:
            die_with_parent()
            status = attack(arguments, Path(name).resolve())
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
        os._exit(status)


def attack(arguments: argparse.Namespace, own: Path) -> int:
    """Run the cases below ``own``, where everything that the attack makes stays; the status to exit with."""
    started, around = time.monotonic(), listing(own)
    os.chdir(own)
    tempfile.tempdir = os.fspath(own)
    warm_up(own)
    if can_confine():
        confine(own)
    else:
        print("this kernel cannot confine a process: the audit hook alone keeps the cases in their folder")
    print(HEADING)
    names: set[str] = set()
    totals = {kind: judge_kind(kind, arguments, own, names) for kind in arguments.only or KINDS}
    for kind, verdicts in totals.items():
        print(row(kind, "in all", verdicts))
    every = list(itertools.chain(*totals.values()))
    strangers = gained(around, names)
    print("".join(f"BROKEN: came to stand outside the attack's folder: {path!a}\n" for path in strangers), end="")
    broken = sum(bool(verdict.faults) for verdict in every) + len(strangers)
    print(f"{len(every)} cases, {broken} broke a rule; {time.monotonic() - started:.0f} s")
    return 1 if broken or not every else 0


def judge_kind(kind: str, arguments: argparse.Namespace, own: Path, names: set[str]) -> list[Verdict]:
    """Run the cases of a kind and print a row per category; ``names`` gains the names that they use."""
    found: dict[str, list[Verdict]] = defaultdict(list)
    for number, case in enumerate(cases_of(kind, KINDS[kind], arguments.seed, arguments.sample)):
        if arguments.category and arguments.category not in case.category:
            continue
        verdict = judge(case, own / f"{kind}-{number}", names)
        found[case.category].append(verdict)
        if arguments.verbose:
            print(f"  {verdict.status} {verdict.cpu_s:.2f} {verdict.message!r:.400}")
        if verdict.faults:
            print(f"BROKEN {kind}, {case.category}, case {number}, {' '.join(case.command)!a:.120}:", flush=True)
            print("".join(f"    {fault!a:.400}\n" for fault in verdict.faults), end="", flush=True)
    for category, verdicts in found.items():
        print(row(kind, category, verdicts), flush=True)
    return list(itertools.chain(*found.values()))


def row(kind: str, category: str, verdicts: list[Verdict]) -> str:
    """One line of the table."""
    refused, faulty = sum(v.refused for v in verdicts), sum(bool(v.faults) for v in verdicts)
    orderly = sum(v.status == 0 for v in verdicts)
    slowest, longest = max((v.cpu_s for v in verdicts), default=0.0), max((v.longest for v in verdicts), default=0)
    return f"{kind:12} {category:34} {len(verdicts):6} {refused:8} {orderly:9} {faulty:7} {slowest:6.2f}  {longest}"


if __name__ == "__main__":
    sys.exit(main())
