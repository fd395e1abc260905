"""Time of a pair's next contact. Between two events the gap is a polynomial of time, so the result is exact.

With the gap g, the closing speed w (``closing``), the closing acceleration b (``pressing``) and the closing jerk j
(``jerk``; rear minus front, in m, m/s, m/s2 and m/s3), the gap after the time t is ``g - w t - b t^2 / 2 - j t^3 / 6``.
If brakes act at once, j is 0.
"""

from __future__ import annotations

import math

from ethbrake_marl.motion.compiling import kernel, part


@kernel
def gap_after(gap, closing, pressing, jerk, time):
    """Gap of a pair (m) after ``time`` (s); formula: module docstring."""
    return gap - (closing + 0.5 * (pressing + jerk * time / 3.0) * time) * time


@kernel
def contact(gap, closing, pressing):
    """Time (s) and closing speed (m/s) of a pair's first contact at jerk 0; ``(inf, 0)`` if there is none.

    Let g = ``gap`` (m), w = ``closing`` (m/s), b = ``pressing`` (m/s2) and ``D = w^2 + 2 b g``. If ``w > 0``, there is
    no contact for ``D < 0``, otherwise a contact at ``t = 2 g / (w + sqrt(D))``. If ``w <= 0``, there is a contact only
    for ``b > 0``, at ``t = (sqrt(D) - w) / b``. The closing speed is computed as ``sqrt(D)``; ``w + b t``, which is
    equal, loses digits by cancellation.
    """
    if closing > 0.0:
        squared = closing * closing + 2.0 * pressing * gap
        if squared < 0.0:
            return math.inf, 0.0
        speed = math.sqrt(squared)
        return 2.0 * gap / (closing + speed), speed
    if pressing > 0.0:
        speed = math.sqrt(closing * closing + 2.0 * pressing * gap)
        return (speed - closing) / pressing, speed
    return math.inf, 0.0


@part
def contact_on_cubic(gap, closing, pressing, jerk, end):
    """Time (s) and closing speed (m/s) of a pair's first contact before ``end`` (s); ``(inf, 0)`` if there is none.

    With w = ``closing`` (m/s), b = ``pressing`` (m/s2) and j = ``jerk`` (m/s3), the closing speed ``w + b t + j t^2 /
    2`` has at most two roots. They divide the time into parts with a monotone gap. The contact is in the first part
    that ends with a gap of at most 0. Newton's method finds it there, with a bisection where a step would leave the
    part. The closed formula for the roots of a cubic would lose digits by cancellation.
    """
    first, second = -math.inf, -math.inf
    squared = pressing * pressing - 2.0 * jerk * closing
    if squared > 0.0:
        root = math.sqrt(squared)
        numerator = -(pressing + root) if pressing >= 0.0 else root - pressing
        far_root, near_root = numerator / jerk, 2.0 * closing / numerator
        first, second = min(far_root, near_root), max(far_root, near_root)
    elif jerk < 0.0:
        return math.inf, 0.0
    for stretch in range(2):
        if jerk > 0.0:  # the gap closes up to the first root, and from the second one on
            low, high = (0.0, min(first, end)) if stretch == 0 else (max(second, 0.0), end)
        else:
            low, high = (max(first, 0.0), min(second, end)) if stretch == 0 else (0.0, 0.0)
        if not low < high or gap_after(gap, closing, pressing, jerk, high) > 0.0:
            continue
        time = low
        for _ in range(200):
            beyond = gap_after(gap, closing, pressing, jerk, time)
            if beyond > 0.0:
                low = time
            else:
                high = time
            speed = closing + (pressing + 0.5 * jerk * time) * time
            after = time + beyond / speed if speed > 0.0 else math.inf
            if not low < after < high:
                after = 0.5 * (low + high)
                if after <= low or after >= high:
                    break
            if after == time:
                break
            time = after
        return time, max(closing + (pressing + 0.5 * jerk * time) * time, 0.0)
    return math.inf, 0.0


@kernel
def first_return(value, rate, jerk):
    """First t > 0 (s) at which ``value + rate t + jerk t^2 / 2`` is 0; infinite if there is none.

    If ``value``, the value at t = 0, is 0, the result is the next zero.
    """
    if value == 0.0:
        return -2.0 * rate / jerk if rate * jerk < 0.0 else math.inf
    if jerk == 0.0:
        return -value / rate if value * rate < 0.0 else math.inf
    squared = rate * rate - 2.0 * jerk * value
    if squared < 0.0:
        return math.inf
    root = math.sqrt(squared)
    numerator = -(rate + root) if rate >= 0.0 else root - rate
    early, late = numerator / jerk, 2.0 * value / numerator if numerator != 0.0 else numerator / jerk
    if early <= 0.0 or 0.0 < late < early:
        early = late
    return early if early > 0.0 else math.inf
