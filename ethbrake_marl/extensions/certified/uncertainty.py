"""Uncertainty: an interval around each uncertain quantity of a world, and the *members* that represent all worlds in
these intervals.

The true value of a quantity with the reported value x lies in [x - h, x + h]. The half-width h is a number in the
quantity's unit, or a share of x (such as 5 %). Impossible values are cut off from the interval of a quantity:
latencies, speeds and gaps below 0, and speeds above the speed limit of the vehicle. The *box* of a world is the set of
all combinations of values in the intervals around the world's quantities. The *members* of a world are the reported
world and every corner of its box: 2^d corners for d uncertain numbers. In shield mode ``robust`` the bound on the harm
is proven for the members (``docs/internals/proofs/shield-corners.md``).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.first_edition.physics.state import Floats, Vehicles, Worlds
from ethbrake_marl.first_edition.scenario.fields import QUANTITY
from ethbrake_marl.first_edition.shields.checks import is_amount

OF_VEHICLES = (  # fields of ``Vehicles``
    "braking_capacity_mps2", "driving_capacity_mps2", "latency_s", "mass_t", "brake_rate_mps3", "release_rate_mps3",
)  # fmt: skip

QUANTITIES = (*OF_VEHICLES, "speeds_mps", "gaps_m", "friction")

POSITIVE = (
    "braking_capacity_mps2",
    "mass_t",
    "friction",
    "brake_rate_mps3",
    "release_rate_mps3",
)  # quantities that must stay above 0

_OF_FRICTION = (
    0.0,
    0.125,
    0.25,
    0.375,
    0.625,
    0.75,
    0.875,
    1.0,
)  # positions in the interval; 0.5 is the reported value

MOST_CORNERS = 1024  # largest number of corners of one world; each takes as much time as the world itself

UNCERTAINTY_EXAMPLE = "braking_capacity_mps2=5%,latency_s=0.1,gaps_m.pair_1=0.5"

_FORM = f"must be quantity=half-width, for instance {UNCERTAINTY_EXAMPLE}"

_ENTRY = re.compile(
    r"(?P<name>\w+)(?:\.(?P<what>vehicle|pair)_(?P<number>[1-9]\d*))?\s*=\s*(?P<width>[^=%\s]+)(?P<share>%?)", re.ASCII
)

_NUMBER = re.compile(r"(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True, slots=True)
class Interval:
    """Interval around one reported quantity, for one vehicle or pair, or for all vehicles or pairs."""

    quantity: str  # one of QUANTITIES
    half_width: float  # in the quantity's unit, or a share of its value below 1
    relative: bool = False  # True: ``half_width`` is a share of the value
    place: int | None = None  # index of the vehicle or pair from 0; None: all of them

    def __post_init__(self) -> None:
        if self.quantity not in QUANTITIES:
            raise unknown_name("uncertain quantity", self.quantity, QUANTITIES)
        most, right = (
            (1.0, "a share from 0 to below 100 %") if self.relative else (np.inf, "a finite number, at least 0")
        )
        if not is_amount(self.half_width, most):
            raise InvalidInput(
                f"uncertainty: half-width of {self.quantity} = {self.half_width!r}: the half-width must be {right}"
            )
        if self.place is not None and not (isinstance(self.place, int | np.integer) and self.place >= 0):
            raise InvalidInput(
                f"uncertainty: {self.quantity}: place = {self.place!r}: must be an index of a vehicle or pair, from 0"
            )
        if self.quantity == "friction" and self.place is not None:
            raise InvalidInput(
                "uncertainty: friction is one number for the whole line; write friction=..., not friction.vehicle_..."
            )

    def __str__(self) -> str:
        kind = "pair" if self.quantity == "gaps_m" else "vehicle"
        where = "" if self.place is None else f".{kind}_{self.place + 1}"
        width = f"{100.0 * self.half_width:g}%" if self.relative else f"{self.half_width:g}"
        return f"{self.quantity}{where}={width}"


_Side = tuple[str, int, Floats, Floats]  # one uncertain number: quantity, index, smallest and largest value [n]


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Intervals around the reported quantities of a world. ``parse_uncertainty`` makes an ``Uncertainty`` from a text.

    Raises ``InvalidInput`` if there is no interval, or if two intervals cover the same quantity of a vehicle or pair.
    """

    intervals: tuple[Interval, ...]  # intervals of the uncertain quantities

    def __post_init__(self) -> None:
        if not isinstance(self.intervals, tuple) or not all(isinstance(each, Interval) for each in self.intervals):
            raise InvalidInput(f"uncertainty: intervals = {self.intervals!r}: must be a tuple of Interval objects")
        if not self.intervals:
            raise InvalidInput(f"uncertainty: no interval; must have at least one, for instance {UNCERTAINTY_EXAMPLE}")
        for k, one in enumerate(self.intervals):
            for other in self.intervals[:k]:
                same = None in (one.place, other.place) or one.place == other.place
                if one.quantity == other.quantity and same:
                    raise InvalidInput(
                        f"uncertainty: {other} and {one} are intervals of the same quantity; give only one"
                    )

    def __str__(self) -> str:
        return ",".join(str(interval) for interval in self.intervals)

    @property
    def moves_together(self) -> bool:
        """True if the friction is uncertain, so that one uncertain number changes several quantities.

        The largest and smallest gaps and speeds may then occur in worlds that are not corners of the box.
        """
        return any(each.quantity == "friction" and each.half_width > 0.0 for each in self.intervals)

    def members(self, worlds: Worlds) -> Worlds:
        """Return the members of worlds at the alert, [n * M]: each world followed by the corners of its box.

        The corners are in the order of binary numbers, with the first interval as the lowest bit (0: smallest value, 1:
        largest value). An interval of width 0 does not increase the number of corners. For friction, eight values
        replace the two ends of the interval, because friction changes all capacities together and harm may rise or fall
        with it. Raises ``InvalidInput`` if an interval names a vehicle that does not exist, if a capacity or mass may
        be 0, or if there are more than ``MOST_CORNERS`` corners.
        """
        sides = self._sides(worlds)
        ends = [_OF_FRICTION if name == "friction" else (0.0, 1.0) for name, *_ in reversed(sides)]
        corners = math.prod(map(len, ends)) if sides else 0
        if corners > MOST_CORNERS:
            raise InvalidInput(
                f"uncertainty: {len(sides)} intervals in each world make {corners} combinations of values (corners),"
                f" but at most {MOST_CORNERS} are allowed; give intervals for fewer vehicles or pairs, as in"
                f" {UNCERTAINTY_EXAMPLE}"
            )
        every = [shares[::-1] for shares in product(*ends)] if sides else []
        parts = [worlds] + [_placed(worlds, sides, shares.__getitem__) for shares in every]
        return self.interleaved(parts)

    @staticmethod
    def interleaved(parts: list[Worlds]) -> Worlds:
        """Merge M batches of n worlds each into one batch [n * M]: world 0 of every batch, then world 1 of every batch,
        and so on.
        """
        order = np.arange(parts[0].n * len(parts)).reshape(len(parts), parts[0].n).T.ravel()
        return Worlds.concatenate(parts).take(order)

    def draw(self, worlds: Worlds, rng: np.random.Generator, *, corners: bool = False) -> Worlds:
        """For each of ``worlds`` [n], draw one world from its box: one of the corners if ``corners`` is True, otherwise
        uniformly from the whole box.
        """
        sides = self._sides(worlds)
        shares = rng.random((len(sides), worlds.n))
        if corners:
            shares = np.round(shares)
        return _placed(worlds, sides, lambda k: shares[k])

    def _sides(self, worlds: Worlds) -> list[_Side]:
        """Return the uncertain numbers of ``worlds``, each as (quantity, index of the vehicle or pair, smallest value
        [n], largest value [n]).
        """
        sides: list[_Side] = []
        for interval in self.intervals:
            every, name = _values(worlds, interval.quantity), interval.quantity
            if interval.half_width == 0.0:
                continue
            if not np.isfinite(every).all():
                raise InvalidInput(
                    f"uncertainty: {interval}: some worlds have no value of {name}; declare {name} in the scenario"
                )
            if interval.place is not None and interval.place >= every.shape[1]:
                raise InvalidInput(
                    f"uncertainty: {interval}: there is no such {'pair' if name == 'gaps_m' else 'vehicle'}, because"
                    f" the line has only {every.shape[1]}"
                )
            for place in range(every.shape[1]) if interval.place is None else (interval.place,):
                values = every[:, place]
                half = interval.half_width * values if interval.relative else np.full(worlds.n, interval.half_width)
                low, high = values - half, values + half
                if name in POSITIVE and not (low > 0.0).all():
                    k = int(np.argmin(low))
                    raise InvalidInput(
                        f"uncertainty: {interval}: the value {values[k]:g}{_of(name, place)} in world {k} may"
                        f" be as low as {low[k]:g}; must be above 0: use a smaller half-width"
                    )
                most = worlds.vehicles.speed_limit_mps[:, place] if name == "speeds_mps" else np.inf
                high, rule = np.minimum(high, most), QUANTITY.declared[name]
                if not (high <= rule.high).all():
                    k = int(np.argmax(high))
                    raise InvalidInput(
                        f"uncertainty: {interval}: the value {values[k]:g}{_of(name, place)} in world {k} may"
                        f" be as high as {high[k]:g}; must be {rule.interval}"
                    )
                sides.append((name, place, np.maximum(low, 0.0), high))
        return sides


