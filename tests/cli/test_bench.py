"""``ethbrake doctor speed``: the table and the JSON; measuring itself is tested in tests/studies/test_speed.py."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from ethbrake_marl.studies import speed as benchmark
from ethbrake_marl.studies.speed import Benchmark, Effort, Speed, this_machine

SPEEDS = (
    Speed("engine step", "of a test", 1024, 3, "world-steps/s", 9_876_543.0, 9_000_000.0, 10_000_000.0, 8e6),
    Speed("import and first step", "of a test", 1, 3, "s", 0.91, 0.9, 0.95, 2.0),
    Speed("sampling", "of a test", 10_000, 3, "worlds/s", 512.0, 500.0, 540.0),
)


@pytest.fixture
def efforts(monkeypatch: pytest.MonkeyPatch) -> list[Effort]:
    """The efforts asked for; nothing is measured."""
    asked: list[Effort] = []

    def figure(speed: Speed) -> Benchmark:
        def look(effort: Effort) -> np.ndarray:
            asked.append(effort)
            return np.array([speed.lowest, speed.value, speed.highest])

        return Benchmark(speed.name, speed.workload, speed.unit, speed.worlds, speed.floor, look)

    made = tuple(figure(speed) for speed in SPEEDS)
    monkeypatch.setattr(benchmark, "BENCHMARKS", made)
    return asked


def test_bench__prints_a_table_and_the_machine(ethbrake, efforts):
    answer = ethbrake("doctor", "speed")
    assert answer.status == 0
    lines = answer.out.splitlines()
    (engine,) = (line for line in lines if "engine step" in line)
    assert re.split(r"  +", engine.strip()) == [
        "engine step", "1,024", "9.88 M world-steps", "9.00 M - 10.0 M", "29.6 M", "8.00 M",
    ]  # fmt: skip
    (start,) = (line for line in lines if "import and first step" in line)
    assert re.split(r"  +", start.strip())[2:] == ["0.91 s", "0.9 - 0.95", "2"]
    assert "512 worlds" in answer.out
    assert lines[-1].startswith(f"Machine: {this_machine().processor}, ")
    assert efforts == [benchmark.FULL] * 3


def test_bench_json__is_pure_and_complete(ethbrake, efforts):
    answer = ethbrake("doctor", "speed", "--quick", "--json")
    assert answer.status == 0
    found = json.loads(answer.out)
    assert [figure["name"] for figure in found["figures"]] == [speed.name for speed in SPEEDS]
    assert found["figures"][0]["value"] == 9_876_543.0 and found["figures"][0]["relative"] == 1.0
    assert found["machine"]["cores"] >= 1 and found["machine"]["processor"]
    assert efforts == [benchmark.QUICK] * 3
    assert "speed: 1 of 3" in answer.err
