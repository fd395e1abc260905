"""One moment of one world, as plain numbers: what a picture or a text shows of it, and the stretch of road in view."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds, advance
from ethbrake_marl.physics.advance import TIME, ImpactRows
from ethbrake_marl.physics.kernel import with_post_ahead
from ethbrake_marl.physics.worlds import assign

BODY_M = 4.5  # length that vehicles are drawn with; the physics knows none
FLASH_S = 0.3  # how long an impact is shown
# Okabe and Ito's palette without its yellow (invisible on white), which colour-blind readers tell apart.
COLOURS = ("#000000", "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_BEHIND_M, _AHEAD_M = 3.0, 5.0  # of free road in view at least
_LEAST_WIDTH_M = 40.0
_LATE_S = 3.0  # of a latency that the view makes room for


class View(NamedTuple):
    """The road in view (m from the front of Vehicle 1 at the alert), the same for a whole episode if possible."""

    left_m: float
    right_m: float


class Struck(NamedTuple):
    """An impact that is being shown."""

    pair: int  # -1: Vehicle 1 and the obstacle
    closing_mps: float
    time_s: float


class Scene(NamedTuple):
    """One world at one moment."""

    title: str  # name of the scenario
    time_s: float  # since the alert
    view: View
    front_m: Floats  # [N] front bumpers, from that of Vehicle 1 at the alert; bodies of BODY_M apart by the true gaps
    gaps_m: Floats  # [P]
    speeds_mps: Floats  # [N]
    command_mps2: Floats  # [N] in force; 0 before the latency has elapsed
    braking_mps2: Floats  # [N] capacities
    driving_mps2: Floats  # [N]
    latency_s: Floats  # [N]
    hit: Bools  # [P] pairs that have had an impact
    struck: tuple[Struck, ...]  # impacts of the last moments
    first_harm: float  # of the line so far, first impacts only (m2/s2)
    total_harm: float  # of every impact
    obstacle_m: float  # its place; infinite: there is none
    learners: tuple[int, ...]
    shield: bool | None  # whether a shield stepped in; None: there is none
    ended: bool  # the episode is over


def vehicle_colour(i: int) -> str:
    """Colour of Vehicle ``i + 1`` in every picture."""
    return COLOURS[(i + 1) % len(COLOURS)]


def first_view(alert: Worlds) -> tuple[Floats, Floats]:
    """Both ends [n] m of the road that holds each line from the alert to rest, if all brake fully as soon as they can.

    A vehicle behind that stops later is taken to push the ones ahead so far.
    """
    v, N = alert.vehicles, alert.N
    behind = np.concatenate([np.zeros((alert.n, 1)), np.cumsum(alert.gaps_m, axis=1)], axis=1)
    way = alert.speeds_mps * np.minimum(v.latency_s, _LATE_S) + alert.speeds_mps**2 / (2.0 * v.braking_capacity_mps2)
    right = np.minimum((way - behind).max(axis=1), alert.obstacle_gap_m) + _AHEAD_M
    left = -behind[:, -1] - N * BODY_M - _BEHIND_M
    return left, np.maximum(right, left + _LEAST_WIDTH_M)


def follow(view: View, front_m: Floats) -> View:
    """The view moved on, and widened where it must be, until the whole line is in it."""
    on = max(float(front_m[0]) + _AHEAD_M - view.right_m, 0.0)
    left = min(view.left_m + on, float(front_m[-1]) - BODY_M - _BEHIND_M)
    return View(left if on else min(left, view.left_m), view.right_m + on)


def fronts_of(front_m: Floats, gaps_m: Floats) -> Floats:
    """Front bumpers [k, N] of lines drawn with bodies, from those of Vehicle 1 [k] and the gaps [k, P]."""
    behind = np.cumsum(gaps_m + BODY_M, axis=1)
    return np.concatenate([front_m[:, np.newaxis], front_m[:, np.newaxis] - behind], axis=1)


# A moment as text: the road to scale in one line, then a line for each vehicle.

WIDTH = 100  # characters of road


def scene_text(scene: Scene) -> str:
    """The moment as a few lines of plain text, without colours or other control characters."""
    lines = [
        f"{scene.title}  {scene.time_s:.2f} s after the alert{'  (ended)' if scene.ended else ''}",
        _road(scene),
        *(_vehicle(scene, i) for i in range(len(scene.front_m))),
        f"harm {scene.first_harm:.2f} m2/s2 by first impacts, {scene.total_harm:.2f} in total",
        *(f"impact: {pair_words(s.pair)} at {speed_words(s.closing_mps)}, {s.time_s:.2f} s" for s in scene.struck),
    ]
    if scene.shield is not None:
        lines.append(shield_words(scene.shield))
    return "\n".join(lines) + "\n"


def pair_words(pair: int) -> str:
    """Who met whom in an impact."""
    return "Vehicle 1 and the obstacle" if pair < 0 else f"Vehicles {pair + 1} and {pair + 2}"


def speed_words(closing_mps: float) -> str:
    """A closing speed; an impact never reads 0.0."""
    return f"{closing_mps:.1f} m/s" if closing_mps >= 0.05 else "< 0.1 m/s"


def shield_words(stepped_in: bool) -> str:
    """What the shield did in this step."""
    return "shield: stepped in" if stepped_in else "shield: let it pass"


def command_words(scene: Scene, i: int) -> str:
    """The command in force of vehicle ``i``."""
    command = float(scene.command_mps2[i])
    if scene.latency_s[i] > scene.time_s:
        return f"acts from {scene.latency_s[i]:.2f} s" if math.isfinite(scene.latency_s[i]) else "never acts"
    if command == 0.0:
        return "coasts"
    return f"{'brakes' if command < 0.0 else 'drives'} {abs(command):.1f} m/s2"


def _road(scene: Scene) -> str:
    """The line of vehicles to scale, front on the right; a number stands where that vehicle's body is."""
    left, right = scene.view
    road = ["."] * WIDTH
    for i in range(len(scene.front_m) - 1, -1, -1):
        first, last = (_column(float(scene.front_m[i]) - m, left, right) for m in (BODY_M, 0.0))
        road[first : last + 1] = list(f"[{i + 1}>".center(last + 1 - first, "=")[: last + 1 - first])
    if math.isfinite(scene.obstacle_m):
        road[_column(scene.obstacle_m, left, right)] = "#"
    for struck in scene.struck:
        road[_column(float(scene.front_m[max(struck.pair + 1, 0)]), left, right)] = "*"
    return "".join(road)


def _column(place_m: float, left: float, right: float) -> int:
    return min(max(int((place_m - left) / (right - left) * WIDTH), 0), WIDTH - 1)


def _vehicle(scene: Scene, i: int) -> str:
    gap = f"gap ahead {scene.gaps_m[i - 1]:6.2f} m" if i else ""
    if i == 0 and math.isfinite(scene.obstacle_m):
        gap = f"obstacle  {scene.obstacle_m - scene.front_m[0]:6.2f} m"
    learns = "learns" if i in scene.learners else ""
    words = command_words(scene, i)
    return f"vehicle_{i + 1:<3} {learns:6}  {scene.speeds_mps[i]:6.2f} m/s  {gap:18}  {words}".rstrip()


# The motion of an engine's worlds, kept while they run, so that any moment of it can be shown exactly.
#
# Between decisions the motion follows from the state and the command alone: each moment is advanced from the beginning
# of its step. A ``Trace`` looks on at the engine; without one nothing is kept and nothing costs time.


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
            stepped_in=None if after.ruling is None else after.ruling.stepped_in,
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
