"""The motion of an engine's worlds, kept while they run, so that any moment of it can be shown exactly.

Between decisions the motion follows from the state and the command alone: each moment is advanced from the beginning
of its step. A ``Trace`` follows the engine as a shield does; without one nothing is kept and nothing costs time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.envs.drawing.scene import FLASH_S, Scene, Struck, View, first_view, follow, fronts_of
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds, advance
from ethbrake_marl.physics.advance import ImpactRows
from ethbrake_marl.physics.obstacle import with_post_ahead
from ethbrake_marl.physics.rows import TIME
from ethbrake_marl.physics.worlds import assign


@runtime_checkable
class SteppingIn(Protocol):
    """A watcher that may replace what was proposed, and says where it did in the step that is being made."""

    @property
    def stepped_in(self) -> Bools:
        """Where something else than the proposal is applied, [n]."""


@dataclass(frozen=True, slots=True)
class Motion:
    """One step of every world, or the way from its alert to its first decision."""

    start: Worlds  # [n]
    command_mps2: Floats  # [n, N] where ``fresh``: what is in force when it ends
    until_s: Floats  # [n] NaN: it ends where the engine is
    fresh: Bools  # [n] from the alert on
    front_m: Floats  # [n] place of Vehicle 1 at the start, from that at the alert
    harm: Floats  # [n, 2] at the start, by first impacts and in total (m2/s2)
    left_m: Floats  # [n] the view of the episode
    right_m: Floats  # [n]
    struck: Floats  # [k, 4] impacts shortly before the start: world, pair, time, closing speed
    stepped_in: Bools | None  # [n] by a shield; None: there is none
    parts: tuple[tuple[Worlds, Floats, Floats], ...] = ()  # once it is closed: ``Engine.segments``


Memory = tuple[Motion, ...]  # the motions that are kept, the running one last


class Trace:
    """Follows the motion of an engine's worlds (an ``engine.Watcher``).

    Args:
        engine: to be followed from its next reset on.
        whole: keep every step since the episode began (one world); else the last one only.
        alert: the worlds with which the engine, still at its first decision, began: followed from there at once.

    """

    def __init__(self, engine: Engine, *, whole: bool = False, alert: Worlds | None = None) -> None:
        self._whole = whole
        engine.watch(self, () if alert is None else self.begun((), alert, np.arange(alert.n)))

    def begun(self, memory: Memory, alert: Worlds, rows: Ints) -> Memory:
        """Forget the worlds in these rows; they begin at their alert."""
        left, right = first_view(alert)
        n, none = alert.n, np.zeros((0, 4))
        new = Motion(
            alert, np.zeros(alert.speeds_mps.shape), np.full(n, np.nan), np.ones(n, np.bool_), np.zeros(n),
            np.zeros((n, 2)), left, right, none, None,
        )  # fmt: skip
        if not memory or n == memory[-1].start.n:
            return (new,)
        last = memory[-1]
        names = ("command_mps2", "until_s", "fresh", "front_m", "harm", "left_m", "right_m")
        columns: dict[str, Any] = {n: _replaced(getattr(last, n), rows, getattr(new, n)) for n in names}
        struck = last.struck[~np.isin(last.struck[:, 0], rows)]
        return (replace(last, start=assign(last.start, rows, alert), struck=struck, **columns),)

    def stepped(self, memory: Memory, before: Engine, after: Engine) -> Memory:
        """Close the motion that led to this step, and begin the step's own."""
        last = close_motion(memory[-1], before)
        front, struck = _end(last)
        judges = [watcher.stepped_in for watcher in before.watchers if isinstance(watcher, SteppingIn)]
        ledger = before.ledger
        n = before.n
        new = replace(
            last,
            start=before.worlds,
            command_mps2=after.wanted_mps2.copy(),
            until_s=np.full(n, np.nan),
            fresh=np.zeros(n, np.bool_),
            front_m=front,
            harm=np.stack([ledger.world_harm("first"), ledger.world_harm("total")], axis=1),
            struck=struck,
            stepped_in=np.logical_or.reduce(judges) if judges else None,
        )
        return (*memory[:-1], last, new) if self._whole else (new,)


def kept_motions(engine: Engine, trace: Trace) -> Memory:
    """The motions that are kept, all ended. Raises ``InvalidInput`` before the first reset."""
    memory: Memory = engine.memory(trace)
    if not memory:
        raise InvalidInput("render: no episode was started; call reset first")
    return (*memory[:-1], close_motion(memory[-1], engine))


def close_motion(motion: Motion, engine: Engine) -> Motion:
    """The motion that has led to where the engine is."""
    worlds = engine.worlds
    command = np.where(motion.fresh[:, np.newaxis], worlds.command_mps2, motion.command_mps2)
    parts = tuple(engine.segments(motion.start, command))
    return replace(motion, command_mps2=command, until_s=worlds.time_s, parts=parts)


