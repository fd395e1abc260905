"""``advance`` on several threads: the same bits, the same order of impacts, the same errors."""

from __future__ import annotations

import dataclasses
import threading

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Worlds, advance, compiling as parallel, make_worlds
from ethbrake_marl.physics.compiling import by_parts
from ethbrake_marl.scenario import load_scenario


def braking(n: int) -> tuple[Worlds, np.ndarray]:
    worlds = load_scenario("paper-random").sample(n, 7).worlds
    return worlds, -0.75 * worlds.vehicles.braking_capacity_mps2


@pytest.mark.parametrize("threads", [2, 3, np.int64(2), 500])
def test_threads__give_the_same_bits_and_the_same_impacts_in_the_same_order(threads: int) -> None:
    worlds, command = braking(101)
    serial, parallel = (advance(worlds, command, 8.0, record=True, threads=k) for k in (1, threads))
    for mine, its in zip(parallel, serial, strict=True):
        for field in dataclasses.fields(its):
            name = field.name
            if name not in ("vehicles", "rows"):
                assert getattr(mine, name).tobytes() == getattr(its, name).tobytes(), name
    assert serial[1].rows is not None and len(serial[1].rows.world) > 100
    for field in dataclasses.fields(serial[1].rows):
        mine, its = getattr(parallel[1].rows, field.name), getattr(serial[1].rows, field.name)
        assert mine.dtype == its.dtype and mine.tobytes() == its.tobytes(), field.name


def test_threads__one_is_the_default_and_starts_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "ThreadPoolExecutor", None)
    worlds, command = braking(10)
    assert advance(worlds, command, 1.0)[0].time_s.tolist() == [1.0] * 10


def test_threads__record_more_impacts_than_expected_in_one_part_only() -> None:
    # Ten standing vehicles behind each other, and a fast one behind: each impact sets off the next one.
    chain = make_worlds(
        np.full((40, 9), 1.0), np.r_[np.zeros(9), 30.0] * np.ones((40, 1)), braking_capacity_mps2=1e-3,
        driving_capacity_mps2=0.0, latency_s=0.0, mass_t=1.0, restitution=np.r_[np.zeros(20), np.full(20, 0.5)],
    )  # fmt: skip
    serial, parallel = (advance(chain, np.zeros((40, 10)), 9.0, record=True, threads=k)[1] for k in (1, 2))
    assert serial.rows is not None and parallel.rows is not None
    assert (serial.rows.world >= 20).sum() > 4 * 40 + 64
    assert (parallel.rows.world == serial.rows.world).all() and (parallel.rows.time_s == serial.rows.time_s).all()


def test_threads__name_the_same_world_in_an_error() -> None:
    worlds, command = braking(10)
    command[[4, 8], 1] = 99.0
    for threads in (1, 2, 3):
        with pytest.raises(InvalidInput, match=r"command_mps2\[4, 1\] = 99"):
            advance(worlds, command, 1.0, threads=threads)


@pytest.mark.parametrize("threads", [0, -1, 1.0, 2.5, True, None, "2", float("nan")])
def test_threads__that_are_no_number_of_threads_are_refused(threads: object) -> None:
    worlds, command = braking(2)
    with pytest.raises(InvalidInput, match=r"threads = .*: must be a whole number, at least 1"):
        advance(worlds, command, 1.0, threads=threads)  # type: ignore[arg-type]


def test_by_parts__covers_every_row_once_in_order_on_that_many_threads() -> None:
    meet = threading.Barrier(3, timeout=120.0)  # passed only if three threads run at once

    def work(part: slice) -> tuple[range, int]:
        meet.wait()
        return range(part.start, part.stop), threading.get_ident()

    parts = by_parts(work, 10, 3)
    assert [row for rows, _ in parts for row in rows] == list(range(10))
    assert len({ident for _, ident in parts}) == 3 and parts[0][1] == threading.get_ident()


def test_by_parts__has_no_empty_parts() -> None:
    assert by_parts(lambda part: part, 2, 5) == [slice(0, 1), slice(1, 2)]
    assert by_parts(lambda part: part, 1, 5) == [slice(0, 1)]


def test_by_parts__raises_the_first_error_after_all_have_ended() -> None:
    ended = []

    def work(part: slice) -> None:
        ended.append(part.start)
        raise ArithmeticError(str(part.start))

    with pytest.raises(ArithmeticError, match=r"^0$"):
        by_parts(work, 4, 4)
    assert sorted(ended) == [0, 1, 2, 3]
