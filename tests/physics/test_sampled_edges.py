"""The paper's fixed-step map where two cases meet: the reach of a sample, a touch, small commands."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import advance_sampled
from tests.physics.test_sampled import line


@pytest.mark.parametrize("time", [1e-6, 1.0 + 0.5e-6, 1.0 - 0.5e-6])
def test_sample__reaches_a_millionth_of_a_step_to_both_sides(time):
    worlds = replace(line([9.0], [4.0, 4.0]), time_s=np.array([time]))
    assert advance_sampled(worlds, 0.0, until_s=2.0, step_s=1.0)[0].time_s.tolist() == [2.0]


@pytest.mark.parametrize("time", [math.nextafter(1e-6, 1.0), 1.0 + 1.5e-6, 1.0 - 1.5e-6])
def test_sample__reaches_no_further(time):
    worlds = replace(line([9.0], [4.0, 4.0]), time_s=np.array([time]))
    with pytest.raises(InvalidInput, match="between two of its samples"):
        advance_sampled(worlds, 0.0, until_s=2.0, step_s=1.0)


def test_first_sample__reaches_a_millionth_of_a_step_before_it():
    on_it, _ = advance_sampled(line([9.0], [4.0, 4.0], latency=[0.0, 1e-6]), 0.0, until_s=0.0, step_s=1.0)
    assert on_it.time_s.tolist() == [0.0]  # at its first sample: no way to go
    before = line([9.0], [4.0, 4.0], latency=[0.0, 2e-6])
    assert advance_sampled(before, 0.0, until_s=1e-6, step_s=1.0)[0].time_s.tolist() == [2e-6]
    assert advance_sampled(before, 0.0, until_s=0.9e-6, step_s=1.0)[0].time_s.tolist() == [0.9e-6]


@pytest.mark.parametrize(
    ("latency", "step", "acts"),
    [(1e-6, 1.0, True), (math.nextafter(1e-6, 1.0), 1.0, False), (0.5e-6, 0.5, True), (0.8e-6, 0.5, False)],
)
def test_latency__within_a_millionth_of_a_step_after_a_sample_is_over_at_it(latency, step, acts):
    worlds = line([99.0], [8.0, 8.0], latency=[latency, 0.0])
    now, _ = advance_sampled(worlds, -2.0, until_s=0.0, step_s=step)
    assert now.command_mps2.tolist() == [[-2.0 if acts else 0.0, -2.0]]
    after, _ = advance_sampled(worlds, -2.0, until_s=step, step_s=step)
    assert after.speeds_mps.tolist() == [[8.0 - 2.0 * step if acts else 8.0, 8.0 - 2.0 * step]]


@pytest.mark.parametrize(("closing", "count"), [(1e-5, 0), (math.nextafter(1e-5, 1.0), 1)])
def test_touch__ends_where_an_impact_begins(closing, count):
    after, impacts = advance_sampled(line([0.0], [0.0, closing]), 0.0, until_s=1.0, step_s=1.0)
    assert impacts.count.tolist() == [[count]] and after.pair_hit.tolist() == [[bool(count)]]
    assert impacts.total_harm.tolist() == [[closing * closing * count]]
    assert after.speeds_mps[0, 0] == after.speeds_mps[0, 1] == pytest.approx(closing / 2.0)


@pytest.mark.parametrize(("speed", "after"), [(8.0, 8.5), (9.75, 10.0), (10.0, 10.0)])
def test_drive__below_1_mps2_ends_at_the_limit_too(speed, after):
    worlds, _ = advance_sampled(line([99.0], [speed, 0.0], limit=10.0), [0.5, 0.0], until_s=1.0, step_s=1.0)
    assert worlds.speeds_mps.tolist() == [[after, 0.0]]


def test_steps__of_one_call_are_a_billion_at_most():
    step = 2.0**-19
    worlds = line([9.0], [4.0, 4.0], latency=[0.0, 5000.0])  # before its first sample nothing is counted out
    assert advance_sampled(worlds, 0.0, until_s=1e9 * step, step_s=step)[0].time_s.tolist() == [1e9 * step]
    with pytest.raises(InvalidInput, match="1,000,000,000 steps"):
        advance_sampled(worlds, 0.0, until_s=math.nextafter(1e9 * step, math.inf), step_s=step)
