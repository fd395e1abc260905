"""Three vehicles from event to event, and their honest cost: a fast simulator that shares nothing with the package.

The front vehicle (0) brakes fully, the rear one (2) coasts up to its onset and then brakes fully, and the one between
them (1) follows one command per decision. Places are absolute. Pooling is done by the min-max formula.
"""

from __future__ import annotations

from math import inf, sqrt

import numba
import numpy as np

TOUCH_MPS, PLASTIC_MPS, PRICE = 1e-5, 0.05, 10.0

# a world: gaps (m), speeds (m/s), capacities (m/s2), onset of the rear brakes (s), masses (t), restitution
GAP_0, GAP_1, V_0, V_1, V_2, A_0, A_1, DRIVE, LIMIT, A_2, ONSET, M_0, M_1, M_2, BOUNCE = range(15)
COLUMNS = 15
# a record: cost without the prices of driving and of motion at the end, honest cost; first contact: pair (-1: none,
# 2: both), time, closing speed; contact of the other pair: time (infinite: none), closing speed, push of the first
# pair before it; largest violation of the lemma on the neighbour's speed (m/s), and of the one on its place (m); speed
# driven before the first contact, and between both contacts; if the first contact is a touch, change of the closing
# speed by the first impact of its pair before the second contact
CORE, COST, FIRST, TIME, CLOSING, TIME_2, CLOSING_2, PUSH, EXCESS_MPS, EXCESS_M, DROVE, DROVE_2, GAINED = range(13)
RECORD = 13


@numba.njit(cache=True)
def settled(low, high):
    return low if low > 0.0 else high if high < 0.0 else 0.0


@numba.njit(cache=True)
def mean(mass, low, high, i, j):
    """Value of the vehicles i to j as one."""
    total, below, above = 0.0, 0.0, 0.0
    for k in range(i, j + 1):
        total += mass[k]
        below += mass[k] * low[k]
        above += mass[k] * high[k]
    return settled(below / total, above / total)


@numba.njit(cache=True)
def pooled(mass, low, high, first, last, out):
    """Regression over the vehicles ``first`` to ``last``: min over i <= k of max over j >= k of the means."""
    for k in range(first, last + 1):
        out[k] = inf
        for i in range(first, k + 1):
            most = -inf
            for j in range(k, last + 1):
                most = max(most, mean(mass, low, high, i, j))
            out[k] = min(out[k], most)


@numba.njit(cache=True)
def struck(mass, v, bounce, first, last, out):
    """Speeds after an impact of the vehicles ``first`` to ``last`` alone."""
    largest = 0.0
    for p in range(first, last):
        largest = max(largest, v[p + 1] - v[p])
    e = bounce if largest >= PLASTIC_MPS else 0.0
    pooled(mass, v, v, first, last, out)
    for k in range(first, last + 1):
        if largest <= 0.0:
            out[k] = v[k]
        elif e > 0.0:
            out[k] = (1.0 + e) * out[k] - e * v[k]


