"""``render()`` of every interface: a moment of a world as plain numbers, as text, as pixels, in a window, in a film.

Pillow is imported by the first frame, pygame by the first window.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import groupby
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.engine import Engine
from ethbrake_marl.errors import InvalidInput, check_whole_number, need, plain_text
from ethbrake_marl.physics import Bools, Floats, ImpactRows, Ints, Worlds, advance

if TYPE_CHECKING:
    from PIL import ImageDraw, ImageFont

Frame = NDArray[np.uint8]  # [HEIGHT, WIDTH, 3]

BODY_M = 4.5  # length that vehicles are drawn with; the physics knows none
FLASH_S = 0.3  # how long an impact is shown
# Okabe and Ito's palette without its yellow (invisible on white), which colour-blind readers tell apart.
COLOURS = ("#000000", "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_TEXT_WIDTH = 100  # characters of road
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

    @property
    def who(self) -> str:
        """Who met whom."""
        return "Vehicle 1 and the obstacle" if self.pair < 0 else f"Vehicles {self.pair + 1} and {self.pair + 2}"

    @property
    def speed(self) -> str:
        """Its closing speed; an impact never reads 0.0."""
        return f"{self.closing_mps:.1f} m/s" if self.closing_mps >= 0.05 else "< 0.1 m/s"


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

    @property
    def shield_words(self) -> str:
        """What the shield did in this step."""
        return "shield: stepped in" if self.shield else "shield: let it pass"

    def command_words(self, i: int) -> str:
        """The command in force of vehicle ``i``."""
        command = float(self.command_mps2[i])
        if self.latency_s[i] > self.time_s:
            return f"acts from {self.latency_s[i]:.2f} s" if math.isfinite(self.latency_s[i]) else "never acts"
        if command == 0.0:
            return "coasts"
        return f"{'brakes' if command < 0.0 else 'drives'} {abs(command):.1f} m/s2"

    def text(self) -> str:
        """The moment as plain text, without control characters: the road to scale, then a line for each vehicle."""
        left, right = self.view

        def column(place_m: float) -> int:
            return min(max(int((float(place_m) - left) / (right - left) * _TEXT_WIDTH), 0), _TEXT_WIDTH - 1)

        road, lines = ["."] * _TEXT_WIDTH, []
        for i in range(len(self.front_m) - 1, -1, -1):  # a number stands where that vehicle's body is
            first, last = column(self.front_m[i] - BODY_M), column(self.front_m[i])
            road[first : last + 1] = list(f"[{i + 1}>".center(last + 1 - first, "=")[: last + 1 - first])
            gap = f"gap ahead {self.gaps_m[i - 1]:6.2f} m" if i else ""
            if i == 0 and math.isfinite(self.obstacle_m):
                gap = f"obstacle  {self.obstacle_m - self.front_m[0]:6.2f} m"
                road[column(self.obstacle_m)] = "#"
            learns = "learns" if i in self.learners else ""
            words = f"{self.speeds_mps[i]:6.2f} m/s  {gap:18}  {self.command_words(i)}"
            lines.append(f"vehicle_{i + 1:<3} {learns:6}  {words}".rstrip())
        for struck in self.struck:
            road[column(self.front_m[max(struck.pair + 1, 0)])] = "*"
        told = [
            f"{self.title}  {self.time_s:.2f} s after the alert{'  (ended)' if self.ended else ''}",
            "".join(road),
            *reversed(lines),
            f"harm {self.first_harm:.2f} m2/s2 by first impacts, {self.total_harm:.2f} in total",
            *(f"impact: {struck.who} at {struck.speed}, {struck.time_s:.2f} s" for struck in self.struck),
        ]
        return "\n".join([*told, self.shield_words] if self.shield is not None else told) + "\n"

    def frame(self) -> Frame:
        """The moment as a picture [H, W, 3]; the same moment gives the same bytes."""
        from PIL import Image, ImageDraw

        image = Image.new("RGB", (WIDTH * _FINE, HEIGHT * _FINE), _PAPER)
        pen = _Pen(ImageDraw.Draw(image))
        _draw_road(pen, self)
        for i in range(len(self.front_m)):
            _draw_panel(pen, self, i)
        fine = image.reduce(_FINE)
        text = ImageDraw.Draw(fine)
        _write_head(text, self)
        _write_road(text, self)
        for i in range(len(self.front_m)):
            _write_panel(text, self, i)
        return np.array(fine)


def vehicle_colour(i: int) -> str:
    """Colour of Vehicle ``i + 1`` in every picture."""
    return COLOURS[(i + 1) % len(COLOURS)]


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


# A moment as pixels: the road to scale, below it a panel for each vehicle.

WIDTH, HEIGHT = 800, 304  # multiples of 16, as video codecs want them
_MARGIN = 12
_ROAD_TOP, _ROAD_BOTTOM = 84, 138
_LANE = (_ROAD_TOP + _ROAD_BOTTOM) // 2
_BODY = 13  # half of a body's height
_PANEL_TOP = 172
_TITLE = 540  # width that is left beside the clock
_FINE = 2  # shapes are drawn so many times larger, for smooth edges

_PAPER, _INK, _GREY = "#ffffff", "#1a1a1a", "#6b6b6b"
_ASPHALT, _DASH = "#4a4d52", "#e8e8e8"
_BRAKE, _DRIVE, _FLASH, _SHIELD = "#c1121f", "#2a7f3f", "#ffd60a", "#6a3d9a"


class _Pen:
    """Draws shapes at the larger scale, from pixels of the picture."""

    def __init__(self, draw: ImageDraw.ImageDraw) -> None:
        self._draw = draw

    def box(self, left: float, top: float, right: float, bottom: float, fill: str, edge: str | None = None) -> None:
        """A box with slightly round corners."""
        corners = [value * _FINE for value in (left, top, max(right, left + 1), max(bottom, top + 1))]
        self._draw.rounded_rectangle(corners, 2 * _FINE, fill=fill, outline=edge, width=_FINE * 2)

    def line(self, x1: float, y1: float, x2: float, y2: float, colour: str, width: float = 1.0) -> None:
        """A straight line."""
        self._draw.line([x1 * _FINE, y1 * _FINE, x2 * _FINE, y2 * _FINE], fill=colour, width=round(width * _FINE))

    def shape(self, points: list[tuple[float, float]], fill: str, edge: str | None = None) -> None:
        """A polygon."""
        self._draw.polygon([(x * _FINE, y * _FINE) for x, y in points], fill=fill, outline=edge, width=_FINE)


def _draw_road(pen: _Pen, scene: Scene) -> None:
    pen.box(0, _ROAD_TOP, WIDTH, _ROAD_BOTTOM, _ASPHALT)
    for place in _marks(scene, 5.0):  # dashes of the lane's edges, 2 m each: they stand still as the line moves
        left, right = _x(scene, place), _x(scene, place + 2.0)
        for y in (_ROAD_TOP + 5, _ROAD_BOTTOM - 5):
            pen.line(left, y, right, y, _DASH, 1.5)
    for place in _marks(scene, _spacing(scene)):
        pen.line(_x(scene, place), _ROAD_BOTTOM, _x(scene, place), _ROAD_BOTTOM + 5, _GREY)
    if math.isfinite(scene.obstacle_m):
        x = _x(scene, scene.obstacle_m)
        pen.box(x, _ROAD_TOP + 4, x + 9, _ROAD_BOTTOM - 4, _INK, _FLASH)
    for i in range(len(scene.front_m)):
        _draw_vehicle(pen, scene, i)
    for left, right, *_ in _spaces(scene):
        for x in (left, right):
            pen.line(x, _ROAD_TOP - 10, x, _ROAD_TOP - 2, _GREY)
        pen.line(left, _ROAD_TOP - 6, right, _ROAD_TOP - 6, _GREY)
    for struck in scene.struck:
        pen.shape(star(_contact(scene, struck), _LANE, 17, 8), _FLASH, _BRAKE)


def _draw_vehicle(pen: _Pen, scene: Scene, i: int) -> None:
    right, left = _x(scene, scene.front_m[i]), _x(scene, scene.front_m[i] - BODY_M)
    pen.box(left, _LANE - _BODY, right, _LANE + _BODY, vehicle_colour(i), _PAPER if i == 1 else None)
    glass = (right - left) * 0.72 + left
    pen.box(glass, _LANE - _BODY + 4, glass + (right - left) * 0.1, _LANE + _BODY - 4, "#dfefff")
    if scene.command_mps2[i] < 0.0:
        for y in (_LANE - _BODY, _LANE + _BODY - 6):
            pen.box(left, y, left + 4, y + 6, "#ff2b2b")
    if i in scene.learners:
        middle = (left + right) / 2
        pen.shape([(middle - 6, _ROAD_TOP + 1), (middle + 6, _ROAD_TOP + 1), (middle, _ROAD_TOP + 10)], _PAPER)


def _draw_panel(pen: _Pen, scene: Scene, i: int) -> None:
    """The share of its capacity that the command takes: braking to the left, driving to the right."""
    left, width = _panel(scene, i)
    pen.box(left, _PANEL_TOP, left + 20, _PANEL_TOP + 18, vehicle_colour(i))
    middle, half, top = left + width / 2, width / 2, _PANEL_TOP + 62
    pen.box(left, top, left + width, top + 12, "#eeeeee")
    share = _share(scene, i)
    if share < 0.0:
        pen.box(middle + share * half, top, middle, top + 12, _BRAKE)
    elif share > 0.0:
        pen.box(middle, top, middle + share * half, top + 12, _DRIVE)
    pen.line(middle, top - 3, middle, top + 15, _INK)


def _write_head(text: ImageDraw.ImageDraw, scene: Scene) -> None:
    title = plain_text(scene.title)[:200]
    cut = [title, *(f"{title[:k]}..." for k in range(len(title), -1, -1))]
    text.text((_MARGIN, 10), _fitting(cut, _TITLE, 15), _GREY, _font(15))
    clock = f"{scene.time_s:.2f} s after the alert{', ended' if scene.ended else ''}"
    text.text((WIDTH - _MARGIN, 8), clock, _INK, _font(18), anchor="ra")
    harm = f"harm {scene.first_harm:.2f} by first impacts, {scene.total_harm:.2f} in total (m2/s2)"
    y = HEIGHT - 22
    text.text((_MARGIN, y), harm, _BRAKE if scene.total_harm > 0.0 else _INK, _font(15))
    if scene.shield is not None:
        words, colour = scene.shield_words, _SHIELD if scene.shield else _GREY
        if scene.shield:
            width = _font(15).getlength(words)
            text.rectangle((WIDTH - _MARGIN - width - 8, y - 3, WIDTH - _MARGIN + 2, y + 19), fill=_SHIELD)
            colour = _PAPER
        text.text((WIDTH - _MARGIN - 3, y), words, colour, _font(15), anchor="ra")


def _write_road(text: ImageDraw.ImageDraw, scene: Scene) -> None:
    for place in _marks(scene, _spacing(scene)):
        if 20 <= _x(scene, place) <= WIDTH - 20:
            text.text((_x(scene, place), _ROAD_BOTTOM + 7), f"{place:.0f} m", _GREY, _font(12), anchor="ma")
    for i in range(len(scene.front_m)):
        middle = _x(scene, scene.front_m[i] - BODY_M * 0.55)
        text.text((middle, _LANE), str(i + 1), _PAPER, _font(16), anchor="mm")
    free = math.inf
    for left, right, gap_m, hit in _spaces(scene):  # from the right; a label without room stands one line higher
        middle, words = (left + right) / 2, f"{gap_m:.1f} m"
        half = _font(14).getlength(words) / 2 + 3
        high = middle + half > free
        colour = _BRAKE if hit else _INK
        text.text((middle, _ROAD_TOP - (27 if high else 13)), words, colour, _font(14), anchor="ms")
        free = math.inf if high else middle - half
    if scene.struck:  # above the line, the hardest impact of each pair that is being shown, the two hardest of them
        hardest = {struck.pair: struck for struck in sorted(scene.struck, key=lambda struck: struck.closing_mps)}
        told = sorted(hardest.values(), key=lambda struck: -struck.closing_mps)[:2]
        words = "impact of " + ", ".join(f"{struck.who} at {struck.speed}" for struck in told)
        half = _font(15).getlength(words) / 2
        middle = sum(_contact(scene, struck) for struck in told) / len(told)
        middle = min(max(middle, _MARGIN + half), WIDTH - _MARGIN - half)
        text.rectangle((middle - half - 5, 34, middle + half + 5, 54), fill=_FLASH)
        text.text((middle, 44), words, _INK, _font(15), anchor="mm")


def _write_panel(text: ImageDraw.ImageDraw, scene: Scene, i: int) -> None:
    left, width = _panel(scene, i)
    text.text((left + 10, _PANEL_TOP + 9), str(i + 1), _PAPER, _font(15), anchor="mm")
    learns = i in scene.learners
    names = ([f"Vehicle {i + 1}, learner", "learner", "L"]) if learns else ([f"Vehicle {i + 1}", ""])
    text.text((left + 26, _PANEL_TOP + 2), _fitting(names, width - 26, 14), _INK, _font(14))
    speed = f"{scene.speeds_mps[i]:.1f}"
    text.text((left, _PANEL_TOP + 28), _fitting([f"{speed} m/s", speed], width, 20), _INK, _font(20))
    words = scene.command_words(i)
    share = f"{words} ({abs(_share(scene, i)) * 100:.0f} %)" if scene.command_mps2[i] != 0.0 else words
    text.text((left, _PANEL_TOP + 78), _fitting([share, words, ""], width, 13), _GREY, _font(13))


def _fitting(words: list[str], width: float, size: int) -> str:
    """The first of these that is not wider than ``width``, else the last."""
    return next((each for each in words if _font(size).getlength(each) <= width), words[-1])


def _share(scene: Scene, i: int) -> float:
    """The command in force as a share of the vehicle's capacity; below 0 it brakes."""
    command = float(scene.command_mps2[i])
    capacity = float((scene.braking_mps2 if command < 0.0 else scene.driving_mps2)[i])
    return command / capacity if command != 0.0 else 0.0


