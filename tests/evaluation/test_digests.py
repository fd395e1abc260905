"""Digests name results and quantities: a row that nobody uses changes none, and what was recorded is found."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.departures import PLAIN_ROWS
from ethbrake_marl.evaluation import provenance
from ethbrake_marl.evaluation.provenance import worlds_sha256
from ethbrake_marl.motion import digest
from ethbrake_marl.motion.layout import ANSWERED, CAR_NAMES, EASED, FOREIGN, LINE_ROWS, SHARED, Floats

RECORDED = Path(__file__).parents[2] / "docs/results/benchmark/rules.csv"


def digest_of(monkeypatch: pytest.MonkeyPatch, change: Any) -> str:
    """Digest of a few random worlds, whose arrays ``line`` have been changed."""
    play = digest.play_random_worlds
    with monkeypatch.context() as patch:
        patch.setattr(digest, "DIGEST_WORLDS", 30)
        patch.setattr(digest, "play_random_worlds", lambda vehicles: [change(line) for line in play(vehicles)])
        return digest.physics_digest.__wrapped__()


def with_row(array: Floats, value: float) -> Floats:
    return np.concatenate([array, np.full_like(array[:, :1], value)], axis=1)


def changed(row: int) -> Any:
    def change(line: Floats) -> Floats:
        line[-1, row, 0] = np.nextafter(line[-1, row, 0], np.inf)
        return line

    return change


def test_digest_of_the_physics__has_all_results_and_no_other_rows(monkeypatch) -> None:
    plain = digest_of(monkeypatch, lambda line: line)
    assert digest_of(monkeypatch, lambda line: with_row(line, 0.0)) == plain
    assert digest_of(monkeypatch, lambda line: with_row(line, 1.0)) == plain  # a later result, which has no name yet
    digests = [digest_of(monkeypatch, changed(row)) for row in digest.RESULTS]
    assert len({plain, *digests}) == 1 + len(digest.RESULTS)
    assert set(range(LINE_ROWS)) - set(digest.RESULTS) == {ANSWERED, SHARED, EASED, FOREIGN}


def test_digest_of_the_physics__does_not_depend_on_the_order_of_rows(monkeypatch) -> None:
    plain = digest_of(monkeypatch, lambda line: line)
    monkeypatch.setattr(digest, "RESULTS", [LINE_ROWS - 1 - row for row in digest.RESULTS])
    assert digest_of(monkeypatch, lambda line: line[:, ::-1]) == plain


def test_identity_of_worlds__names_quantities(monkeypatch) -> None:
    worlds = eb.load_scenario("paper-random").sample(5, 7)
    same = worlds._replace(line=with_row(worlds.line, 0.0), car=with_row(worlds.car, 0.0))
    icy, plain = worlds._replace(car=with_row(worlds.car, 0.3)), worlds_sha256(worlds)
    monkeypatch.setattr(provenance, "CAR_NAMES", (*CAR_NAMES, "ice"))
    assert worlds_sha256(same) == plain
    on_ice = worlds_sha256(icy)
    monkeypatch.setattr(provenance, "CAR_NAMES", (*CAR_NAMES, "rain"))
    assert len({plain, on_ice, worlds_sha256(icy)}) == 3
    for row in PLAIN_ROWS:
        car = worlds.car.copy()
        car[0, row, 1] += 1.0
        assert worlds_sha256(same._replace(car=with_row(car, 0.0))) != plain or np.isinf(car[0, row, 1])


def test_identity_of_worlds__is_the_recorded_one() -> None:
    rows = [row for row in csv.DictReader(RECORDED.read_text("utf-8").splitlines()) if row["task"] == "benchmark-pair"]
    worlds = eb.load_scenario("benchmark-pair").sample(int(rows[0]["episodes"]), seed=7)
    assert {row["worlds_sha256"] for row in rows} == {worlds_sha256(worlds)}