@numba.njit(cache=True)
def run(world, commands, step, horizon, out):  # noqa: C901
    """Play ``commands`` [K] (the last one stays) up to ``horizon``, and fill the record ``out`` [RECORD]."""
    mass, bounce = world[M_0 : M_2 + 1].copy(), world[BOUNCE]
    v = world[V_0 : V_2 + 1].copy()
    g, x = np.array([world[GAP_0], world[GAP_1]]), np.array([0.0, 0.0, 0.0])
    hit, thrown = np.zeros(2, np.bool_), np.zeros(2)
    low, high, a, new, side = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    joined, closing, meets = np.zeros(2, np.bool_), np.zeros(2), np.zeros(2)
    harm, push, drove, now = 0.0, np.zeros(2), 0.0, 0.0
    out[:] = 0.0
    out[FIRST], out[TIME_2] = -1.0, inf
    touched = np.zeros(2, np.bool_)
    start_v, start_x, start_t, kick = 0.0, 0.0, 0.0, 0.0  # of the neighbour at the first contact
    for _ in range(100000):
        # impacts of all that touch
        while True:
            any_closes = False
            for p in range(2):
                closing[p] = v[p + 1] - v[p] if g[p] == 0.0 else 0.0
                if g[p] == 0.0:
                    if closing[p] <= 0.0:
                        thrown[p] = 0.0
                    any_closes = any_closes or closing[p] > 0.0
            for p in range(2):  # contacts of the record
                if g[p] == 0.0 and not touched[p]:
                    touched[p] = True
                    w = max(v[p + 1] - v[p], 0.0)
                    if out[FIRST] < 0.0:
                        both = g[1 - p] == 0.0
                        touched[1 - p] = both
                        out[FIRST], out[TIME], out[CLOSING] = (2.0 if both else float(p)), now, w
                        out[CLOSING_2] = max(v[2] - v[1], 0.0) if both else 0.0
                        i = 0 if p == 0 else 2
                        start_v, start_x, start_t = v[i], x[i], now
                        share = mass[i] / (mass[i] + mass[1])
                        kick = (1.0 - share) * (1.0 + bounce) * w
                    elif out[FIRST] < 2.0:
                        out[TIME_2], out[CLOSING_2], out[PUSH] = now, w, push[1 - p]
            if not any_closes:
                break
            both = g[0] == 0.0 and g[1] == 0.0
            before = v.copy()
            if both:
                struck(mass, before, bounce, 0, 2, v)
                for p in range(2):
                    struck(mass, before, bounce, 0, p, new)
                    front = new[p]
                    struck(mass, before, bounce, p + 1, 2, new)
                    taken = new[p + 1] - front
                    own = max(closing[p], 0.0)
                    if taken > max(own, TOUCH_MPS):
                        harm += taken * taken - own * own
                if max(closing[0], closing[1]) < PLASTIC_MPS or bounce == 0.0:
                    for p in range(2):
                        v[p + 1] = min(v[p + 1], v[p])
                        if abs(v[p + 1] - v[p]) < 1e-13:
                            v[p + 1] = v[p]
            elif g[0] == 0.0:
                struck(mass, before, bounce, 0, 1, v)
            else:
                struck(mass, before, bounce, 1, 2, v)
            for p in range(2):
                if v[p + 1] > v[p] and v[p + 1] - v[p] < 1e-13:
                    v[p + 1] = v[p]
                change = (before[p + 1] - before[p]) - (v[p + 1] - v[p])
                if hit[p]:
                    if g[p] == 0.0 and closing[p] > max(TOUCH_MPS, thrown[p]):
                        push[p] += change * min((closing[p] - thrown[p]) / closing[p], 1.0)
                    thrown[p] -= change
                alone = out[FIRST] == p and out[TIME_2] == inf and out[CLOSING] <= TOUCH_MPS
                if alone and g[p] == 0.0 and closing[p] > TOUCH_MPS and not hit[p]:
                    out[GAINED] = change
                if g[p] == 0.0 and closing[p] > TOUCH_MPS:
                    harm += closing[p] * closing[p]
                    hit[p] = True
        if out[FIRST] >= 0.0 and out[FIRST] < 2.0 and out[TIME_2] == inf:  # the lemmas on the neighbour
            first = int(out[FIRST])
            i = 0 if first == 0 else 2
            free = 4e-5 * ((now - start_t) / step + 2.0)
            share = mass[i] / (mass[i] + mass[1])
            gain = (1.0 - share) * (push[first] + out[GAINED] + free)
            if i == 0:
                if world[DRIVE] > 0.0 and start_v + kick + gain >= world[LIMIT]:
                    gain = push[0] + out[GAINED] + free
                speed = max(start_v + kick - world[A_0] * (now - start_t), 0.0) + gain
                top = start_v + kick + gain
                t = min(now - start_t, top / world[A_0])
                place = start_x + top * t - 0.5 * world[A_0] * t * t
                out[EXCESS_MPS] = max(out[EXCESS_MPS], v[0] - speed)
                out[EXCESS_M] = max(out[EXCESS_M], x[0] - place)
            elif world[M_2] >= bounce * world[M_1]:
                top, onset = max(start_v - kick - gain, 0.0), max(world[ONSET] - start_t, 0.0)
                coast = min(onset, now - start_t)
                t = min(now - start_t - coast, top / world[A_2])
                out[EXCESS_MPS] = max(out[EXCESS_MPS], top - world[A_2] * t - v[2])
                out[EXCESS_M] = max(out[EXCESS_M], start_x + top * coast + top * t - 0.5 * world[A_2] * t * t - x[2])
        if now >= horizon:
            break
        # forces and accelerations
        k = min(int(now / step + 1e-9), len(commands) - 1)
        end = min((int(now / step + 1e-9) + 1) * step, horizon)
        rear = -world[A_2] if now >= world[ONSET] else 0.0
        if now < world[ONSET]:
            end = min(end, world[ONSET])
        for i in range(3):
            u = -world[A_0] if i == 0 else commands[k] if i == 1 else rear
            if u < 0.0:
                low[i] = u if v[i] >= 0.0 else -u
                high[i] = -u if v[i] <= 0.0 else u
            elif u > 0.0 and i == 1 and v[1] >= world[LIMIT]:
                low[i], high[i] = 0.0, (u if v[1] == world[LIMIT] else 0.0)
            else:
                low[i], high[i] = u, u
        rest = np.array([g[0] == 0.0 and v[0] == v[1], g[1] == 0.0 and v[1] == v[2]])
        if rest[0] and rest[1]:
            pooled(mass, low, high, 0, 2, a)
        elif rest[0]:
            pooled(mass, low, high, 0, 1, a)
            a[2] = settled(low[2], high[2])
        elif rest[1]:
            pooled(mass, low, high, 1, 2, a)
            a[0] = settled(low[0], high[0])
        else:
            for i in range(3):
                a[i] = settled(low[i], high[i])
        for p in range(2):
            joined[p] = rest[p] and abs(a[p] - a[p + 1]) < 1e-12
            if joined[p]:
                a[p + 1] = a[p]
        if joined[0]:
            a[1] = a[0]
        if joined[1]:
            a[2] = a[1]
        # the next event
        goal = 0
        wait = end - now
        for i in range(3):
            t = -v[i] / a[i] if v[i] * a[i] < 0.0 else inf
            if t < wait:
                wait, goal = t, 10 + i
        if commands[k] > 0.0 and a[1] > 0.0 and v[1] < world[LIMIT] and (world[LIMIT] - v[1]) / a[1] < wait:
            wait, goal = (world[LIMIT] - v[1]) / a[1], 20
        if commands[k] > 0.0 and a[1] < 0.0 and v[1] > world[LIMIT] and (world[LIMIT] - v[1]) / a[1] < wait:
            wait, goal = (world[LIMIT] - v[1]) / a[1], 20
        for p in range(2):
            meets[p] = inf
            if not joined[p]:
                w, b = v[p + 1] - v[p], a[p + 1] - a[p]
                square = w * w + 2.0 * b * g[p]
                if w > 0.0 and square >= 0.0:
                    meets[p] = 2.0 * g[p] / (w + sqrt(square))
                elif w <= 0.0 and b > 0.0:
                    meets[p] = (sqrt(square) - w) / b
            wait = min(wait, meets[p])
        # push, driving and motion
        for p in range(2):
            if joined[p]:
                first = 0 if joined[0] else 1
                last = 2 if joined[1] else 1
                # just after this moment: where a block at rest begins to move, brakes act backward
                for i in range(3):
                    side[i] = low[i] if a[p] > 0.0 and v[i] == 0.0 else high[i]
                if a[p] != 0.0 and v[p] != 0.0:
                    for i in range(3):
                        u = -world[A_0] if i == 0 else commands[k] if i == 1 else rear
                        if i == 1 and u > 0.0 and v[1] == world[LIMIT] and a[1] < 0.0:
                            low[i] = u
                most, least = -inf, inf
                for j in range(p + 1, last + 1):
                    most = max(most, mean(mass, low, side, p + 1, j))
                for j in range(first, p + 1):
                    least = min(least, mean(mass, low, side, j, p))
                push[p] += max(most - least, 0.0) * wait
        drove += max(commands[k], 0.0) * wait
        if out[FIRST] < 0.0:
            out[DROVE] = drove
        elif out[TIME_2] == inf:
            out[DROVE_2] = drove - out[DROVE]
        for i in range(3):
            x[i] += (v[i] + 0.5 * a[i] * wait) * wait
        for p in range(2):
            if meets[p] <= wait:
                g[p] = 0.0
            elif not joined[p]:
                g[p] = max(g[p] - (v[p + 1] - v[p] + 0.5 * (a[p + 1] - a[p]) * wait) * wait, 0.0)
        for i in range(3):
            v[i] += a[i] * wait
        for i in range(3):
            if abs(v[i]) < 1e-12:
                v[i] = 0.0
        if goal == 20 and abs(v[1] - world[LIMIT]) < 1e-11:
            v[1] = world[LIMIT]
        for p in range(2):
            if joined[p]:
                v[p + 1] = v[p]
        if joined[0] and joined[1]:
            v[2] = v[1] = v[0]
        now += wait
    if out[FIRST] == 2.0 or out[TIME_2] == inf:
        out[DROVE_2] = 0.0
        if out[FIRST] in (0.0, 1.0):
            out[PUSH] = push[int(out[FIRST])]
    out[CORE] = harm + PRICE * (push[0] + push[1])
    out[COST] = out[CORE] + PRICE * drove + v[1] * v[1] + v[2] * v[2] + v[0] * v[0]