def _panel(scene: Scene, i: int) -> tuple[float, float]:
    """Left edge and width (pixels) of a vehicle's numbers, in the order of the line, Vehicle 1 on the right."""
    count = len(scene.front_m)
    gap = 24.0 if count <= 5 else 10.0
    width = min((WIDTH - 2 * _MARGIN - gap * (count - 1)) / count, 240.0)
    return WIDTH - _MARGIN - width - i * (WIDTH - 2 * _MARGIN - width) / max(count - 1, 1), width


def _x(scene: Scene, place_m: float) -> float:
    """Pixels from the left edge of a place on the road."""
    return (float(place_m) - scene.view.left_m) / (scene.view.right_m - scene.view.left_m) * WIDTH


def _spaces(scene: Scene) -> list[tuple[float, float, float, bool]]:
    """Free road from the front backwards, to the obstacle, if there is one, and between the vehicles.

    Its left and its right end (pixels), its length (m), and whether the two beside it hit each other.
    """
    front, obstacle = float(scene.front_m[0]), scene.obstacle_m
    spaces = [(_x(scene, front), _x(scene, obstacle), obstacle - front, any(s.pair < 0 for s in scene.struck))]
    for p, gap in enumerate(scene.gaps_m.tolist()):
        left, right = _x(scene, scene.front_m[p + 1]), _x(scene, scene.front_m[p] - BODY_M)
        spaces.append((left, right, gap, bool(scene.hit[p])))
    return spaces if math.isfinite(obstacle) else spaces[1:]


