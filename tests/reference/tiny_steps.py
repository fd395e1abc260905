"""A slow reference for the physics: tiny implicit steps, nothing shared with the package.

It is written from the model alone, on purpose by other means than an event-driven kernel:

* **Motion and contact** are one implicit (Moreau) time step. With ``f`` the potential of a vehicle's own force per mass
  (braking at a: ``a |v|``; driving at u: ``-u min(v, v_max)``; coasting: 0), the speeds after a step h minimise

      sum_k  m_k / 2 (v_k - v_k_old)^2 + h m_k f_k(v_k)      so that  v_i >= v_{i+1} for every resting pair.

  Standstill, the holding brake, brakes after a bounce-back, the speed limit, pushing and release all follow from this
  one convex problem: the kink of ``a |v|`` at 0 *is* the holding brake. It is solved by the min-max formula. Gaps
  follow by the trapezoidal rule, which is exact while the force is constant (else off by at most a h^2 / 8).
* **Pressing is not an impact.** Touching vehicles that do not separate enter the step as a constraint, so pressing
  never creates a closing speed; an impact needs a gap that was open, or a separation, before.
* **Contact**: a step in which a gap closes (also one that dips and reopens) is cut by bisection at the first contact.
  A vehicle caught between two others exchanges impacts ever faster, its gaps fall to 1e-100 m while it still moves at
  m/s: absolute positions would lose up to 8 m2/s2 of harm there, so gaps are kept.
* **Impact**: v+ = (1 + e) P(v-) - e v- over the touching run, P the mass-weighted decreasing regression, again by the
  min-max formula, repeated while a pair still approaches. Closing speeds up to 1e-5 m/s are a touch: no harm, e = 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ethbrake_marl.physics.compiling import compiled

Floats = NDArray[np.float64]

TOUCH_MPS = 1e-5  # closing speeds up to this are a touch
PLASTIC_MPS = 0.05  # below this largest closing speed of a cluster nothing bounces
ONSET_S = 1e-12  # rounding of the accumulated time
CONTACT_SHARE = 1e-14  # relative width to which the time of a contact is bisected

# One array per world, car[quantity, vehicle]: numba counts references for every array passed to every call.
# GAP[p] lies behind vehicle p; its last entry is unused.
GAP, V, WANTED, COMMAND, LATENCY, MASS, LIMIT, NEW_GAP, GAIN, POOLED = range(10)
FIRST, TOTAL, COUNT = range(3)  # harm[quantity, pair]


class Outcome(NamedTuple):
    """What the reference found; [n, P] by pair, [n, N] by vehicle, [n] by world."""

    first_impact_harm: Floats  # [n, P] closing speed squared of each pair's first impact
    total_harm: Floats  # [n, P] the same, summed over all impacts
    count: NDArray[np.int64]  # [n, P] impacts
    gaps_m: Floats  # [n, P] at the horizon
    speeds_mps: Floats  # [n, N] at the horizon
    driven_impulse: Floats  # [n] t m/s that brakes and motors gave between impacts
    momentum_error: Floats  # [n] t m/s, largest change of total momentum in any one impact


def simulate(
    gaps_m: ArrayLike,
    speeds_mps: ArrayLike,
    command_mps2: ArrayLike,
    *,
    latency_s: ArrayLike = 0.0,
    mass_t: ArrayLike = 1.0,
    speed_limit_mps: ArrayLike = 1e9,
    restitution: ArrayLike = 0.0,
    horizon_s: ArrayLike = 8.0,
    step_s: float = 1e-4,
) -> Outcome:
    """Run ``n`` worlds under constant commands from t = 0 to their horizons; parameters broadcast to [n, N] or [n]."""
    speeds = np.array(np.atleast_2d(np.asarray(speeds_mps, dtype=np.float64)))
    n, N = speeds.shape
    cars = np.zeros((n, 10, N))
    cars[:, GAP, :-1] = gaps_m
    cars[:, V], cars[:, WANTED], cars[:, LATENCY] = speeds, command_mps2, latency_s
    cars[:, MASS], cars[:, LIMIT] = mass_t, speed_limit_mps
    e, horizon = (np.broadcast_to(np.asarray(given, dtype=np.float64), (n,)) for given in (restitution, horizon_s))
    harm = np.zeros((n, 3, N - 1))
    driven, error = np.zeros(n), np.zeros(n)
    for k in range(n):
        driven[k], error[k] = _run(cars[k], harm[k], e[k], horizon[k], step_s)
    first, total, count = harm[:, FIRST], harm[:, TOTAL], harm[:, COUNT].astype(np.int64)
    return Outcome(first, total, count, cars[:, GAP, :-1], cars[:, V], driven, error)


@compiled(apart=True)
def _run(car, harm, e, horizon, step):  # type: ignore[no-untyped-def]
    """One world, in place; returns (impulse of brakes and motors, largest momentum error of an impact)."""
    N = car.shape[1]
    time, driven, error = 0.0, 0.0, _collide(car, harm, e)
    while time < horizon - ONSET_S:
        h, moving = min(step, horizon - time), False
        for k in range(N):
            if time >= car[LATENCY, k] - ONSET_S:
                car[COMMAND, k] = car[WANTED, k]
            else:
                moving = True
                h = min(h, car[LATENCY, k] - time)
        h = _step_up_to_contact(h, car)
        for k in range(N):
            driven += car[MASS, k] * car[GAIN, k]
            moving = moving or car[V, k] != 0.0 or car[GAIN, k] != 0.0
            car[GAP, k] = car[NEW_GAP, k]
            car[V, k] += car[GAIN, k]
        error = max(error, _collide(car, harm, e))
        time += h
        if not moving:
            break
    return driven, error


@compiled(apart=True)
def _rests(car, p):  # type: ignore[no-untyped-def]
    """Whether the vehicles of pair p touch and do not separate."""
    return car[GAP, p] == 0.0 and car[V, p] - car[V, p + 1] <= TOUCH_MPS


@compiled(apart=True)
def _step_up_to_contact(h, car):  # type: ignore[no-untyped-def]
    """Step by h, or only to the first contact in it; fills NEW_GAP and GAIN and returns the step taken."""
    _step(h, car)
    low, high = 0.0, _meeting(h, car)
    if high < 0.0:
        return h
    middle = 0.5 * high
    while high - low > CONTACT_SHARE * high and low < middle < high:
        _step(middle, car)
        if _meeting(middle, car) < 0.0:
            low = middle
        else:
            high = middle
        middle = 0.5 * (low + high)
    _step(high, car)
    return high


@compiled(apart=True)
def _meeting(h, car):  # type: ignore[no-untyped-def]
    """Return a time in (0, h] at which some open pair has met (gap <= 0), or -1."""
    meets = -1.0
    for p in range(car.shape[1] - 1):
        if _rests(car, p):
            continue
        if car[NEW_GAP, p] <= 0.0 and car[NEW_GAP, p] < car[GAP, p]:  # not: opens by less than a number can hold
            meets = h
            continue
        closing, lost = car[V, p + 1] - car[V, p], car[GAIN, p] - car[GAIN, p + 1]
        if 0.0 < closing < lost:  # nearest inside the step: may dip below 0 and reopen
            lowest = h * closing / lost
            if car[GAP, p] - 0.5 * closing * lowest <= 0.0 and meets < 0.0:
                meets = lowest
    return meets


@compiled(apart=True)
def _step(h, car):  # type: ignore[no-untyped-def]
    """Implicit step of all vehicles; runs of resting pairs are solved together."""
    N, head = car.shape[1], 0
    for k in range(N):
        if k + 1 < N and _rests(car, k):
            continue
        if head == k:
            car[GAIN, k] = _alone(h, car[V, k], car[COMMAND, k], car[LIMIT, k])
        else:
            _press(h, car, head, k)
        head = k + 1
    for p in range(N - 1):
        opening = 0.0 if _rests(car, p) else car[V, p] - car[V, p + 1]
        car[NEW_GAP, p] = car[GAP, p] + h * (opening + 0.5 * (car[GAIN, p] - car[GAIN, p + 1]))


@compiled(apart=True)
def _alone(h, v, command, limit):  # type: ignore[no-untyped-def]
    """Gain in speed of a vehicle that nobody touches, in a step h."""
    if command < 0.0:  # soft threshold: to rest from above or from below, and then held
        return -v if abs(v) <= -command * h else np.sign(v) * command * h
    return min(command * h, max(limit - v, 0.0))


@compiled(apart=True)
def _press(h, car, head, tail):  # type: ignore[no-untyped-def]
    """Gains in speed of the touching vehicles head..tail in a step h; they start at one speed."""
    gains = np.zeros((tail + 1 - head, tail + 1 - head))
    for i in range(head, tail + 1):
        for j in range(i, tail + 1):
            gains[i - head, j - head] = _together(h, i, j, car[V, head], car)
    _min_max(gains, car[GAIN, head : tail + 1])


@compiled(apart=True)
def _together(h, i, j, v, car):  # type: ignore[no-untyped-def]
    """Common gain of vehicles i..j from speed v in a step h: to the minimum of their joint convex function.

    Its derivative jumps upward at corners only (0 for a brake, the speed limit for a motor). Either the derivative
    changes sign at a corner, which then is the answer (held, or at the limit), or inside a linear piece.
    """
    impulse, inertia = 0.0, 0.0
    for k in range(i, j + 1):
        inertia += car[MASS, k]
        if car[COMMAND, k] == 0.0:
            continue
        corner = 0.0 if car[COMMAND, k] < 0.0 else car[LIMIT, k]
        above = _derivative(h, i, j, v, corner, True, car)
        if _derivative(h, i, j, v, corner, False, car) <= 0.0 <= above:
            return corner - v
        impulse -= h * car[MASS, k] * _pull(car[COMMAND, k], car[LIMIT, k], corner, above < 0.0)
    return impulse / inertia


@compiled(apart=True)
def _derivative(h, i, j, v, speed, from_above, car):  # type: ignore[no-untyped-def]
    """One-sided derivative at ``speed`` of the joint function of vehicles i..j that come from speed v."""
    total = 0.0
    for k in range(i, j + 1):
        pull = _pull(car[COMMAND, k], car[LIMIT, k], speed, from_above)
        total += car[MASS, k] * (speed - v + h * pull)
    return total


@compiled(apart=True)
def _pull(command, limit, speed, from_above):  # type: ignore[no-untyped-def]
    """One-sided derivative of f: minus the acceleration that a vehicle's own brake or motor gives it there."""
    if command < 0.0:
        return -command if speed > 0.0 or (speed == 0.0 and from_above) else command
    return 0.0 if speed > limit or (speed == limit and from_above) else -command