def parse_uncertainty(text: str) -> Uncertainty:
    """Make an ``Uncertainty`` from a text of entries ``quantity=half-width``, separated by commas, as in
    ``UNCERTAINTY_EXAMPLE``.

    A half-width is a number in the quantity's unit, or a percentage of the reported value. ``.vehicle_2`` or
    ``.pair_1`` after the quantity limits the entry to one vehicle or pair. Blanks around an entry and around its ``=``
    are ignored. Raises ``InvalidInput`` if ``text`` does not have this form.
    """
    entries = [entry.strip() for entry in text.split(",")]
    if "" in entries:
        raise InvalidInput(f"uncertainty: {text!r}: entry {entries.index('') + 1} is empty; {_FORM}")
    intervals = []
    for entry in entries:
        match = _ENTRY.fullmatch(entry)
        if match is None or _NUMBER.fullmatch(match["width"]) is None:
            raise InvalidInput(f"uncertainty: {entry!r}: {_FORM}")
        name, width = match["name"], float(match["width"])
        if name in QUANTITIES and match["what"] not in (None, "pair" if name == "gaps_m" else "vehicle"):
            raise InvalidInput(
                f"uncertainty: {entry!r}: only gaps_m may name a pair, as in gaps_m.pair_1; other"
                " quantities may name a vehicle, as in mass_t.vehicle_2"
            )
        place = None if match["number"] is None else int(match["number"]) - 1
        intervals.append(Interval(name, width / 100.0 if match["share"] else width, bool(match["share"]), place))
    return Uncertainty(tuple(intervals))


