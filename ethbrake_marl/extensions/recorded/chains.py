"""Form chains of vehicles that follow each other; check that recorded gaps and positions agree with recorded speeds.

A *queue* is a sequence of vehicles, each of which follows the vehicle in front of it, at one moment of a recording. A
queue is cut into *chains* of a fixed number of vehicles. Each chain is one row of gaps and speeds.
"""

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

# Allowed ratio: recorded change of gaps or positions / change that follows from the speeds. It is 3.28 if a file mixes
# feet and metres. Gaps are checked only if the two changes have at least the correlation CORRELATED.
SLOPE, CORRELATED = (0.5, 2.0), 0.7

FARTHEST_M = QUANTITY.usual["gaps_m"].high  # longest gap that a scenario may have

LEAST_M2 = 100.0  # positions are checked if the squared distances driven in a lane sum up to this: one drive of 10 m


class Link(NamedTuple):
    """A vehicle that follows another vehicle, and the gap to the vehicle ahead."""

    gap_m: float  # length of the gap (m)
    opens_mps: float  # speed at which the gap opens (m/s)
    follower: Any  # ``State`` of the vehicle


class Chains:
    """Cuts the queues of vehicles in a recording into chains, and checks that gaps and positions agree with speeds.

    Args:
        file: path of the file, for error messages.
        entry: format of the file.
        every_s: time between two moments at which chains are formed, s.
        vehicles: number of vehicles in a chain.
        names: names of vehicles and lanes for error messages, by number; a number without a name is shown itself.

    """

    def __init__(self, file: Path, entry: Format, every_s: float, vehicles: int, names: dict[float, str]) -> None:
        self.file, self.entry, self.every_s, self.vehicles, self.names = file, entry, every_s, vehicles, names
        self.left_out = Counter[str]()
        self.longest = 0  # number of vehicles in the longest queue
        self._first_fault, self._faults, self._states = "", 0, 0
        # sums over all gaps of a^2, b^2 and a b, for a recorded change a of a gap and the change b by the speeds
        self._gaps = np.zeros(3)
        # the same sums over changes of position, and the sum of b; by lane
        self._ways: dict[float, Floats] = defaultdict(lambda: np.zeros(4))

    def cut(self, moments: Iterator[tuple[float, list[Any]]]) -> Iterator[tuple[list[float], str]]:
        """Yield each chain: its gaps (m) and speeds (m/s) from front to rear, and the ids of its vehicles (``2-3-4``).

        ``moments`` are pairs of a time (in units of ``every_s``) and the states of all vehicles. The first chain of a
        queue begins with its front vehicle, the next chain directly behind the first, and so on. At one moment, a
        vehicle belongs to at most one chain.

        After the last chain, ``InvalidInput`` is raised if too many vehicles have faulty data, or if the recorded gaps
        or positions do not change as the recorded speeds require.
        """
        last, before, before_by_id = math.nan, dict[float, Link](), dict[float, Any]()
        for tick, there in moments:
            by_id = {state.id: state for state in reversed(there)}
            row = tick == round(tick)  # else the moment is used for the checks only
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
        """Return the follower of each vehicle at one moment, by the id of the vehicle ahead; count faulty data.

        ``there`` are the states of all vehicles. ``by_id`` are the same states by id; of a vehicle that is recorded
        twice, it has the first state. Without ``row`` (no chains are formed at this moment), neither omitted nor faulty
        data are counted.
        """
        behind, in_lane = dict[float, Link](), dict[float, float]()  # in_lane: vehicle -> vehicle ahead in the lane
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
                f"is recorded twice for this time (see {self._line(by_id[state.id])})" if by_id[state.id] is not state
                else f"follows vehicle {self._name(number)}, which is not recorded at this time"
                if number >= 0.0 and not ahead
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
        """Add the changes of gaps and positions between two moments to sums that ``cut`` checks after the last chain.

        ``behind`` and ``before`` are results of ``_links`` at the later and the earlier moment; ``passed_s`` is the
        time between them, s.
        """
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
                    f"{file}: in lane {self._name(lane)}, positions (column front) change by {product / said:.2f} times"
                    f" the distance that the speeds imply{'' if way > 0.0 else ', and the speeds are negative'}; front"
                    " must increase in the direction of travel, speeds must be above 0, and both columns must be in"
                    f" {entry.units}"
                )
        if self._faults > entry.impossible * self._states:
            raise InvalidInput(
                f"{self._first_fault}; {self._faults:,} of {self._states:,} positions of vehicles are faulty (recorded"
                " twice, overlapping, or behind a vehicle that is not recorded), but at most"
                f" {entry.impossible:.0%} may be faulty"
            )
        self.left_out["vehicles that overlap, are recorded twice, or follow one that is not recorded"] += self._faults
        opened, said, product = self._gaps.tolist()
        if product > CORRELATED * math.sqrt(opened * said) > 0.0 and not SLOPE[0] < product / said < SLOPE[1]:
            raise InvalidInput(
                f"{file}: the recorded gaps change by {product / said:.2f} times the amount that the speeds imply (3.28"
                " means gaps in feet and speeds in m/s; 0.28 means gaps in m and speeds in km/h); the file must be in"
                f" {entry.units}"
            )


def _gap(ahead: Any, state: Any) -> float:
    """Return the gap (m) from the rear of ``ahead`` to the front of ``state``, in ``state``'s direction of travel."""
    along = ahead.front - ahead.length * ahead.dx - state.front
    across = ahead.side - ahead.length * ahead.dy - state.side
    return float(along * state.dx + across * state.dy)