@compiled(apart=True)
def _min_max(means, out):  # type: ignore[no-untyped-def]
    """Decreasing regression from the means of all runs: out_k = min over i <= k of max over j >= k of means[i, j]."""
    for k in range(out.size):
        out[k] = np.inf
        for i in range(k + 1):
            largest = -np.inf
            for j in range(k, out.size):
                largest = max(largest, means[i, j])
            out[k] = min(out[k], largest)


@compiled(apart=True)
def _collide(car, harm, e):  # type: ignore[no-untyped-def]
    """Set contacts to gap 0 and resolve every touching run; returns the largest change of total momentum."""
    N, error, head, approaching = car.shape[1], 0.0, 0, False
    for k in range(N):
        if k + 1 < N and car[GAP, k] <= 0.0:
            car[GAP, k] = 0.0
            approaching = approaching or car[V, k + 1] > car[V, k]
            continue
        if approaching:
            before = _momentum(car)
            _impact(car, head, k, harm, e)
            error = max(error, abs(_momentum(car) - before))
        head, approaching = k + 1, False
    return error


@compiled(apart=True)
def _momentum(car):  # type: ignore[no-untyped-def]
    """Momentum of the whole line."""
    total = 0.0
    for k in range(car.shape[1]):
        total += car[MASS, k] * car[V, k]
    return total


