"""Vehicles at moments to rows: who follows whom, checks of gaps and positions against speeds, chains."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.recorded.formats import Format
from ethbrake_marl.extensions.recorded.reading import place_of
from ethbrake_marl.physics.state import Floats
from ethbrake_marl.scenario.fields import QUANTITY

# Allowed ratio of a change (of gaps, of positions) to the change by the speeds (3.28 if units mix feet and metres), and
# the least correlation of the two for the check of gaps.
SLOPE, CORRELATED = (0.5, 2.0), 0.7

FARTHEST_M = QUANTITY.usual["gaps_m"].high  # longest gap that a scenario may have

LEAST_M2 = 100.0  # least sum of squares of ways in a lane, to check positions against speeds: one way of 10 m


class Link(NamedTuple):
    """A vehicle and the gap ahead of it (m), with the speed at which the gap opens (m/s)."""

    gap_m: float
    opens_mps: float
    follower: Any  # its ``State``


class Chains:
    """Cuts the queues of vehicles of one file into chains, and checks the file at its end.

    Args:
        file: the file, for messages.
        entry: its format.
        every_s: time between two moments (s).
        vehicles: number of vehicles in a chain.
        names: name of each vehicle and lane by its number; a number without one is its own name.

    """

    def __init__(self, file: Path, entry: Format, every_s: float, vehicles: int, names: dict[float, str]) -> None:
        self.file, self.entry, self.every_s, self.vehicles, self.names = file, entry, every_s, vehicles, names
        self.left_out = Counter[str]()
        self.longest = 0  # number of vehicles of the longest queue
        self._first_fault, self._faults, self._states = "", 0, 0
        self._gaps = np.zeros(3)  # sums of squares and product: change of gaps, change by the speeds
        self._ways: dict[float, Floats] = defaultdict(lambda: np.zeros(4))  # the same of positions by lane; sum of ways

    def cut(self, moments: Iterator[tuple[float, list[Any]]]) -> Iterator[tuple[list[float], str]]:
        """Yield gaps (m) and speeds (m/s) of each chain, from the front, and its vehicles: ``2-3-4``.

        Queues are cut from the front; a vehicle belongs to at most one chain of a moment. Raises ``InvalidInput`` at
        the end if too many vehicles have a fault, or if gaps or positions do not change as speeds say.
        """
        last, before, before_by_id = math.nan, dict[float, Link](), dict[float, Any]()
        for tick, there in moments:
            by_id = {state.id: state for state in reversed(there)}
            row = tick == round(tick)  # else a moment that only checks
            behind = self._links(there, by_id, row)
            if tick - last == 1.0 or (not row and tick - last < 1.0):
                self._compare(behind, before, by_id, before_by_id, (tick - last) * self.every_s)
            followers = {link.follower.id for link in behind.values()}
            for state in reversed(by_id.values()):
                if state.id in followers or not row:
                    continue
                queue = [Link(0.0, 0.0, state)]
                while queue[-1].follower.id in behind:
                    queue.append(behind[queue[-1].follower.id])
                self.longest = max(self.longest, len(queue))
                yield from self._rows(queue)
            last, before, before_by_id = tick, behind, by_id
        self._check()

    def _rows(self, queue: Sequence[Link]) -> Iterator[tuple[list[float], str]]:
        n = self.vehicles
        for k in range(0, len(queue) - n + 1, n):
            chain = queue[k : k + n]
            row = [link.gap_m for link in chain[1:]] + [link.follower.speed for link in chain]
            yield ([round(number, 3) + 0.0 for number in row], "-".join(self._name(link.follower.id) for link in chain))
        self.left_out["vehicles that were too few, or left over, at the end of a queue"] += len(queue) % n

    def _name(self, number: float) -> str:
        return self.names.get(number) or f"{number:.0f}"

    def _links(self, there: list[Any], by_id: dict[float, Any], row: bool) -> dict[float, Link]:
        """Return by the id of each vehicle the one that follows it, at one moment; count faults.

        Args:
            there: states of all vehicles.
            by_id: the same by id, of a vehicle that is there twice the first.
            row: whether the moment becomes rows; only then what is left out counts.

        """
        behind, in_lane = dict[float, Link](), dict[float, float]()  # in_lane: the vehicle ahead, if no file names it
        if self.entry.by_lane:
            for first, second in pairwise(sorted(there, key=lambda state: (state.lane, -state.front))):
                if first.lane == second.lane and first.id != second.id:
                    in_lane[second.id] = first.id
        for state in there:
            number = in_lane.get(state.id, state.preceding)
            ahead: Any = by_id.get(number) if number >= 0.0 else None
            gap, slowest = _gap(ahead, state) if ahead else math.nan, min(ahead.speed, state.speed) if ahead else 0.0
            noise = gap <= 0.0 and slowest < self.entry.standing_mps
            fault = (
                f"is there at that time in {self._line(by_id[state.id])}, too" if by_id[state.id] is not state
                else f"follows vehicle {self._name(number)}, which is not there" if number >= 0.0 and not ahead
                else f"overlaps vehicle {self._name(ahead.id)} ahead by {-gap:.2f} m"
                if gap <= 0.0 and ahead.lane == state.lane and not noise
                else ""
            )  # fmt: skip
            if fault:
                place = place_of(self.file, state.line)
                self._first_fault = self._first_fault or f"{place}: vehicle {self._name(state.id)} {fault}"
                self._faults += row
            elif noise:
                self.left_out["links of standing cars whose gap was recorded as 0 or less"] += row
            elif ahead and (ahead.lane != state.lane or slowest < 0.0):
                self.left_out["links to another lane, or of a vehicle that rolls backwards"] += row
            elif ahead and gap > FARTHEST_M:
                self.left_out[f"links of more than {FARTHEST_M:,.0f} m"] += row
            elif ahead and gap < (behind[ahead.id].gap_m if ahead.id in behind else math.inf):
                behind[ahead.id] = Link(gap, ahead.speed - state.speed, state)
        self._states += len(there) * row
        return behind

    def _line(self, state: Any) -> str:
        return place_of(self.file, state.line).removeprefix(f"{self.file}, ")

    def _compare(
        self,
        behind: dict[float, Link],
        before: dict[float, Link],
        by_id: dict[float, Any],
        by_id_before: dict[float, Any],
        passed_s: float,
    ) -> None:
        """Add to the sums how gaps and positions changed in ``passed_s`` seconds, and how they should by the speeds."""
        for each in behind.keys() & before.keys():
            now, then = behind[each], before[each]
            if now.follower.id == then.follower.id:
                opened, said = now.gap_m - then.gap_m, (now.opens_mps + then.opens_mps) / 2.0 * passed_s
                self._gaps += opened * opened, said * said, opened * said
        for each in by_id.keys() & by_id_before.keys() if self.entry.by_lane else ():
            now, then = by_id[each], by_id_before[each]
            if now.lane == then.lane:
                moved, said = now.front - then.front, (now.speed + then.speed) / 2.0 * passed_s
                self._ways[now.lane] += moved * moved, said * said, moved * said, said

    def _check(self) -> None:
        file, entry = self.file, self.entry
        for lane, (_, said, product, way) in sorted(self._ways.items()):
            if said >= LEAST_M2 and not (SLOPE[0] < product / said < SLOPE[1] and way > 0.0):
                raise InvalidInput(
                    f"{file}: in lane {self._name(lane)}, front changes {product / said:.2f} times as much as"
                    f" {'speed says' if way > 0.0 else 'a speed below 0 says'}; front must grow along travel (turn its"
                    f" sign for the other direction), speed be above 0, and both in {entry.units}"
                )
        if self._faults > entry.impossible * self._states:
            raise InvalidInput(
                f"{self._first_fault}; {self._faults:,} of {self._states:,} are like that, at most"
                f" {entry.impossible:.0%} may be"
            )
        self.left_out["vehicles that overlap, are there twice, or follow one that is not there"] += self._faults
        opened, said, product = self._gaps.tolist()
        if product > CORRELATED * math.sqrt(opened * said) > 0.0 and not SLOPE[0] < product / said < SLOPE[1]:
            raise InvalidInput(
                f"{file}: gaps change {product / said:.2f} times as much as speeds say (feet beside m/s give 3.28,"
                f" metres beside km/h 0.28); {entry.title} has {entry.units}"
            )


def _gap(ahead: Any, state: Any) -> float:
    """Return the gap from the rear of ``ahead`` to the front of ``state``, along the travel of ``state`` (m)."""
    along = ahead.front - ahead.length * ahead.dx - state.front
    across = ahead.side - ahead.length * ahead.dy - state.side
    return float(along * state.dx + across * state.dy)