@numba.njit(cache=True)
def braked_way(v, a, t):
    """Way of a vehicle that brakes to rest."""
    t = min(t, v / a)
    return (v - 0.5 * a * t) * t


@numba.njit(cache=True)
def free_motion(world, i, t):
    """Place and speed of the front (0) or rear (2) vehicle at t if nothing touches it."""
    if i == 0:
        return world[GAP_0] + braked_way(world[V_0], world[A_0], t), max(world[V_0] - world[A_0] * t, 0.0)
    coast = min(t, world[ONSET])
    late = t - coast
    place = world[V_2] * coast + braked_way(world[V_2], world[A_2], late) - world[GAP_1]
    return place, max(world[V_2] - world[A_2] * late, 0.0)


@numba.njit(cache=True)
def claim(world, record, step):  # noqa: C901
    """What the theorem says of a run with this record: least cost, and spare way (m, at least 0) of vehicle 1.

    Infinite spare way: the theorem says nothing about this run.
    """
    e, mf = world[BOUNCE], world[M_1]
    nu, mu = world[M_0] / (world[M_0] + mf), world[M_2] / (world[M_2] + mf)
    kappa, lam = mu * (1.0 + e), nu * (1.0 + e)
    T, w, t2, w2, P = record[TIME], record[CLOSING], record[TIME_2], record[CLOSING_2], record[PUSH]
    x0, v0 = free_motion(world, 0, T)
    x2, v2 = free_motion(world, 2, T)
    if record[FIRST] == 2.0:
        w2 = record[CLOSING_2]
        k = kappa if w2 >= PLASTIC_MPS else mu
        j = lam if w >= PLASTIC_MPS else nu
        return (w + k * w2) ** 2 + (w2 + j * w) ** 2, inf
    if record[FIRST] < 0.0:
        return 0.0, inf
    ew = e if w >= PLASTIC_MPS else 0.0
    e2 = e if w2 >= PLASTIC_MPS else 0.0
    free = 4e-5 * ((t2 - T) / step + 2.0)
    touched = w <= TOUCH_MPS
    Q = P + record[GAINED]  # priced, except for one impact after a touch
    first = w * w + PRICE * P
    if touched:
        most = 5.0 * (1.0 + e) ** 2
        first = (Q / (1.0 + e)) ** 2 if most >= Q else PRICE * Q - 25.0 * (1.0 + e) ** 2
    if t2 == inf:
        return w * w, inf
    tau = t2 - T
    if record[FIRST] == 0.0:
        if lam > 1.0 or world[A_1] < world[A_2]:
            return w * w, inf
        gain = (1.0 - nu) * (Q + free)
        if world[DRIVE] > 0.0 and v0 + (1.0 - nu) * (1.0 + ew) * w + gain >= world[LIMIT]:
            gain = Q + free
        kick = (1.0 - nu) * (1.0 + ew) * w
        start = v0 + w - nu * (1.0 + ew) * w - nu * (Q + free)
        xr, vr = free_motion(world, 2, t2)
        s = vr - w2
        # least way: brake, then drive, at least at rest
        least = 0.0
        a, u = world[A_1], world[DRIVE]
        x = (start - s + u * tau) / (a + u)
        x = min(max(x, 0.0), tau)
        low = start - a * x
        if low >= 0.0:
            least = start * x - 0.5 * a * x * x + s * (tau - x) - 0.5 * u * (tau - x) ** 2
        else:
            least = max(start, 0.0) ** 2 / (2.0 * a) + (s * s / (2.0 * u) if u > 0.0 and s < u * tau else 0.0)
        spare = xr - x0 - least
        top = v0 + kick + gain
        place = x0 + braked_way(top, world[A_0], tau)
        spare = min(spare, place - xr)
        third = 0.0
        if world[A_1] >= world[A_0]:
            vf = s + mu * (1.0 + e2) * w2
            # first time at which a braking vehicle 1 reaches the neighbour of the lemma
            g, vh = place - xr, max(top - world[A_0] * tau, 0.0)
            al, af = world[A_0], world[A_1]
            stop_room = g + vh * vh / (2.0 * al)
            D = (vf - vh) ** 2 - 2.0 * (af - al) * g
            met = -1.0
            if vf > vh and D >= 0.0:
                met = 2.0 * g / (vf - vh + sqrt(D))
                if met > vh / al:
                    met = -1.0
            if met < 0.0 and vf * vf > 2.0 * af * stop_room:
                met = (vf - sqrt(vf * vf - 2.0 * af * stop_room)) / af
            if met >= 0.0:
                third = vf - af * met - max(v0 + kick - al * (tau + met), 0.0) - gain
        third = max(third, 0.0)
        e3 = e if third >= PLASTIC_MPS else 0.0
        forced = 0.0 if touched else max(third - mu * (1.0 + e2) * w2, 0.0)
        return first + w2 * w2 + third * third + PRICE * (1.0 + e3) * forced, spare
    if lam > 1.0 or world[M_2] < e * mf or world[A_1] < world[A_0] or world[A_1] < world[A_2]:
        return w * w, inf
    loss = (1.0 - mu) * (Q + free)
    kick = (1.0 - mu) * (1.0 + ew) * w
    start = v2 - w + mu * (1.0 + ew) * w + mu * (Q + free)
    xl, vl = free_motion(world, 0, t2)
    s, a, u = vl + w2, world[A_1], world[DRIVE]
    x = min(max((s - start + a * tau) / (u + a), 0.0), tau)
    most = start * x + 0.5 * u * x * x + s * (tau - x) + 0.5 * a * (tau - x) ** 2
    spare = most - (xl - x2)
    top = max(v2 - kick - loss, 0.0)
    coast = min(tau, max(world[ONSET] - T, 0.0))
    place = x2 + top * coast + braked_way(top, world[A_2], tau - coast)
    spare = min(spare, xl - place)
    slow = start - mu * (Q + free)
    spare = min(spare, xl - (x2 + braked_way(slow, a, tau)))
    # the rear vehicle of the lemma reaches a driving vehicle 1: in small steps of its motion
    vr = max(top - world[A_2] * (tau - coast), 0.0)
    vf = s - nu * (1.0 + e2) * w2
    g, onset, third = xl - place, max(world[ONSET] - t2, 0.0), 0.0
    now = 0.0
    while vr > 0.0 and (vr > vf or now < onset):
        end = onset if now < onset else inf
        reach = now + (world[LIMIT] - vf) / u if u > 0.0 and vf < world[LIMIT] else inf
        end = min(end, reach)
        ar = 0.0 if now < onset else -world[A_2]
        if ar < 0.0:
            end = min(end, now - vr / ar)
        af = u if vf < world[LIMIT] else 0.0
        dw, b = vr - vf, ar - af
        D = dw * dw + 2.0 * b * g
        if dw > 0.0 and D >= 0.0 and now + 2.0 * g / (dw + sqrt(D)) <= end:
            third = sqrt(D)
            break
        if end == inf or dw <= 0.0:
            break
        h = end - now
        g -= (dw + 0.5 * b * h) * h
        vr, vf, now = vr + ar * h, vf + af * h, end
        if end == reach:
            vf = world[LIMIT]
        vr = 0.0 if vr < 1e-12 else vr
    e3 = e if third >= PLASTIC_MPS else 0.0
    forced = 0.0 if touched else max(third - nu * (1.0 + e2) * w2, 0.0)
    return first + w2 * w2 + third * third + PRICE * (1.0 + e3) * forced, spare


