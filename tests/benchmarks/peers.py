"""``make bench-peers``: this project beside other simulators, all measured now, by one loop, on this machine.

Peers live in an environment of their own, made here: some have licences or dependencies that this project does not
want. One that cannot be installed or measured is listed with the reason. What is measured: ``loops.py``.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import venv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ethbrake_marl.studies.speed import this_machine
from tests.benchmarks.loops import LOOPS, OURS, REPETITIONS, SECONDS, Loop

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
CONSTRAINTS = (ROOT / "constraints.txt", HERE / "constraints-peers.txt")
MOST_SECONDS = 900  # that an installation or a measurement may take


@dataclass(frozen=True)
class Figure:
    """One loop after it was measured, or the reason why it was not."""

    loop: Loop
    version: str = ""
    rates: tuple[float, ...] = ()  # ascending
    reason: str = ""

    @property
    def median(self) -> float:
        """World-steps per second of processor time."""
        return statistics.median(self.rates)


def run(command: Sequence[str | Path]) -> tuple[str, str]:
    """What a command printed, and why it failed (empty: it did not): the last line of what it complained of."""
    try:
        result = subprocess.run(
            command,
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=MOST_SECONDS,
            check=False,
            stdin=subprocess.DEVNULL,
        )
    except subprocess.TimeoutExpired:
        return "", f"took longer than {MOST_SECONDS} s"
    except OSError as error:
        return "", str(error)
    if result.returncode == 0:
        return result.stdout, ""
    lines = [line.strip() for line in result.stderr.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("ERROR:")] or lines
    return "", errors[-1] if errors else f"ended with status {result.returncode}"


def install(python: Path, distribution: str, torch_index: str) -> str:
    """Install one peer; why that failed, or nothing. torch comes alone and first, as in the Makefile."""
    pip: list[str | Path] = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    for file in CONSTRAINTS:
        pip += ["-c", file]
    if distribution == "vmas":
        index = ["--index-url", torch_index] if torch_index else []
        _, reason = run([*pip, "--no-deps", *index, "torch"])
        if reason:
            return f"torch: {reason}"
    return run([*pip, distribution])[1]


def measure(python: Path, name: str) -> Figure:
    """Measure one loop in a process of its own."""
    printed, reason = run([python, HERE / "loops.py", name])
    if reason:
        return Figure(LOOPS[name], reason=f"not measured: {reason}")
    found = json.loads(printed.splitlines()[-1])
    return Figure(LOOPS[name], found["version"], tuple(found["rates"]))


def line(figure: Figure, ours: dict[str, Figure]) -> str:
    """One line of the table."""
    begin = f"{f'{figure.loop.distribution} {figure.version}':21} {figure.loop.what:35}"
    if figure.reason:
        return f"{begin} {figure.reason}"
    span = f"{plain(figure.rates[0])} - {plain(figure.rates[-1])}"
    text = f"{begin} {plain(figure.median):>10}   {span:23}"
    own = ours.get(figure.loop.beside or "")
    if own is None or own.reason:
        return text.rstrip()
    return f"{text}   ours: {plain(own.median / figure.median)} x"


def plain(value: float) -> str:
    """Three digits, with commas from 1,000 on."""
    return f"{float(f'{value:.3g}'):,.{0 if value >= 99.95 else 1 if value >= 9.995 else 2}f}"


def main() -> None:
    """Install the peers, measure everything, print one line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--environment", type=Path, default=ROOT / ".venv-peers", help="folder of the peers' environment"
    )
    parser.add_argument("--torch-index", default="", metavar="URL", help="index to take torch from")
    parser.add_argument("--only", metavar="NAME", action="append", choices=list(LOOPS), help="measure this loop alone")
    arguments = parser.parse_args()
    names = [name for name in LOOPS if not arguments.only or name in arguments.only]
    python = arguments.environment / "bin" / "python"
    reasons = {OURS: ""}
    if any(LOOPS[name].distribution != OURS for name in names) and not python.exists():
        print(f"== Making the environment {arguments.environment.name}", flush=True)
        venv.create(arguments.environment, with_pip=True)
    for distribution in dict.fromkeys(LOOPS[name].distribution for name in names):
        if distribution not in reasons:
            print(f"== Installing {distribution}", flush=True)
            reasons[distribution] = install(python, distribution, arguments.torch_index)
    print(f"== World-steps per CPU-second: median of {REPETITIONS} x {SECONDS:g} s, lowest - highest", flush=True)
    ours: dict[str, Figure] = {}
    for name in names:
        loop = LOOPS[name]
        if reasons[loop.distribution]:
            figure = Figure(loop, reason=f"not installed: {reasons[loop.distribution]}")
        else:
            figure = measure(Path(sys.executable) if loop.distribution == OURS else python, name)
        if loop.distribution == OURS:
            ours[name] = figure
        print(line(figure, ours), flush=True)
    print(f"Machine: {this_machine()}")


if __name__ == "__main__":
    main()
