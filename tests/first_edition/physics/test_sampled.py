"""The paper's fixed-step map: steps computed by hand, the equations written out once more, and its edges."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.left_out import Impacts
from ethbrake_marl.first_edition.physics.paper_map import advance_sampled
from ethbrake_marl.first_edition.physics.state import Floats, Worlds
from tests.first_edition.physics.random_worlds import line


def paper_random(n: int, latency: Any = (0.0, 0.5, 0.8)) -> tuple[Worlds, Floats]:
    """Worlds of the paper's random test and full braking."""
    rng = np.random.default_rng(7)
    worlds = line(
        rng.uniform(5, 10, (n, 2)), rng.uniform(18, 22, (n, 3)), mass_t=[4.5, 5.5, 5.9], restitution=0.1,
        latency_s=latency, braking_capacity_mps2=[6.0, 7.0, 6.0], speed_limit_mps=40.0,
    )  # fmt: skip
    return worlds, -worlds.vehicles.braking_capacity_mps2


# ---------------------------------------------------------------- by hand, in numbers that doubles hold

# The line, its command, the ends of the calls and what is then: total harm of each pair in all calls, state columns.
# A step is 0.5 s.
CASES: dict[str, tuple[Worlds, Any, list[float], list[float], dict[str, Any]]] = {
    "a step is the papers matrix": (  # 8 - 2 * 0.5, way 0.5 * 8 - 0.125 * 2; the front vehicle 5 m
        line([10.0], [10.0, 8.0]), [0.0, -2.0], [0.5], [0.0],
        {"speeds_mps": [10.0, 7.0], "gaps_m": [11.25], "time_s": 0.5, "command_mps2": [0.0, -2.0]},
    ),
    "front impact": (  # m = 1, 3, w = 4: v1 = 4 + 3/4 * 1.5 * 4, v2 = 8 - 1/4 * 1.5 * 4, then -2 for 0.5 s
        line([0.0, 50.0], [4.0, 8.0, 0.0], mass_t=[1.0, 3.0, 2.0], restitution=0.5), [0.0, -2.0, 0.0], [0.5],
        [16.0, 0.0], {"speeds_mps": [8.5, 5.5, 0.0], "gaps_m": [1.25, 53.0], "pair_hit": [True, False]},
    ),
    "rear impact": (  # m = 3, 1, w = 4: v2 = 4 + 1/4 * 1.5 * 4, v3 = 8 - 3/4 * 1.5 * 4; ways 2.75 + 0.25 and 1.75
        line([50.0, 0.0], [0.0, 4.0, 8.0], mass_t=[2.0, 3.0, 1.0], restitution=0.5), [0.0, 2.0, 0.0], [0.5],
        [0.0, 16.0], {"speeds_mps": [0.0, 6.5, 3.5], "gaps_m": [47.0, 1.25]},
    ),
    "both impacts at one sample, rear first": (  # v2 = v3 = 4, then v1 = v2 = 2. Front first: (1, 3.5, 3.5)
        line([0.0, 0.0], [0.0, 2.0, 6.0]), 0.0, [0.5], [16.0, 16.0],
        {"speeds_mps": [2.0, 2.0, 4.0], "gaps_m": [0.0, -1.0]},
    ),
    "a rear impact makes the front pair close": (  # (3, 2, 6) -> (3, 4, 4) -> (3.5, 3.5, 4)
        line([0.0, 0.0], [3.0, 2.0, 6.0]), 0.0, [0.5], [1.0, 16.0], {"speeds_mps": [3.5, 3.5, 4.0]},
    ),
    "a long line from the rear pair to the front pair": (  # 16 -> 8 8 -> 4 4 -> 2 2 -> 1 1
        line([0.0] * 4, [0.0] * 4 + [16.0]), 0.0, [0.5], [4.0, 16.0, 64.0, 256.0],
        {"speeds_mps": [1.0, 1.0, 2.0, 4.0, 8.0]},
    ),
    "a contact waits for its sample, and the last sample belongs to the next call": (  # at 0.25 s; seen 1 m deep
        line([1.0], [0.0, 4.0]), 0.0, [0.5], [0.0], {"speeds_mps": [0.0, 4.0], "gaps_m": [-1.0]},
    ),
    "the next call resolves it": (
        line([1.0], [0.0, 4.0]), 0.0, [0.5, 1.0], [16.0], {"speeds_mps": [2.0, 2.0], "gaps_m": [-1.0]},
    ),
    "an overlap that opens strikes no second time": (  # leaves at 2 m/s
        line([1.0], [2.0, 6.0], restitution=0.5), 0.0, [0.5, 1.0, 1.5], [16.0], {"speeds_mps": [5.0, 3.0]},
    ),
    "a latency between samples takes effect at the later one": (  # samples at 0.5, 1, 1.5; it brakes from 1 s on
        line([50.0, 50.0], [8.0] * 3, latency_s=[0.0, 0.5, 0.8]), [0.0, -2.0, -2.0], [1.5], [0.0, 0.0],
        {"speeds_mps": [8.0, 6.0, 7.0]},
    ),
    "before the grid Vehicle 1 stops exactly and an overlap is unseen": (  # 1 m in 0.5 s
        line([2.0], [4.0, 8.0], latency_s=[0.0, 0.75], braking_capacity_mps2=8.0), -8.0, [0.5, 0.75], [0.0],
        {"time_s": 0.75, "speeds_mps": [0.0, 8.0], "gaps_m": [-3.0], "command_mps2": [-8.0, 0.0]},
    ),
    "after the grid begins, whole steps": (  # both at 4 m/s, and braking
        line([2.0], [4.0, 8.0], latency_s=[0.0, 0.75], braking_capacity_mps2=8.0), -8.0, [0.5, 0.75, 0.8], [64.0],
        {"time_s": 1.25, "speeds_mps": [0.0, 0.0]},
    ),
    "before the grid a drive ends exactly at the speed limit": (
        line([50.0], [8.0, 0.0], latency_s=[0.0, 2.0], speed_limit_mps=10.0), [2.0, 0.0], [2.0], [0.0],
        {"speeds_mps": [10.0, 0.0], "gaps_m": [69.0]},
    ),
    "a negative speed is known from the first sample on": (
        replace(line([9.0], [3.0, 0.0]), speeds_mps=np.array([[3.0, -2.0]])), [0.0, -2.0], [0.5], [0.0],
        {"speeds_mps": [3.0, -1.0], "gaps_m": [11.25]},
    ),
    "a command is cut to end at standstill and at the limit": (  # u = -2, 0.25 m (exactly 0.0625 m); u = 2, 4.75 m
        line([1.0], [9.0, 1.0], speed_limit_mps=10.0), [8.0, -8.0], [0.5], [0.0],
        {"speeds_mps": [10.0, 0.0], "gaps_m": [5.5]},
    ),
    "and stays there": (
        line([1.0], [9.0, 1.0], speed_limit_mps=10.0), [8.0, -8.0], [1.0], [0.0],
        {"speeds_mps": [10.0, 0.0], "gaps_m": [10.5]},
    ),
    "thrown back, brakes end the negative speed": (  # 8 - 3/4 * 1.5 * 8 = -1; 0.75 m in the step
        line([0.0], [0.0, 8.0], mass_t=[3.0, 1.0], restitution=0.5), [0.0, -1.0], [0.5], [64.0],
        {"speeds_mps": [3.0, -0.5], "gaps_m": [1.875]},
    ),
    "thrown back, at rest after it": (
        line([0.0], [0.0, 8.0], mass_t=[3.0, 1.0], restitution=0.5), [0.0, -3.0], [1.0], [64.0],
        {"speeds_mps": [3.0, 0.0]},
    ),
    "pushed beyond its limit it coasts": (  # v1 = 8 + 0.75 * 2 * 2
        line([0.0], [8.0, 10.0], mass_t=[1.0, 3.0], restitution=1.0, speed_limit_mps=10.0), [5.0, -1.0], [0.5], [4.0],
        {"speeds_mps": [11.0, 8.5]},
    ),
    **{
        f"a drive below 1 m/s2 from {speed} m/s ends at the limit too": (
            line([99.0], [speed, 0.0], speed_limit_mps=10.0), [0.5, 0.0], [1.0], [0.0], {"speeds_mps": [after, 0.0]},
        )
        for speed, after in ((8.0, 8.5), (9.75, 10.0), (10.0, 10.0))
    },
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_map__by_hand(name: str) -> None:
    worlds, command, ends, harm, state = CASES[name]
    found: Any = 0.0
    for end in ends:
        worlds, impacts = advance_sampled(worlds, command, until_s=end, step_s=0.5)
        found = found + impacts.total_harm[0]
    assert found.tolist() == harm
    assert {key: getattr(worlds, key).tolist() for key in state} == {key: [value] for key, value in state.items()}


# ---------------------------------------------------------------- the reach of a sample: a millionth of a step


@pytest.mark.parametrize("until", [math.nextafter(0.75, 0.0), 0.75, math.nextafter(0.75, 9.0)])
def test_first_sample__is_a_time_that_rounding_parts_from_it(until: float) -> None:
    worlds = line([9.0], [4.0, 8.0], latency_s=[0.0, 0.75], braking_capacity_mps2=8.0)
    after, _ = advance_sampled(worlds, -8.0, until_s=until, step_s=0.5)
    again, _ = advance_sampled(after, -8.0, until_s=0.75, step_s=0.5)
    for each in (after, again):
        assert (each.time_s.tolist(), each.speeds_mps.tolist()) == ([0.75], [[0.0, 8.0]])
        assert each.command_mps2.tolist() == [[-8.0, 0.0]] and each.gaps_m.tolist() == after.gaps_m.tolist()


# The line, its command, the step, the end, and columns of the state then.
REACH: list[tuple[Worlds, float, float, float, dict[str, Any]]] = [
    # a sample reaches to both sides (beyond: `test_refusals.py`), the first one to before it
    *(
        (replace(line([9.0], [4.0, 4.0]), time_s=np.array([time])), 0.0, 1.0, 2.0, {"time_s": 2.0})
        for time in (1e-6, 1.0 + 0.5e-6, 1.0 - 0.5e-6)
    ),
    *(
        (line([9.0], [4.0, 4.0], latency_s=[0.0, latency]), 0.0, 1.0, until, {"time_s": time})
        for latency, until, time in ((1e-6, 0.0, 0.0), (2e-6, 1e-6, 2e-6), (2e-6, 0.9e-6, 0.9e-6))
    ),
    # a latency that ends so little after a sample is over at it
    *(
        (line([99.0], [8.0, 8.0], latency_s=[latency, 0.0]), -2.0, step, until, state)
        for latency, step, acts in (
            (1e-6, 1.0, True), (math.nextafter(1e-6, 1.0), 1.0, False), (0.5e-6, 0.5, True), (0.8e-6, 0.5, False)
        )
        for until, state in (
            (0.0, {"command_mps2": [0.0, -2.0]}),
            (step, {"speeds_mps": [8.0 - 2.0 * step * acts, 8.0 - 2.0 * step]}),
        )
    ),
]  # fmt: skip


@pytest.mark.parametrize(("worlds", "command", "step", "until", "state"), REACH, ids=range(len(REACH)))
def test_sample__reaches_a_millionth_of_a_step(
    worlds: Worlds, command: float, step: float, until: float, state: dict[str, Any]
) -> None:
    after, _ = advance_sampled(worlds, command, until_s=until, step_s=step)
    assert {key: getattr(after, key).tolist() for key in state} == {key: [value] for key, value in state.items()}


@pytest.mark.parametrize("step", [0.1, 0.02, 0.003, 0.001])
def test_latency__on_the_grid_is_not_lost_to_rounding(step: float) -> None:
    latency, braking = 0.5 + round(0.3 / step) * step, (600 - round(0.3 / step)) * step
    for late in (latency, math.nextafter(latency, 9.0), math.nextafter(latency, 0.0)):
        worlds = line([50.0, 50.0], [20.0] * 3, latency_s=[0.0, 0.5, late])
        after, _ = advance_sampled(worlds, [0.0, 0.0, -6.0], until_s=0.5 + 600 * step, step_s=step)
        assert after.speeds_mps[0, 2] == pytest.approx(max(20.0 - 6.0 * braking, 0.0), abs=1e-9)


@pytest.mark.parametrize(("closing", "count"), [(8e-6, 0), (1e-5, 0), (math.nextafter(1e-5, 1.0), 1)])
def test_touch__ends_where_an_impact_begins(closing: float, count: int) -> None:
    after, impacts = advance_sampled(line([0.0], [0.0, closing]), 0.0, until_s=1.0, step_s=1.0)
    assert impacts.count.tolist() == [[count]] and after.pair_hit.tolist() == [[bool(count)]]
    assert impacts.total_harm.tolist() == [[closing * closing * count]]
    assert after.speeds_mps[0, 0] == after.speeds_mps[0, 1] == pytest.approx(closing / 2.0)


# ---------------------------------------------------------------- many worlds


def papers_equations(worlds: Worlds, command: Floats, steps: int, step: float) -> tuple[Floats, Floats, Floats]:
    """Lines of three by their positions, equations as printed (with the gate): places, speeds, harm of pairs [., n]."""
    m, e, latency, u = worlds.vehicles.mass_t.T, worlds.vehicles.restitution, worlds.vehicles.latency_s.T, command.T
    start, v, harm = latency[1], worlds.speeds_mps.T.copy(), np.zeros((2, worlds.n))
    x = np.array([worlds.gaps_m.sum(axis=1), worlds.gaps_m[:, 1], 0.0 * start]) + v * start
    x[0] += 0.5 * u[0] * start**2  # Vehicle 1 brakes alone until the grid begins
    v[0] += u[0] * start
    for n in range(steps):
        f = v.copy()
        for i, j in ((1, 2), (0, 1)):  # the rear pair first
            w = np.where((x[i] - x[j] <= 0) & (f[j] - v[i] > 0), f[j] - v[i], 0.0)
            f[i], f[j] = v[i] + m[j] * (1 + e) / (m[i] + m[j]) * w, f[j] - m[i] * (1 + e) / (m[i] + m[j]) * w
            harm[i] += w**2
        acts = np.maximum(np.where(latency <= start + n * step + 1e-9, u, 0.0), -f / step)
        x, v = x + step * f + step**2 / 2 * acts, f + step * acts
    return x, v, harm


@pytest.mark.parametrize("step", [0.1, 0.03])
def test_map__equals_the_papers_equations_written_by_position(step: float) -> None:
    worlds, command = paper_random(60)
    after, impacts = advance_sampled(worlds, command, until_s=0.5 + 100 * step, step_s=step)
    x, v, harm = papers_equations(worlds, command, 100, step)
    assert -np.diff(x, axis=0) == pytest.approx(after.gaps_m.T, abs=1e-10)
    assert v == pytest.approx(after.speeds_mps.T, abs=1e-10) and harm == pytest.approx(impacts.total_harm.T, abs=1e-9)
    assert (impacts.count.sum(axis=0) > 20).all()


def test_calls__can_be_chained_at_samples_and_before_them() -> None:
    worlds, command = paper_random(100, (0.25, 0.5, 0.8))
    whole, impacts = advance_sampled(worlds, command, until_s=5.0)
    state, first, count = worlds, np.zeros((100, 2)), np.zeros((100, 2), np.int64)
    for until in (0.3, 0.5, 0.7, 0.7, 1.9, 5.0):
        state, part = advance_sampled(state, command, until_s=until)
        first, count = first + part.first_impact_harm, count + part.count
    assert state.gaps_m == pytest.approx(whole.gaps_m, abs=1e-12)
    assert state.speeds_mps == pytest.approx(whole.speeds_mps, abs=1e-12)
    assert state.time_s.tolist() == whole.time_s.tolist() and state.pair_hit.tolist() == whole.pair_hit.tolist()
    assert first == pytest.approx(impacts.first_impact_harm, abs=1e-11) and count.tolist() == impacts.count.tolist()


def test_batch__a_world_has_the_same_bits_alone_and_inputs_are_left_alone() -> None:
    worlds, command = paper_random(50, np.linspace(0.0, 0.9, 150).reshape(50, 3))
    gaps = worlds.gaps_m.copy()

    def told(after: Worlds, impacts: Impacts) -> Floats:
        return np.column_stack([after.gaps_m, after.speeds_mps, impacts.total_harm])

    together = told(*advance_sampled(worlds, command, until_s=4.0))
    alone = [told(*advance_sampled(worlds.take([k]), command[[k]], until_s=4.0))[0] for k in (0, 17, 49)]
    np.testing.assert_array_equal(alone, together[[0, 17, 49]])
    assert worlds.gaps_m.tolist() == gaps.tolist() and not worlds.pair_hit.any() and not worlds.time_s.any()


def test_overlap__strikes_again_while_it_closes_and_only_the_first_is_a_first_impact() -> None:
    # e = 0.5 at w = 4, 1 m deep: leaves at 2 m/s; pressed at 8 m/s2 it closes at 2 m/s after 0.5 s
    seen, _ = advance_sampled(line([1.0], [2.0, 6.0], restitution=0.5), 0.0, until_s=0.5, step_s=0.5)
    for until, first, total, count in ((1.5, 16.0, 20.0, 2), (2.0, 0.0, None, 1)):
        seen, impacts = advance_sampled(seen, [0.0, 8.0], until_s=until, step_s=0.5)
        assert (impacts.first_impact_harm.tolist(), impacts.count.tolist()) == ([[first]], [[count]])
        assert total is None or impacts.total_harm.tolist() == [[total]]


def test_detection__a_contact_between_samples_is_missed() -> None:
    # 1 m at 4.5 m/s closing while the front vehicle drives off at 9 m/s2: contact after 1/3 s, but again 1 m at 1 s
    worlds = line([1.0], [0.0, 4.5])
    assert advance(worlds, [9.0, 0.0], 1.0)[1].count.tolist() == [[1]]
    after, impacts = advance_sampled(worlds, [9.0, 0.0], until_s=2.0, step_s=1.0)
    assert impacts.count.tolist() == [[0]]
    assert after.gaps_m.tolist() == [[10.0]]


def test_steps__of_one_call_are_a_billion_at_most() -> None:
    worlds = line([9.0], [4.0, 4.0], latency_s=[0.0, 5000.0])  # before its first sample nothing is counted out
    end = 1e9 * 2.0**-19
    assert advance_sampled(worlds, 0.0, until_s=end, step_s=2.0**-19)[0].time_s.tolist() == [end]
