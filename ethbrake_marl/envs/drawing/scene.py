"""One moment of one world, as plain numbers: what a picture or a text shows of it, and films of such moments as SVG."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, NamedTuple
from xml.sax.saxutils import escape

import numpy as np

from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.errors import InvalidInput, plain_text
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


def star(x: float, y: float, far: float, near: float) -> list[tuple[float, float]]:
    """A star of eight points."""
    return [
        (x + r * math.cos(k * math.pi / 8), y + r * math.sin(k * math.pi / 8)) for k, r in enumerate([far, near] * 8)
    ]


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


# An episode as a moving drawing: one SVG file that any browser plays, light or dark, without a program inside.

_FILM_WIDTH = 800
_HOLD_S = 2.5  # the end stands so long before the drawing begins again
_STRIP = 132  # height of one agent's road
_FOOT = 34  # below the last road: the clock
_LANE, _HALF_ROAD, _HALF_BODY = 82, 24, 13  # pixels from a strip's top; halves of heights
_SHOWN_S = 1.0  # how long an impact is shown
_MOST_TITLE = 60
_STYLE = """
:root { --paper: #ffffff; --ink: #1a1a1a; --quiet: #5c5c5c; --road: #d4d7db; --mark: #ffffff; --brake: #d00000;
  --drive: #2a7f3f; --flash: #ffd60a; }
@media (prefers-color-scheme: dark) { :root { --paper: #14171c; --ink: #ececec; --quiet: #a8adb5; --road: #3b4048;
  --mark: #6d747f; --brake: #ff4d4d; --drive: #5fd07a; } }
text { font-family: system-ui, sans-serif; font-size: 14px; fill: var(--ink); }
.quiet { fill: var(--quiet); font-size: 12px; }
.number { fill: #ffffff; font-weight: bold; text-anchor: middle; }
.impact { text-anchor: middle; font-weight: bold; }
"""


def animate_films(films: Mapping[str, Sequence[Scene]], *, fps: int) -> str:
    """Films of one world, titled and one below the other, in real time, on one scale of the road.

    Args:
        films: the scenes of each film by its title, ``fps`` of them per second; none is empty.
        fps: scenes per second.

    """
    frames = max(map(len, films.values())) + round(_HOLD_S * fps)
    every = [scene for film in films.values() for scene in film]
    left, right = min(scene.view.left_m for scene in every), max(scene.view.right_m for scene in every)
    strips = [
        _Strip([*film, *[film[-1]] * (frames - len(film))], plain_text(title)[:_MOST_TITLE], left, right, fps)
        for title, film in films.items()
    ]
    height = _STRIP * len(strips) + _FOOT
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_FILM_WIDTH} {height}" role="img">',
        f"<title>{escape(' and '.join(strip.title for strip in strips))} in one emergency</title>",
        f"<style>{_STYLE}</style>",
        f'<rect width="{_FILM_WIDTH}" height="{height}" rx="8" fill="var(--paper)"/>',
    ]
    for number, strip in enumerate(strips):
        parts += [f'<g transform="translate(0 {number * _STRIP})">', *strip.drawn(), "</g>"]
    parts += _clock(height - 16, max(map(len, films.values())) - 1, frames, fps)
    return "\n".join([*parts, "</svg>", ""])


class _Strip:
    """One film on its road."""

    def __init__(self, film: Sequence[Scene], title: str, left_m: float, right_m: float, fps: int) -> None:
        self.title = title
        self._film, self._fps = film, fps
        self._left, self._scale = left_m, _FILM_WIDTH / (right_m - left_m)

    def _x(self, place_m: float) -> float:
        return (float(place_m) - self._left) * self._scale

    def drawn(self) -> Iterator[str]:
        """Its elements."""
        yield f'<text x="12" y="22" font-weight="bold">{escape(self.title)}</text>'
        yield from self._harms()
        top = _LANE - _HALF_ROAD
        yield f'<rect y="{top}" width="{_FILM_WIDTH}" height="{2 * _HALF_ROAD}" fill="var(--road)"/>'
        for place in range(math.ceil(self._left / 10) * 10, math.floor(self._left + _FILM_WIDTH / self._scale) + 1, 10):
            x = self._x(place)
            yield f'<path d="M{x:.1f} {top}v{2 * _HALF_ROAD}" stroke="var(--mark)" stroke-width="1.5"/>'
        obstacle = self._film[0].obstacle_m
        if math.isfinite(obstacle):
            yield f'<rect x="{self._x(obstacle):.1f}" y="{top}" width="9" height="{2 * _HALF_ROAD}" fill="var(--ink)"/>'
        for i in range(len(self._film[0].front_m)):
            yield from self._vehicle(i)
        yield from self._labels()

    def _vehicle(self, i: int) -> Iterator[str]:
        """The body that moves, with its number and the lights of its command."""
        places = [self._x(scene.front_m[i]) for scene in self._film]
        length, top = BODY_M * self._scale, _LANE - _HALF_BODY
        yield f'<g transform="translate({places[0]:.1f} 0)">'
        yield (
            f'<rect x="{-length:.1f}" y="{top}" width="{length:.1f}" height="{2 * _HALF_BODY}" rx="3"'
            f' fill="{vehicle_colour(i)}"/><text class="number" x="{-length / 2:.1f}" y="{_LANE + 5}">{i + 1}</text>'
        )
        commands = [float(scene.command_mps2[i]) for scene in self._film]
        for name, x, lit in (
            ("brake", -length, [command < 0.0 for command in commands]),
            ("drive", -5.0, [command > 0.0 for command in commands]),
        ):
            if any(lit):
                yield (
                    f'<rect x="{x:.1f}" y="{top}" width="5" height="{2 * _HALF_BODY}" fill="var(--{name})"'
                    f' opacity="0">{self._switched(lit)}</rect>'
                )
        yield from self._stars(i)
        values = ";".join(f"{place:.1f} 0" for place in places)
        yield (
            '<animateTransform attributeName="transform" type="translate" repeatCount="indefinite"'
            f' dur="{self._duration_s():g}s" values="{values}"/></g>'
        )

    def _harms(self) -> Iterator[str]:
        """The harm so far: one text for each that is shown, and the times at which it is."""
        texts = [
            f"harm {scene.first_harm:.1f} by first impacts, {scene.total_harm:.1f} in total" for scene in self._film
        ]
        for words in dict.fromkeys(texts):
            lit = [each == words for each in texts]
            shown = "1" if lit[0] else "0"
            yield (
                f'<text x="{_FILM_WIDTH - 12}" y="22" text-anchor="end" opacity="{shown}">{words}'
                f"{self._switched(lit)}</text>"
            )

    def _labels(self) -> Iterator[str]:
        """Above the road, the closing speed of each impact while it is shown."""
        for start, until, struck in self._events():
            x = self._x(self._film[start].front_m[struck.pair + 1])
            words = f"{pair_words(struck.pair)}: {speed_words(struck.closing_mps)}"
            lit = [start <= k < until for k in range(len(self._film))]
            yield (
                f'<text class="impact" x="{min(max(x, 90), _FILM_WIDTH - 90):.1f}" y="46" opacity="0">{words}'
                f"{self._switched(lit)}</text>"
            )

    def _stars(self, i: int) -> Iterator[str]:
        """At the front of Vehicle ``i + 1``, a star for each of its impacts with what is ahead, while it is shown."""
        for start, until, struck in self._events():
            if struck.pair + 1 == i:
                points = " ".join(f"{x:.1f},{y:.1f}" for x, y in star(0.0, _LANE, 17, 8))
                lit = [start <= k < until for k in range(len(self._film))]
                yield (
                    f'<polygon points="{points}" fill="var(--flash)" stroke="#c1121f" opacity="0">'
                    f"{self._switched(lit)}</polygon>"
                )

    def _events(self) -> list[tuple[int, int, Struck]]:
        """Impacts that are shown: the number of the first scene, that behind the last one, and the impact.

        One that is lighter than the one before it is left out while that one is shown.
        """
        known: set[tuple[int, float]] = set()
        found: list[tuple[int, int, Struck]] = []
        for k, scene in enumerate(self._film):
            new = [struck for struck in scene.struck if (struck.pair, struck.time_s) not in known]
            known |= {(struck.pair, struck.time_s) for struck in new}
            hardest = max(new, key=lambda struck: struck.closing_mps, default=None)
            if hardest is None or (found and k < found[-1][1] and hardest.closing_mps < found[-1][2].closing_mps):
                continue
            if found:
                found[-1] = (found[-1][0], min(found[-1][1], k), found[-1][2])
            found.append((k, k + round(_SHOWN_S * self._fps), hardest))
        return found

    def _switched(self, lit: Sequence[bool]) -> str:
        """An opacity of 1 in the scenes that are lit, and of 0 in the others."""
        values, times, k = [], [], 0
        for on, run in groupby(lit):
            values.append("1" if on else "0")
            times.append(f"{k / len(lit):.4f}")
            k += len(list(run))
        return (
            '<animate attributeName="opacity" calcMode="discrete" repeatCount="indefinite"'
            f' dur="{self._duration_s():g}s" values="{";".join(values)}" keyTimes="{";".join(times)}"/>'
        )

    def _duration_s(self) -> float:
        return len(self._film) / self._fps


def _clock(y: int, last: int, frames: int, fps: int) -> Iterator[str]:
    """Seconds since the alert as a line that fills."""
    left, width = 170, _FILM_WIDTH - 200
    yield f'<text class="quiet" x="12" y="{y + 4}">seconds since the alert</text>'
    yield f'<path d="M{left} {y}h{width}" stroke="var(--road)" stroke-width="4"/>'
    for second in range(math.floor(last / fps) + 1):
        x = left + width * second * fps / max(last, 1)
        yield f'<text class="quiet" x="{x:.1f}" y="{y - 7}" text-anchor="middle">{second}</text>'
    share = (last or 1) / frames
    yield (
        f'<rect x="{left}" y="{y - 2}" width="0" height="4" fill="var(--ink)"><animate attributeName="width"'
        f' dur="{frames / fps:g}s" repeatCount="indefinite" values="0;{width};{width}"'
        f' keyTimes="0;{share:.4f};1"/></rect>'
    )


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