@numba.njit(cache=True)
def driving(start, end, duration, way, u, a, ahead):
    """Least speed that vehicle 1 must drive, by trying: from ``start`` to ``end`` in ``duration`` over ``way``.

    ``ahead``: it must be that far, and drives first; otherwise it must not be farther, and drives last.
    """
    low, high = 0.0, u * duration
    for _ in range(40):
        drive = 0.5 * (low + high)
        went = 0.0
        for k in range(400):  # the largest or least speed at each time
            t = (k + 0.5) * duration / 400
            if ahead:
                went += min(start + min(u * t, drive), end + a * (duration - t))
            else:
                went += max(max(start - a * t, 0.0), end - min(u * (duration - t), drive))
        went *= duration / 400
        if went >= way - 2e-4 if ahead else went <= way + 2e-4:
            high = drive
        else:
            low = drive
    return low


@numba.njit(cache=True)
def claimed_driving(world, record, step):
    """What the theorem says of the speed driven before the first contact, and between both."""
    e, mf, T, w = world[BOUNCE], world[M_1], record[TIME], record[CLOSING]
    nu, mu = world[M_0] / (world[M_0] + mf), world[M_2] / (world[M_2] + mf)
    if record[FIRST] < 0.0 or record[FIRST] > 1.0 or nu * (1.0 + e) > 1.0 or world[M_2] < e * mf:
        return 0.0, 0.0
    if world[A_1] < max(world[A_0], world[A_2]):
        return 0.0, 0.0
    i = 0 if record[FIRST] == 0.0 else 2
    x, v = free_motion(world, i, T)
    end = v + w if i == 0 else v - w
    first = driving(world[V_1], end, T, x, world[DRIVE], world[A_1], i == 0) if T > 0.0 else 0.0
    if record[TIME_2] == inf:
        return first, 0.0
    ew = e if w >= PLASTIC_MPS else 0.0
    push = record[PUSH] + record[GAINED] + 4e-5 * ((record[TIME_2] - T) / step + 2.0)
    tau = record[TIME_2] - T
    if i == 0:
        start = v + w - nu * ((1.0 + ew) * w + push)
        x2, v2 = free_motion(world, 2, record[TIME_2])
        end = v2 - record[CLOSING_2]
    else:
        start = v - w + mu * ((1.0 + ew) * w + push)
        x2, v2 = free_motion(world, 0, record[TIME_2])
        end = v2 + record[CLOSING_2]
    return first, driving(start, end, tau, x2 - x, world[DRIVE], world[A_1], i == 2)
