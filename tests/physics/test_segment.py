"""The way from event to event: its ends, its checks, and values that are put exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.physics import Worlds, advance, make_worlds


def line(gaps, speeds, *, mass=1.0, latency=0.0, limit=64.0) -> Worlds:
    return make_worlds(
        gaps, speeds, braking_capacity_mps2=16.0, driving_capacity_mps2=16.0, latency_s=latency, mass_t=mass,
        restitution=0.0, speed_limit_mps=limit,
    )  # fmt: skip


@pytest.mark.parametrize(("onset", "end"), [(0.4, 1.45), (0.12, 1.3)])
def test_end__that_an_event_reaches_is_the_end_itself(onset, end):
    # 1 m/s over `end` metres; the onset cuts the way in two, whose doubles add up to a little less or more than `end`
    assert onset + (end - onset) != end
    _, impacts = advance(line([end], [0.0, 1.0], latency=[0.0, onset]), 0.0, end, record=True)
    assert impacts.rows.time_s.tolist() == [end]


@pytest.mark.parametrize("limit", [5.6, 6.1, 6.6])
def test_block__takes_the_limit_of_any_of_its_members_to_the_last_bit(limit):
    # 6 t coasting, pushed by 1 t at +1: a block at +1/7, until its rear vehicle is at its limit; the doubles of
    # speed + acceleration * time end a little beyond it
    assert 1.0 + 1.0 / 7.0 * ((limit - 1.0) / (1.0 / 7.0)) > limit
    worlds, _ = advance(line([0.0], [1.0, 1.0], mass=[6.0, 1.0], limit=[64.0, limit]), [0.0, 1.0], 60.0)
    assert worlds.speeds_mps.tolist() == [[limit, limit]] and worlds.gaps_m.tolist() == [[0.0]]


@pytest.mark.parametrize(("gap", "sound"), [(-1.5e-9, True), (-2e-9, True), (-2.000001e-9, False), (-2.5e-9, False)])
def test_overlap__at_an_event_is_rounding_up_to_1e_9_m_and_a_defect_beyond(gap, sound):
    # vehicle 1 leaves vehicle 2 with 1e-9 m/s; vehicle 3 meets them after 1 s, when 1e-9 m of the overlap are gone
    worlds = replace(line([0.0, 8.0], [1e-9, 0.0, 8.0]), gaps_m=np.array([[gap, 8.0]]))
    if sound:
        after, impacts = advance(worlds, 0.0, 1.0)
        assert impacts.count.tolist() == [[0, 1]] and (after.gaps_m == 0.0).all()
    else:
        with pytest.raises(PhysicsError, match=r"world 0: a contact was missed between 0 s and 1 s"):
            advance(worlds, 0.0, 1.0)
