"""Uncertainty: intervals around the quantities of a world, and the *members* that stand for all worlds in them.

The true value of a quantity with the nominal value x lies in [x - h, x + h], where h is a number in the quantity's
unit, or a share of x. Intervals end at what is possible: latencies, speeds and gaps of 0, and the speed limit. The
*box* of a world is the set of all combinations of values. Its *members* are the nominal world and every corner of the
box: 2^d corners for d uncertain numbers.
"""

from __future__ import annotations

import math
import re
from itertools import product
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.motion.layout import BRAKING, DRIVING, GAP, LATENCY, LIMIT, OWN_LATENCY, SPEED, Floats
from ethbrake_marl.worlds.quantities import CAR_QUANTITIES, QUANTITIES

OF_LINE = {"speeds_mps": SPEED, "gaps_m": GAP}
OF_CAR = {key: row for key, row in CAR_QUANTITIES.items() if key not in ("speed_limit_mps", "restitution")}
UNCERTAIN = (*OF_CAR, *OF_LINE)
MOST_CORNERS = 1024  # of one world; each takes as much time as the world itself
EXAMPLE = "braking_capacity_mps2=5%,latency_s=0.1,gaps_m.pair_1=0.5"
ENTRY = re.compile(
    r"(?P<name>\w+)(?:\.(?P<what>vehicle|pair)_(?P<number>[1-9]\d*))?\s*=\s*(?P<width>[^=%\s]+)(?P<share>%?)", re.ASCII
)
DECIMAL_PATTERN = re.compile(r"(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


class Interval(NamedTuple):
    text: str  # as it was written, such as mass_t.vehicle_2=10%
    quantity: str
    half_width: float  # in the quantity's unit, or a share of its value below 1
    relative: bool = False  # the half-width is a share
    number: int | None = None  # of the vehicle or pair; None: all of them


class Side(NamedTuple):
    """One uncertain quantity of one vehicle or pair, with its interval in each of n worlds."""

    key: str
    body: int  # column in the arrays of a state
    low: Floats  # [n]
    high: Floats  # [n]


class Uncertainty(NamedTuple):
    intervals: tuple[Interval, ...]

    def __str__(self) -> str:
        return ",".join(interval.text for interval in self.intervals)

    def members(self, alert: State) -> State:
        """Possible worlds, M rows for each world of ``alert``: the world itself, then the corners of its box.

        Corner k takes the upper end of uncertain number i where bit i of k is 1. Raises ``InvalidInput`` if an interval
        does not fit the worlds, and for more than ``MOST_CORNERS`` corners.
        """
        sides = self.sides(alert)
        if 2 ** len(sides) > MOST_CORNERS:
            raise InvalidInput(
                f"uncertainty: {len(sides)} intervals in each world make {2 ** len(sides)} combinations of values"
                f" (corners), but at most {MOST_CORNERS} are allowed; give intervals for fewer vehicles or pairs, as in"
                f" {EXAMPLE}"
            )
        corners = product((0.0, 1.0), repeat=len(sides)) if sides else ()
        shares = [np.tile(corner[::-1], (alert.n, 1)) for corner in corners]
        members = State.join([alert, *(worlds_at(alert, sides, share) for share in shares)])
        return members.take(np.arange(members.n).reshape(-1, alert.n).T.ravel())

    def draw(self, alert: State, rng: np.random.Generator, *, corners: bool = False) -> State:
        """One random world for each world of ``alert``: uniform in its box, or one of the box's ``corners``."""
        sides = self.sides(alert)
        shares = rng.random((alert.n, len(sides)))
        return worlds_at(alert, sides, np.round(shares) if corners else shares)

    def sides(self, alert: State) -> list[Side]:
        """Uncertain numbers of the worlds: one for each interval and each vehicle or pair to which it applies.

        Raises ``InvalidInput`` if an interval does not fit the worlds.
        """
        sides = []
        for interval in self.intervals:
            key, rule, bodies = interval.quantity, QUANTITIES[interval.quantity], alert.vehicles
            last = rule.count(bodies)
            if interval.number is not None and interval.number > last:
                raise InvalidInput(
                    f"uncertainty: {interval.text}: there is no such {rule.per}, because the line has {last}"
                )
            for body in range(1, last + 1) if interval.number is None else (interval.number,):
                values, of = values_of(alert, key)[:, body], f" of {rule.owner(body - 1)}"
                half = interval.half_width * (values if interval.relative else 1.0)
                low, high = values - half, values + half
                if key == "speeds_mps":
                    high = np.minimum(high, np.maximum(alert.car[:, LIMIT, body], values))
                good = np.isfinite(values) & ((low > 0.0) | (not rule.positive)) & (high <= rule.high)
                if not good.all():
                    k = int(np.argmin(good))
                    right = rule.interval if np.isfinite(values[k]) else f"finite: declare {key} in the scenario"
                    raise InvalidInput(
                        f"uncertainty: {interval.text}: the value {values[k]:g}{of} in world {k} may be from"
                        f" {low[k]:g} to {high[k]:g}; must be {right}"
                    )
                if interval.half_width > 0.0:
                    sides.append(Side(key, body, low if rule.positive else np.maximum(low, 0.0), high))
        return sides


def values_of(alert: State, key: str) -> Floats:
    """Nominal values of a quantity such as ``gaps_m``, [n, N + 1]. Column 0 and, of gaps, the last have no meaning."""
    return alert.line[:, OF_LINE[key]] if key in OF_LINE else alert.car[:, OF_CAR[key]]


def worlds_at(alert: State, sides: list[Side], shares: Floats) -> State:
    """Worlds in which each of d ``sides`` lies at a share [n, d] of its interval: 0 is the lower end, 1 the upper end.

    A vehicle that brakes fully does so with its new capacity. Without a V2X channel, a vehicle that reacts later also
    learns everything later. Raises ``InvalidInput`` if a script's command exceeds the new capacity.
    """
    line, car, know, wanted = alert.line.copy(), alert.car.copy(), alert.know.copy(), alert.wanted.copy()
    for (key, body, low, high), at in zip(sides, shares.T, strict=True):
        value = np.where(at == 0.0, low, np.where(at == 1.0, high, low + at * (high - low)))
        (line if key in OF_LINE else car)[:, (OF_LINE | OF_CAR)[key], body] = value
    full = alert.wanted == -alert.car[:, BRAKING]
    wanted[full] = -car[:, BRAKING][full]
    if (alert.know[:, 1:, 1:] == alert.car[:, LATENCY, 1:, np.newaxis]).all():
        know[:, 1:, 1:], car[:, OWN_LATENCY] = car[:, LATENCY, 1:, np.newaxis], car[:, LATENCY]
    beyond = (wanted < -car[:, BRAKING]) | (wanted > car[:, DRIVING])
    if beyond[:, 1:].any():
        k, body = np.argwhere(beyond[:, 1:])[0] + [0, 1]
        raise InvalidInput(
            f"uncertainty: vehicle_{body} of world {k} is to accelerate with {wanted[k, body]:g} m/s2, which may be"
            " beyond its capacity; use smaller half-widths, or another script"
        )
    return alert._replace(line=line, car=car, know=know, wanted=wanted)


def parse_uncertainty(text: object) -> Uncertainty:
    """Read intervals ``quantity=half-width``, separated by commas or colons, as in ``EXAMPLE``.

    The ending ``.vehicle_2`` or ``.pair_1`` of the quantity limits the interval to one vehicle or pair.
    """
    form = f"must be quantity=half-width, for instance {EXAMPLE}"
    if not isinstance(text, str):
        raise InvalidInput(f"uncertainty = {text!r:.60}: must be a text, for instance {EXAMPLE!r}")
    intervals: list[Interval] = []
    for entry in (part.strip() for part in re.split("[,:]", text)):
        match = ENTRY.fullmatch(entry)
        if match is None or DECIMAL_PATTERN.fullmatch(match["width"]) is None:
            raise InvalidInput(f"uncertainty: {entry!r}: {form}")
        name, width, share = match["name"], float(match["width"]), bool(match["share"])
        if name not in UNCERTAIN:
            raise unknown_name("uncertain quantity", name, UNCERTAIN)
        if match["what"] not in (None, QUANTITIES[name].per):
            right = "only gaps_m may name a pair; other quantities may name a vehicle, as in mass_t.vehicle_2"
            raise InvalidInput(f"uncertainty: {entry!r}: {right}")
        if not width < (100.0 if share else math.inf):
            raise InvalidInput(f"uncertainty: {entry!r}: must be a finite number, or a share below 100 %")
        number = None if match["number"] is None else int(match["number"])
        new = Interval(entry, name, width / 100.0 if share else width, share, number)
        for interval in intervals:
            if interval.quantity == name and (None in (number, interval.number) or number == interval.number):
                entries = f"{interval.text} and {entry}"
                raise InvalidInput(f"uncertainty: {entries} are intervals of the same quantity; give only one")
        intervals.append(new)
    return Uncertainty(tuple(intervals))