@compiled(apart=True)
def _impact(car, head, tail, harm, e):  # type: ignore[no-untyped-def]
    """Order-free impact of the touching run head..tail, in place; in each round every approaching pair bears harm."""
    while True:
        fastest = _count_harm(car, head, tail, harm)
        bounce = e if fastest >= PLASTIC_MPS else 0.0
        _pool(car, head, tail)
        for k in range(head, tail + 1):
            car[V, k] = (1.0 + bounce) * car[POOLED, k] - bounce * car[V, k]
        if fastest <= TOUCH_MPS:  # a touch, or rounding: that was a projection without harm
            return


@compiled(apart=True)
def _count_harm(car, head, tail, harm):  # type: ignore[no-untyped-def]
    """Book the closing speed squared of every approaching pair; returns the largest closing speed."""
    fastest = 0.0
    for p in range(head, tail):
        closing = car[V, p + 1] - car[V, p]
        fastest = max(fastest, closing)
        if closing > TOUCH_MPS:
            harm[FIRST, p] = closing * closing if harm[COUNT, p] == 0.0 else harm[FIRST, p]
            harm[TOTAL, p] += closing * closing
            harm[COUNT, p] += 1.0
    return fastest


@compiled(apart=True)
def _pool(car, head, tail):  # type: ignore[no-untyped-def]
    """Fill POOLED with the mass-weighted decreasing regression of the speeds of head..tail."""
    means = np.zeros((tail + 1 - head, tail + 1 - head))
    for i in range(head, tail + 1):
        momentum, inertia = 0.0, 0.0
        for j in range(i, tail + 1):
            momentum += car[MASS, j] * car[V, j]
            inertia += car[MASS, j]
            means[i - head, j - head] = momentum / inertia
    _min_max(means, car[POOLED, head : tail + 1])