def _values(worlds: Worlds, quantity: str) -> Floats:
    """Return the reported values of ``quantity``, one of ``QUANTITIES``: [n, P] for gaps, [n, 1] for friction,
    otherwise [n, N].

    Capacities are those on a dry road.
    """
    if quantity.endswith("_rate_mps3"):
        return np.asarray(getattr(worlds.vehicles, quantity), np.float64)
    return QUANTITY.declared[quantity].of(worlds)


def _of(quantity: str, place: int) -> str:
    owner = QUANTITY.declared[quantity].owner(place)
    return f" of {owner}" if owner else ""


def _placed(worlds: Worlds, sides: list[_Side], share: Callable[[int], Floats | float]) -> Worlds:
    """Return the reported worlds, changed so that each uncertain number has a given position in its interval.

    Without a V2X channel, a changed latency changes both the time at which the vehicle reacts and the time at which a
    message arrives. With a V2X channel, a changed latency changes only the time at which the vehicle reacts. An
    uncertain friction limits the capacities of all vehicles together.

    ``share`` maps the index of an uncertain number in ``sides`` to the position of this number in its interval; a
    position is one number for all worlds, or [n]; 0 is the smallest value, 1 the largest.
    """
    changed: dict[str, Any] = {}
    for k, (quantity, place, low, high) in enumerate(sides):
        values = changed.setdefault(quantity, _values(worlds, quantity).copy())
        at = np.broadcast_to(np.asarray(share(k), np.float64), low.shape)
        values[:, place] = np.where(at == 0.0, low, np.where(at == 1.0, high, low + at * (high - low)))
    if "latency_s" in changed and worlds.vehicles.is_known_at_once:
        latency = changed["latency_s"]
        changed |= {"own_latency_s": latency, "known_from_s": Vehicles.known_at_once(latency)}
    friction = changed.pop("friction", worlds.friction[:, np.newaxis])[:, 0]
    vehicles = replace(worlds.vehicles, **{name: v for name, v in changed.items() if hasattr(worlds.vehicles, name)})
    placed = replace(worlds, vehicles=vehicles, **{name: v for name, v in changed.items() if hasattr(worlds, name)})
    if not worlds.road.shape[1]:
        return placed
    return placed.on_road(friction, {name: v for name, v in changed.items() if name.endswith("capacity_mps2")})