def scenes(engine: Engine, motion: Motion, row: int, times_s: Floats | None = None) -> list[Scene]:
    """What world ``row`` of a closed motion shows at these times of it [k], or at its end alone."""
    times = motion.until_s[[row]] if times_s is None else times_s
    alert_view = View(float(motion.left_m[row]), float(motion.right_m[row]))
    obstacle = motion.start.obstacle_gap_m[row] + motion.front_m[row]
    front_m, harm = motion.front_m[row], motion.harm[row]
    struck = [Struck(int(m[1]), float(m[3]), float(m[2])) for m in motion.struck if m[0] == row]
    shown: list[Scene] = []
    for part in motion.parts:
        world, command, until = part[0].take([row]), part[1][[row]], part[2][[row]]
        now = times if part is motion.parts[-1] else times[times <= until]
        times = times[len(now) :]
        post = with_post_ahead(world, until - world.time_s).take(np.zeros(len(now) + 1, np.int64))
        moved, _ = advance(post, command, until_s=np.append(now, until))
        impacts = _rows(world, command, until)
        fronts = fronts_of(front_m + (post.obstacle_gap_m - moved.obstacle_gap_m), moved.gaps_m)
        told = zip(impacts.pair.tolist(), impacts.closing_speed_mps.tolist(), impacts.time_s.tolist(), strict=True)
        struck += [Struck(*each) for each in told]
        latency, done = world.vehicles.latency_s[0], harm + _harm_until(impacts, np.append(now, until))
        shown += [
            Scene(
                title=engine.scenario.name,
                time_s=float(time),
                view=follow(alert_view, fronts[k]),
                front_m=fronts[k],
                gaps_m=moved.gaps_m[k],
                speeds_mps=moved.speeds_mps[k],
                command_mps2=np.where(latency <= time, command[0], 0.0),
                braking_mps2=world.vehicles.braking_capacity_mps2[0],
                driving_mps2=world.vehicles.driving_capacity_mps2[0],
                latency_s=latency,
                hit=moved.pair_hit[k],
                struck=tuple(s for s in struck if time - FLASH_S < s.time_s <= time),
                first_harm=float(done[k, 0]),
                total_harm=float(done[k, 1]),
                obstacle_m=float(obstacle),
                learners=engine.learners or tuple(engine.deciders),
                shield=None if motion.stepped_in is None or motion.fresh[row] else bool(motion.stepped_in[row]),
                ended=bool(engine.ended[row]) and time == float(engine.packed.state[row, TIME]),
            )
            for k, time in enumerate(now)
        ]
        front_m, harm = fronts[-1][0], done[-1]
    return shown


def moments(motion: Motion, row: int, fps: float) -> Floats:
    """Times [k] s of about ``fps`` evenly spaced moments per second of world ``row``'s motion; the last is its end."""
    start, until = float(motion.start.time_s[row]), float(motion.until_s[row])
    times: Floats = np.linspace(start, until, max(round((until - start) * fps), 1) + 1)[1:]
    return times


def _end(motion: Motion) -> tuple[Floats, Floats]:
    """Where Vehicle 1 is when a closed motion ends [n] m, and the impacts that are then still shown [k, 4]."""
    front_m, struck = motion.front_m, [motion.struck]
    for start, command, until_s in motion.parts:
        post = with_post_ahead(start, until_s - start.time_s)
        after, _ = advance(post, command, until_s=until_s)
        front_m = front_m + (post.obstacle_gap_m - after.obstacle_gap_m)
        rows = _rows(start, command, until_s)
        columns = (rows.world, rows.pair, rows.time_s, rows.closing_speed_mps)
        struck.append(np.stack(columns, axis=1).astype(np.float64))
    found = np.concatenate(struck)
    return front_m, found[found[:, 2] > motion.until_s[found[:, 0].astype(np.int64)] - FLASH_S]


def _rows(worlds: Worlds, command: Floats, until_s: Floats) -> ImpactRows:
    rows = advance(worlds, command, until_s=until_s, record=True)[1].rows
    assert rows is not None  # they were asked for
    return rows


def _harm_until(impacts: ImpactRows, times: Floats) -> Floats:
    """Harm of the impacts of one world up to these times [k, 2], by first impacts and in total."""
    by_then = impacts.time_s <= times[:, np.newaxis]
    harm = impacts.closing_speed_mps * impacts.closing_speed_mps
    return np.stack([(by_then * (harm * impacts.first)).sum(axis=1), (by_then * harm).sum(axis=1)], axis=1)


def _replaced(whole: Floats, rows: Ints, part: Floats) -> Floats:
    copy = whole.copy()
    copy[rows] = part
    return copy