def _marks(scene: Scene, every_m: float) -> list[float]:
    """Places in view that are multiples of ``every_m``."""
    first, last = math.ceil(scene.view.left_m / every_m), math.floor(scene.view.right_m / every_m)
    return [k * every_m for k in range(first, last + 1)]


def _spacing(scene: Scene) -> float:
    """Metres between two marks with a number: at most a dozen of them."""
    width = scene.view.right_m - scene.view.left_m
    return next((every for every in (5.0, 10.0, 20.0, 50.0, 100.0, 200.0) if width <= 12 * every), 500.0)


def _contact(scene: Scene, struck: Struck) -> float:
    """Where an impact is shown (pixels): between the two bodies."""
    if struck.pair < 0:
        return _x(scene, scene.front_m[0])
    return (_x(scene, scene.front_m[struck.pair + 1]) + _x(scene, scene.front_m[struck.pair] - BODY_M)) / 2


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    """Pillow's own font: the same on every machine that has this Pillow."""
    from PIL import ImageFont

    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont)
    return font


# An episode as a moving drawing: one SVG file that any browser plays, light or dark, without a program inside.

_FILM_WIDTH = 800
_HOLD_S = 2.5  # the end stands so long before the drawing begins again
_STRIP = 132  # height of one agent's road
_FOOT = 34  # below the last road: the clock
_FILM_LANE, _HALF_ROAD, _HALF_BODY = 82, 24, 13  # pixels from a strip's top; halves of heights
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
        texts = [
            f"harm {scene.first_harm:.1f} by first impacts, {scene.total_harm:.1f} in total" for scene in self._film
        ]
        for words in dict.fromkeys(texts):  # the harm so far, at the times at which it is that
            lit = [each == words for each in texts]
            yield (
                f'<text x="{_FILM_WIDTH - 12}" y="22" text-anchor="end" opacity="{int(lit[0])}">{words}'
                f"{self._switched(lit)}</text>"
            )
        top = _FILM_LANE - _HALF_ROAD
        yield f'<rect y="{top}" width="{_FILM_WIDTH}" height="{2 * _HALF_ROAD}" fill="var(--road)"/>'
        for place in range(math.ceil(self._left / 10) * 10, math.floor(self._left + _FILM_WIDTH / self._scale) + 1, 10):
            x = self._x(place)
            yield f'<path d="M{x:.1f} {top}v{2 * _HALF_ROAD}" stroke="var(--mark)" stroke-width="1.5"/>'
        obstacle = self._film[0].obstacle_m
        if math.isfinite(obstacle):
            yield f'<rect x="{self._x(obstacle):.1f}" y="{top}" width="9" height="{2 * _HALF_ROAD}" fill="var(--ink)"/>'
        for i in range(len(self._film[0].front_m)):
            yield from self._vehicle(i)
        for start, until, struck in self._events():  # above the road, the closing speed of each impact
            x = self._x(self._film[start].front_m[struck.pair + 1])
            lit = [start <= k < until for k in range(len(self._film))]
            yield (
                f'<text class="impact" x="{min(max(x, 90), _FILM_WIDTH - 90):.1f}" y="46" opacity="0">'
                f"{struck.who}: {struck.speed}{self._switched(lit)}</text>"
            )

    def _vehicle(self, i: int) -> Iterator[str]:
        """The body that moves, with its number and the lights of its command."""
        places = [self._x(scene.front_m[i]) for scene in self._film]
        length, top = BODY_M * self._scale, _FILM_LANE - _HALF_BODY
        yield f'<g transform="translate({places[0]:.1f} 0)">'
        yield (
            f'<rect x="{-length:.1f}" y="{top}" width="{length:.1f}" height="{2 * _HALF_BODY}" rx="3"'
            f' fill="{vehicle_colour(i)}"/>'
            f'<text class="number" x="{-length / 2:.1f}" y="{_FILM_LANE + 5}">{i + 1}</text>'
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
        for start, until, struck in self._events():  # at its front, a star for each of its impacts with what is ahead
            if struck.pair + 1 == i:
                points = " ".join(f"{x:.1f},{y:.1f}" for x, y in star(0.0, _FILM_LANE, 17, 8))
                lit = [start <= k < until for k in range(len(self._film))]
                yield (
                    f'<polygon points="{points}" fill="var(--flash)" stroke="#c1121f" opacity="0">'
                    f"{self._switched(lit)}</polygon>"
                )
        values = ";".join(f"{place:.1f} 0" for place in places)
        yield (
            '<animateTransform attributeName="transform" type="translate" repeatCount="indefinite"'
            f' dur="{self._duration_s():g}s" values="{values}"/></g>'
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

    def closed(self, engine: Engine) -> Motion:
        """The motion that has led to where the engine is."""
        worlds = engine.worlds
        command = np.where(self.fresh[:, np.newaxis], worlds.command_mps2, self.command_mps2)
        parts = tuple(engine.segments(self.start, command))
        return replace(self, command_mps2=command, until_s=worlds.time_s, parts=parts)

    def scenes(self, engine: Engine, row: int, times_s: Floats | None = None) -> list[Scene]:
        """What world ``row`` shows at these times of a closed motion [k], or at its end alone."""
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
            told = zip(impacts.pair.tolist(), impacts.closing_speed_mps.tolist(), impacts.time_s.tolist(), strict=True)
            struck += [Struck(*each) for each in told]
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
        v, n = alert.vehicles, alert.n
        # The view holds each line from the alert to rest, if all brake fully as soon as they can; a vehicle behind that
        # stops later is taken to push the ones ahead so far.
        behind = np.concatenate([np.zeros((n, 1)), np.cumsum(alert.gaps_m, axis=1)], axis=1)
        reaction = alert.speeds_mps * np.minimum(v.latency_s, _LATE_S)
        rising = (
            alert.speeds_mps * v.braking_capacity_mps2 / (2.0 * v.brake_rate_mps3)
        )  # at most, while brakes build up
        way = reaction + rising + alert.speeds_mps**2 / (2.0 * v.braking_capacity_mps2)
        left = -behind[:, -1] - alert.N * BODY_M - _BEHIND_M
        right = np.minimum((way - behind).max(axis=1), alert.obstacle_gap_m) + _AHEAD_M
        new = Motion(
            alert, np.zeros(alert.speeds_mps.shape), np.full(n, np.nan), np.ones(n, np.bool_), np.zeros(n),
            np.zeros((n, 2)), left, np.maximum(right, left + _LEAST_WIDTH_M), np.zeros((0, 4)), None,
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
        """Close the motion that led to this step, and begin the step's own."""
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
        """The motions that are kept, all ended. Raises ``InvalidInput`` before the first reset."""
        memory: Memory = engine.memory(self)
        if not memory:
            raise InvalidInput("render: no episode was started; call reset first")
        return (*memory[:-1], memory[-1].closed(engine))


def _rows(worlds: Worlds, command: Floats, until_s: Floats) -> ImpactRows:
    rows = advance(worlds, command, until_s=until_s, record=True)[1].rows
    assert rows is not None  # they were asked for
    return rows


# ``render()`` of every interface: modes, frames since the last call, and the window.


class Window:
    """The window of ``render_mode="human"``; it opens with its first frame, and stays closed once its user closes it.

    A copy is a window of its own. Raises ``MissingExtra`` where its library is missing.
    """

    def __init__(self) -> None:
        need("pygame")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # importing a library says nothing
        import pygame

        self._pygame: Any = pygame
        self._screen: Any = None
        self._clock: Any = None
        self.closed_by_user = False  # until an episode begins

    def __reduce__(self) -> tuple[type[Window], tuple[()]]:
        return Window, ()

    def show(self, frame: Frame, fps: float) -> None:
        """Show a frame [H, W, 3] for 1/fps seconds. Raises ``InvalidInput`` where there is no display."""
        if self.closed_by_user:
            return
        pygame = self._pygame
        if self._screen is None:
            try:
                pygame.display.init()
                self._screen = pygame.display.set_mode((WIDTH, HEIGHT))
            except pygame.error as error:
                raise InvalidInput(
                    f"render_mode = 'human': no window can be opened here ({error}); 'rgb_array' needs no display"
                ) from None
            pygame.display.set_caption("EthBrake")
            self._clock = pygame.time.Clock()
        self._screen.blit(pygame.image.frombuffer(frame.tobytes(), (WIDTH, HEIGHT), "RGB"), (0, 0))
        pygame.display.flip()
        self._clock.tick(fps)
        if any(event.type == pygame.QUIT for event in pygame.event.get()):
            self.close()
            self.closed_by_user = True

    def close(self) -> None:
        """Close the window, if it is open."""
        if self._screen is not None:
            self._pygame.display.quit()
            self._screen = self._clock = None


SMOOTH_FPS = 50  # frames per second of the window, and of ``step_frames``


class Viewer:
    """Shows the running episodes of an engine; the window is imported when it is first asked for.

    Args:
        engine: what is shown, from its next reset on.
        mode: one of the interface's modes, or None: nothing is kept, and nothing can be shown.
        batch: the interface has many worlds at once, and shows each.

    Raises ``InvalidInput`` for another mode, and for ``human`` where its library is missing.

    """

    METADATA: ClassVar[dict[str, Any]] = {  # of a class; each environment has its own fps
        "render_modes": ["human", "rgb_array", "rgb_array_list", "ansi"],
        "render_fps": 10,
    }

    def __init__(self, engine: Engine, mode: str | None, *, batch: bool = False) -> None:
        self.modes: list[str] = ["rgb_array", "ansi"] if batch else self.METADATA["render_modes"]
        if mode is not None and mode not in self.modes:
            known = ", ".join(map(repr, self.modes))
            raise InvalidInput(f"render_mode = {mode!r}: must be {known}, or None")
        self.mode = mode
        self._engine, self._batch = engine, batch
        self._window = Window() if mode == "human" else None
        self._trace = None if mode is None else Trace(engine, whole=mode == "rgb_array_list")
        self._shown = 0  # motions of the running episode that a list of frames has shown

    @property
    def metadata(self) -> dict[str, Any]:
        """``render_modes``, and the ``render_fps`` at which one frame per step plays in real time."""
        fps = 1.0 / self._engine.scenario.time_step_s
        return {"render_modes": list(self.modes), "render_fps": round(fps) if abs(fps - round(fps)) < 1e-9 else fps}

    def began(self) -> None:
        """An episode has begun: the list of frames starts anew, and the window shows the way to the first decision."""
        self._shown = 0
        if self._window is not None:
            self._window.closed_by_user = False
            self.play()

    def play(self) -> None:
        """Show what the last step brought in the window, in real time; nothing in other modes."""
        if self._window is not None:
            for frame in self.step_frames():
                self._window.show(frame, SMOOTH_FPS)

    def render(self) -> Any:
        """What the mode says of the world, or of each of a batch; None for ``human``, where every step shows itself."""
        motions = self._motions(f"render: made with render_mode=None; give one of {', '.join(self.modes)}")
        if self.mode == "human":
            return None
        if self.mode == "rgb_array_list":  # one frame for the beginning and each step that no list has shown yet
            new, self._shown = motions[self._shown :], len(motions)
            return [motion.scenes(self._engine, 0)[-1].frame() for motion in new]
        scenes = [motions[-1].scenes(self._engine, k)[-1] for k in range(self._engine.n)]
        shown = tuple(scene.text() if self.mode == "ansi" else scene.frame() for scene in scenes)
        return shown if self._batch else shown[0]

    def step_frames(self, fps: float = SMOOTH_FPS) -> list[Frame]:
        """The frames [H, W, 3] between the last decision, or the alert, and now: ``fps`` in a second of the world.

        Raises ``InvalidInput`` before the first reset, with render_mode=None, and for an ``fps`` below 1.
        """
        check_whole_number("step_frames: fps", fps, 1)
        motion = self._motions("step_frames: made with render_mode=None; give 'rgb_array'")[-1]
        start, until = float(motion.start.time_s[0]), float(motion.until_s[0])
        times: Floats = np.linspace(start, until, max(round((until - start) * fps), 1) + 1)[1:]  # the last is its end
        return [scene.frame() for scene in motion.scenes(self._engine, 0, times)]

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()

    def _motions(self, refusal: str) -> Memory:
        if self._trace is None:
            raise InvalidInput(f"{refusal} when it is made")
        return self._trace.motions(self._engine)
