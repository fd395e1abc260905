"""Where the combined bound claims nothing, and why: by hand."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.limits import meetings as avoidability_meetings
from ethbrake_marl.limits.avoidability import avoidability
from ethbrake_marl.limits.lower_bound import lower_bound
from ethbrake_marl.limits.meetings import WIDTH, after_rear
from ethbrake_marl.limits.walk import empty_plan
from ethbrake_marl.physics import concatenate
from tests.limits.test_lower_bound import line


def state(**given):
    """A state at the onset, all else 0."""
    at = np.zeros(WIDTH)
    for name, value in given.items():
        at[getattr(avoidability_meetings, name)] = value
    return at


@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")  # 0 * inf, when it runs uncompiled
def test_weak_rear__what_follows_a_later_meeting_is_less_and_nothing_is_claimed():
    # Vehicle 3 coasts at 20 m/s and meets with 12 m/s: both at 14, the leader's speed, 0.8 m behind it. They brake with
    # p = 0.5 * 6 + 0.5 * 1 = 3.5 at most, the leader with 6: at the leader after 0.8 s with 2 m/s, 1 m/s of it certain.
    # Meeting 0.05 s later leaves 0.4925 m and 0.3 m/s: sqrt(0.09 + 5 * 0.4925) m/s after 0.519 s, 0.949 m/s certain.
    at = state(GAP_L=0.4, GAP_R=0.4, V_L=14, A_L=6, V_F=15, A_F=6, V_R=20, A_R=1, ONSET_R=9, REAR_SHARE=0.5)
    now, later = (after_rear(at, time, 12.0, empty_plan(), empty_plan()) for time in (0.0, 0.05))
    assert now == pytest.approx(1.0)
    assert later == pytest.approx((np.sqrt(2.5525) - 1.25 * (np.sqrt(2.5525) - 0.3) / 2.5) ** 2)
    assert later < 0.91
    # The minimum over meetings supposes that it rises. It does while (a_f + p) / 2 >= a_l; here 4.75 < 6.
    weak, strong = (line([10, 1], [0, 20, 40], [6, 6, rear]) for rear in (1, 6))
    assert np.all(avoidability(concatenate([weak, strong])).reason >= 2)
    assert lower_bound(strong).combined[0] > 0
    assert lower_bound(weak, horizon_s=100.0).combined[0] == 0
    assert lower_bound(weak, horizon_s=100.0).harm[0] > 0  # of the pairs
