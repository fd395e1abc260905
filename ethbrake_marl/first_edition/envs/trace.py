"""``Trace``: object that records how the vehicles of an engine move, so that pictures can show any moment.

A ``Trace`` records the state and the commands at the beginning of each step, and computes from them the exact state at
any moment within the step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.envs.rendering import (
    AHEAD_M,
    BEHIND_M,
    BODY_M,
    FLASH_S,
    LATE_S,
    LEAST_WIDTH_M,
    Scene,
    Struck,
    View,
    follow,
)
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.left_out import ImpactRows
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds


@dataclass(frozen=True, slots=True)
class Motion:
    """Recorded motion of n worlds during one step, or from the alert to the first decision.

    The motion that was recorded last is *open*: its end is not yet known. ``closed`` returns a copy of the motion that
    ends with the engine's present state and has the field ``parts``, which ``scenes`` needs. All positions are
    distances (m) from the place of Vehicle 1's front bumper at the alert, positive in the direction of travel.
    """

    start: Worlds  # the n worlds at the start
    # [n, N] commands (m/s2). If the motion begins at the alert, they are 0 until ``closed`` sets the final commands.
    command_mps2: Floats
    until_s: Floats  # [n] time of the end since the alert (s); NaN while the motion is open
    fresh: Bools  # [n] whether the motion begins at the alert, not at a decision
    front_m: Floats  # [n] position of Vehicle 1 at the start (m)
    harm: Floats  # [n, 2] first-impact harm and total harm at the start (m2/s2)
    left_m: Floats  # [n] position of the left end of the road in pictures of the episode (m)
    right_m: Floats  # [n] position of the right end of the road in pictures of the episode (m)
    struck: Floats  # [k, 4] impacts shortly before the start: row of the world, pair, time (s), closing speed (m/s)
    stepped_in: Bools | None  # [n] whether a shield replaced an action; None: there is no shield
    # Consecutive parts with constant commands, each as (worlds at the start, commands, time of the end).
    parts: tuple[tuple[Worlds, Floats, Floats], ...] = ()

    def closed(self, engine: Engine) -> Motion:
        """Return a copy of this motion that ends with the present state of ``engine``."""
        worlds = engine.worlds
        command = np.where(self.fresh[:, np.newaxis], worlds.command_mps2, self.command_mps2)
        parts = tuple(engine.segments(self.start, command))
        return replace(self, command_mps2=command, until_s=worlds.time_s, parts=parts)

    def scenes(self, engine: Engine, row: int, times_s: Floats | None = None) -> list[Scene]:
        """Return the scenes of the world ``row`` at several times. The motion must have an end (see ``closed``).

        ``times_s`` [k] are times within this motion in increasing order, s since the alert; None: only the end of the
        motion.
        """
        times = self.until_s[[row]] if times_s is None else times_s
        alert_view = View(float(self.left_m[row]), float(self.right_m[row]))
        obstacle = self.start.obstacle_gap_m[row] + self.front_m[row]
        front_m, harm = self.front_m[row], self.harm[row]
        struck = [Struck(int(m[1]), float(m[3]), float(m[2])) for m in self.struck if m[0] == row]
        shown: list[Scene] = []
        for part in self.parts:
            world, command, until = part[0].take([row]), part[1][[row]], part[2][[row]]
            now = times if part is self.parts[-1] else times[times <= until]
            times = times[len(now) :]
            post = world.with_post_ahead(until - world.time_s).take(np.zeros(len(now) + 1, np.int64))
            moved, _ = advance(post, command, until_s=np.append(now, until))
            impacts = _rows(world, command, until)
            first = (front_m + (post.obstacle_gap_m - moved.obstacle_gap_m))[:, np.newaxis]
            fronts = np.concatenate([first, first - np.cumsum(moved.gaps_m + BODY_M, axis=1)], axis=1)
            hits = zip(impacts.pair.tolist(), impacts.closing_speed_mps.tolist(), impacts.time_s.tolist(), strict=True)
            struck += [Struck(*each) for each in hits]
            by_then = impacts.time_s <= np.append(now, until)[:, np.newaxis]
            each_harm = impacts.closing_speed_mps * impacts.closing_speed_mps
            counted = [(by_then * (each_harm * impacts.first)).sum(axis=1), (by_then * each_harm).sum(axis=1)]
            latency, done = world.vehicles.latency_s[0], harm + np.stack(counted, axis=1)
            shown += [
                Scene(
                    title=engine.scenario.name,
                    time_s=float(time),
                    view=follow(alert_view, fronts[k]),
                    front_m=fronts[k],
                    gaps_m=moved.gaps_m[k],
                    speeds_mps=moved.speeds_mps[k],
                    command_mps2=moved.command_mps2[k],
                    braking_mps2=world.vehicles.braking_capacity_mps2[0],
                    driving_mps2=world.vehicles.driving_capacity_mps2[0],
                    latency_s=latency,
                    hit=moved.pair_hit[k],
                    struck=tuple(s for s in struck if time - FLASH_S < s.time_s <= time),
                    first_harm=float(done[k, 0]),
                    total_harm=float(done[k, 1]),
                    obstacle_m=float(obstacle),
                    learners=engine.learners or tuple(engine.deciders),
                    shield=None if self.stepped_in is None or self.fresh[row] else bool(self.stepped_in[row]),
                    ended=bool(engine.ended[row])
                    and time == float(engine.packed.state[row, engine.packed.column.time]),
                )
                for k, time in enumerate(now)
            ]
            front_m, harm = fronts[-1][0], done[-1]
        return shown


Memory = tuple[Motion, ...]  # recorded motions in order of time; the last one is open


class Trace:
    """Object that records how the vehicles of an engine move: a ``Watcher`` as defined in the module ``engine.engine``.

    Args:
        engine: the engine whose worlds are recorded, from the engine's next reset on.
        whole: True: keep all steps of the episode (only for engines with one world). False: keep the latest step only.
        alert: for episodes that have already started: the running worlds as they were at the alert; the engine must
            have just reached the first decision. None: recording starts at the next reset.

    """

    def __init__(self, engine: Engine, *, whole: bool = False, alert: Worlds | None = None) -> None:
        self._whole = whole
        engine.watch(self, () if alert is None else self.begun((), alert, np.arange(alert.n)))

    def begun(self, memory: Memory, alert: Worlds, rows: Ints) -> Memory:
        """Return the recorded motions, updated for new episodes that have started in the worlds ``rows`` (indices).

        ``memory`` are the motions recorded so far, and ``alert`` the worlds of the new episodes at the alert.
        """
        v, n = alert.vehicles, alert.n
        # The view contains the whole line until all vehicles are at rest if all brake fully as soon as they can. A rear
        # vehicle that would come to rest further ahead is assumed to push the vehicles ahead of it.
        behind = np.concatenate([np.zeros((n, 1)), np.cumsum(alert.gaps_m, axis=1)], axis=1)
        reaction = alert.speeds_mps * np.minimum(v.latency_s, LATE_S)
        rising = (
            alert.speeds_mps * v.braking_capacity_mps2 / (2.0 * v.brake_rate_mps3)
        )  # upper bound while brakes build up
        way = reaction + rising + alert.speeds_mps**2 / (2.0 * v.braking_capacity_mps2)
        left = -behind[:, -1] - alert.N * BODY_M - BEHIND_M
        right = np.minimum((way - behind).max(axis=1), alert.obstacle_gap_m) + AHEAD_M
        new = Motion(
            alert, np.zeros(alert.speeds_mps.shape), np.full(n, np.nan), np.ones(n, np.bool_), np.zeros(n),
            np.zeros((n, 2)), left, np.maximum(right, left + LEAST_WIDTH_M), np.zeros((0, 4)), None,
        )  # fmt: skip
        if not memory or n == memory[-1].start.n:
            return (new,)
        last = memory[-1]
        columns: dict[str, Any] = {}
        for name in ("command_mps2", "until_s", "fresh", "front_m", "harm", "left_m", "right_m"):
            columns[name] = getattr(last, name).copy()
            columns[name][rows] = getattr(new, name)
        struck = last.struck[~np.isin(last.struck[:, 0], rows)]
        return (replace(last, start=last.start.assign(rows, alert), struck=struck, **columns),)

    def stepped(self, memory: Memory, before: Engine, after: Engine) -> Memory:
        """Return the recorded motions after a step; only the last one is open.

        If ``whole`` is true, the result contains all motions of the episode so far, otherwise only the motion of the
        new step. ``before`` and ``after`` are the engine before and after the step.
        """
        last = memory[-1].closed(before)
        front_m, met = last.front_m, [last.struck]
        for start, command, until_s in last.parts:
            post = start.with_post_ahead(until_s - start.time_s)
            moved, _ = advance(post, command, until_s=until_s)
            front_m = front_m + (post.obstacle_gap_m - moved.obstacle_gap_m)
            rows = _rows(start, command, until_s)
            columns = (rows.world, rows.pair, rows.time_s, rows.closing_speed_mps)
            met.append(np.stack(columns, axis=1).astype(np.float64))
        struck, ledger, n = np.concatenate(met), before.ledger, before.n
        new = replace(
            last,
            start=before.worlds,
            command_mps2=after.wanted_mps2.copy(),
            until_s=np.full(n, np.nan),
            fresh=np.zeros(n, np.bool_),
            front_m=front_m,
            harm=np.stack([ledger.world_harm("first"), ledger.world_harm("total")], axis=1),
            struck=struck[struck[:, 2] > last.until_s[struck[:, 0].astype(np.int64)] - FLASH_S],
            stepped_in=None if after.ruling is None else after.ruling.stepped_in,
        )
        return (*memory[:-1], last, new) if self._whole else (new,)

    def motions(self, engine: Engine) -> Memory:
        """Return all recorded motions in order of time; the last motion ends with the engine's present state.

        Raises ``InvalidInput`` before the first reset.
        """
        memory: Memory = engine.memory(self)
        if not memory:
            raise InvalidInput("render: no episode has started; call reset first")
        return (*memory[:-1], memory[-1].closed(engine))


def _rows(worlds: Worlds, command: Floats, until_s: Floats) -> ImpactRows:
    rows = advance(worlds, command, until_s=until_s, record=True)[1].rows
    assert rows is not None  # because of ``record=True``
    return rows
