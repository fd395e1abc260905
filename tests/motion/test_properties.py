"""The motion of any line: against two other simulators, and changes of a world that must not matter, or in one way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ethbrake_marl.motion import layout as at
from ethbrake_marl.motion.layout import Floats
from tests.motion.random_lines import (
    Runs,
    differences,
    exactly,
    passed_differences,
    played,
    push_differences,
    pushes_off,
    random_runs,
    stepped,
)

FEW = 30  # impacts, after which rounding may change their order
RATES = [at.BRAKE_RATE, at.RELEASE_RATE]
HARM = [at.FIRST, at.TOTAL]

worlds = st.builds(
    lambda seed, N, builds_up, obstacle: random_runs(
        np.random.default_rng(seed), 12, N, builds_up=builds_up, obstacle=obstacle
    ),
    st.integers(0, 2**32), st.integers(2, 6), st.booleans(), st.booleans(),
)  # fmt: skip


def few(line: Floats) -> np.ndarray:
    return np.asarray(line[:, at.IMPACTS, :-1].sum(axis=1) <= FEW)


def same_bits(one: Floats, other: Floats) -> None:
    assert one.tobytes() == other.tobytes()


@pytest.mark.parametrize("obstacle", [False, True])
@pytest.mark.parametrize("N", [2, 4])
def test_motion__is_that_of_small_steps_where_brakes_build_up(N: int, obstacle: bool) -> None:
    runs = random_runs(np.random.default_rng([2, N, obstacle]), 12, N, builds_up=True, obstacle=obstacle)
    end = played(runs)
    runs = runs.take(few(end))
    off = differences(end[few(end)], stepped(runs, 1e-3))
    again = off > 1e-3
    off[again] = differences(end[few(end)][again], stepped(runs.take(again), 1e-5))
    assert len(off) > 5 and off.max() <= 1e-3 and np.median(off) < 1e-5


@pytest.mark.parametrize("obstacle", [False, True])
@pytest.mark.parametrize("N", [2, 3, 6])
def test_motion__is_that_of_rational_numbers_where_brakes_act_at_once(N: int, obstacle: bool) -> None:
    runs = random_runs(np.random.default_rng([1, N, obstacle]), 12, N, builds_up=False, obstacle=obstacle)
    end = played(runs)
    rows = np.flatnonzero(few(end))
    exact = np.stack([exactly(runs, k) for k in rows])
    assert len(rows) > 5 and differences(end[rows], exact).max() <= 1e-9
    assert end[rows, at.IMPACTS].tolist() == exact[:, at.IMPACTS].tolist()
    assert push_differences(end[rows], exact).max() <= 1e-12 and exact[:, at.PUSHED].any()
    assert passed_differences(end[rows], exact).max() <= 1e-9 and exact[:, at.PASSED].any() == (N > 2)


@pytest.mark.parametrize("obstacle", [False, True])
@pytest.mark.parametrize("N", [2, 3, *(pytest.param(N, marks=pytest.mark.slow) for N in (4, 6))])
def test_push__is_that_of_small_steps_where_brakes_build_up(N: int, obstacle: bool) -> None:
    runs = random_runs(np.random.default_rng([4, N, obstacle]), 12, N, builds_up=True, obstacle=obstacle)
    off, same = pushes_off(runs, 1e-6)
    assert same.sum() > 5 and off[same].max() <= 1e-6 and played(runs)[same, at.PUSHED].any()


@given(runs=worlds, power=st.sampled_from([-1, 1, 2]))
@settings(max_examples=15)
def test_scale__of_lengths_changes_harm_by_its_square(runs: Runs, power: int) -> None:
    scale = 2.0**power
    line, car = runs.line.copy(), runs.car.copy()
    car[:, at.RESTITUTION] = 0.0  # the speed below which an impact is plastic has no scale
    plain = Runs(line.copy(), car.copy(), runs.times, runs.commands)
    line[:, [at.SPEED, at.FORCE, at.GAP]] *= scale
    line[:, at.GAP, 0] = np.where(runs.line[:, at.GAP, 0] < at.FAR_M, line[:, at.GAP, 0], at.FAR_M)
    car[:, [at.LIMIT, *RATES]] *= scale
    end, scaled = played(plain), played(Runs(line, car, runs.times, scale * runs.commands))
    scaled[:, [at.SPEED, at.FORCE, at.GAP]] /= scale
    scaled[:, HARM] /= scale * scale
    same = few(end) & (end[:, at.IMPACTS] == scaled[:, at.IMPACTS]).all(axis=1)  # a touch has no scale, either
    assert same.sum() >= 0.8 * few(end).sum() and differences(end[same], scaled[same]).max(initial=0.0) < 1e-7


@given(runs=worlds, power=st.integers(-3, 3))
@settings(max_examples=15)
def test_masses__matter_only_by_their_ratios(runs: Runs, power: int) -> None:
    car = runs.car.copy()
    car[:, at.MASS] *= 2.0**power
    same_bits(played(runs._replace(car=car)), played(runs))


@given(runs=worlds, shift=st.sampled_from([-0.5, 64.0]))
@settings(max_examples=15)
def test_origin_of_time__does_not_matter(runs: Runs, shift: float) -> None:
    car, times = runs.car.copy(), [0.5 + round(time * 1024) / 1024 for time in runs.times]
    car[:, at.LATENCY, 1:] = np.round(np.maximum(car[:, at.LATENCY, 1:], 0.25) * 1024) / 1024
    plain = runs._replace(car=car.copy(), times=times)
    car[:, at.LATENCY, 1:] += shift
    same_bits(played(plain._replace(car=car, times=[time + shift for time in plain.times])), played(plain))


@given(runs=worlds, share=st.floats(0.05, 0.95))
@settings(max_examples=15)
def test_interval__may_be_cut_in_two(runs: Runs, share: float) -> None:
    times = [runs.times[0]]
    for start, end in zip(runs.times[:-1], runs.times[1:], strict=True):
        times += [start + share * (end - start), end]
    cut = played(Runs(runs.line, runs.car, times, np.repeat(runs.commands, 2, axis=0)))
    end = played(runs)
    onset = runs.car[:, at.LATENCY, 1:, np.newaxis] - np.array(times[1::2])
    rows = few(end) & (np.abs(onset) > 1e-6).all(axis=(1, 2))  # an onset at the end of an interval comes with the next
    off = differences(end[rows], cut[rows])
    assert (off < 1e-9).mean() >= 0.8 and off.max() < 1e-4  # a contact with a closing speed near 0 loses digits
    assert (push_differences(end[rows], cut[rows]) < 1e-9)[off < 1e-9].all()


@given(runs=worlds, seed=st.integers(0, 1000))
@settings(max_examples=15)
def test_batch__has_no_influence_on_its_worlds(runs: Runs, seed: int) -> None:
    whole, order = played(runs), np.random.default_rng(seed).permutation(len(runs.line))
    same_bits(played(runs.take(order)), whole[order])
    same_bits(played(runs.take(order[:1])), whole[order[:1]])


@given(runs=worlds)
@settings(max_examples=15)
def test_vehicle__far_behind_does_not_matter(runs: Runs) -> None:
    line, car = np.zeros((2, *runs.line.shape)), np.zeros((2, *runs.car.shape))
    line, car = (np.concatenate([array, array[:, :, -1:]], axis=2) for array in (runs.line, runs.car))
    line[:, at.GAP, -2], line[:, at.SPEED, -1], car[:, at.LATENCY, -1] = 1e4, 0.0, 0.0
    commands = np.concatenate([runs.commands, np.zeros((*runs.commands.shape[:2], 1))], axis=2)
    longer, plain = played(Runs(line, car, runs.times, commands)), played(runs)
    longer[:, at.GAP, -2] = np.inf
    same_bits(np.ascontiguousarray(longer[:, :, :-1]), plain)


@given(runs=worlds)
@settings(max_examples=15)
def test_lines__whose_vehicles_only_brake_lose_energy_and_stay_apart(runs: Runs) -> None:
    before, line = np.full(len(runs.line), np.inf), runs.line
    brake = np.minimum(runs.commands, 0.0)
    for k in range(len(brake)):
        start, line = line, played(Runs(line, runs.car, runs.times[k : k + 2], brake[k : k + 1]))
        energy = (runs.car[:, at.MASS, 1:] * line[:, at.SPEED, 1:] ** 2).sum(axis=1)
        assert (energy <= before * (1.0 + 1e-12)).all() and (line[:, at.GAP] >= 0.0).all()
        assert (line[:, at.PUSHED] >= start[:, at.PUSHED]).all()
        assert (line[:, at.FIRST] <= line[:, at.TOTAL]).all() and (line[:, at.HIT] == (line[:, at.IMPACTS] > 0)).all()
        before = energy
