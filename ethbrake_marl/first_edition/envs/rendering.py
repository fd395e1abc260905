"""Pictures for ``render()``: one moment of one world, drawn as a text or as an image."""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import plain_text
from ethbrake_marl.first_edition.physics.state import Bools, Floats

if TYPE_CHECKING:
    from PIL import ImageDraw, ImageFont

Frame = NDArray[np.uint8]  # [HEIGHT, WIDTH, 3]

BODY_M = 4.5  # drawn length of a vehicle (m); in the physics, vehicles have no length

FLASH_S = 0.3  # time for which an impact is shown (s)

# Palette of Okabe and Ito for colour-blind readers, without its yellow, which is hard to see on white.
COLOURS = ("#000000", "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")

_TEXT_WIDTH = 100  # width of the road in characters

BEHIND_M, AHEAD_M = 3.0, 5.0  # smallest length of free road to show behind and ahead of the line (m)

LEAST_WIDTH_M = 40.0  # smallest length of road to show (m)

LATE_S = 3.0  # longest latency that is considered when the length of road is chosen (s)


class View(NamedTuple):
    """The part of the road that a picture shows.

    Positions are distances (m) from the place of Vehicle 1's front bumper at the alert, positive in the direction of
    travel.
    """

    left_m: float  # position of the left end (m)
    right_m: float  # position of the right end (m)


class Struck(NamedTuple):
    """An impact that a picture shows."""

    pair: int  # index of the pair, 0 for Vehicles 1 and 2; -1: Vehicle 1 and the obstacle
    closing_mps: float  # closing speed (m/s)
    time_s: float  # time since the alert (s)

    @property
    def who(self) -> str:
        """The two parties of the impact, such as "Vehicles 1 and 2"."""
        return "Vehicle 1 and the obstacle" if self.pair < 0 else f"Vehicles {self.pair + 1} and {self.pair + 2}"

    @property
    def speed(self) -> str:
        """Closing speed of the impact, such as "3.2 m/s" or "< 0.1 m/s"."""
        return f"{self.closing_mps:.1f} m/s" if self.closing_mps >= 0.05 else "< 0.1 m/s"


class Scene(NamedTuple):
    """Everything that a picture shows of one world at one moment."""

    title: str  # name of the scenario
    time_s: float  # time since the alert (s)
    view: View  # stretch of road that is shown
    # [N] positions at which the front bumpers are drawn (m, relative to Vehicle 1's front at the alert). Vehicles are
    # drawn with the length BODY_M and at their true gaps, although they have no length in the physics.
    front_m: Floats
    gaps_m: Floats  # [P] gap of each pair of neighbours (m)
    speeds_mps: Floats  # [N] speed of each vehicle (m/s)
    command_mps2: Floats  # [N] command in force (m/s2); 0 before the latency has elapsed
    braking_mps2: Floats  # [N] braking capacities (m/s2)
    driving_mps2: Floats  # [N] driving capacities (m/s2)
    latency_s: Floats  # [N] time since the alert at which each vehicle may act (s)
    hit: Bools  # [P] whether the pair has had an impact
    struck: tuple[Struck, ...]  # impacts during the last FLASH_S seconds
    first_harm: float  # first-impact harm of the line so far (m2/s2)
    total_harm: float  # total harm of the line so far (m2/s2)
    obstacle_m: float  # position of the obstacle (m, relative to Vehicle 1's front at the alert); infinite: none
    learners: tuple[int, ...]  # indices of the learners (0 = front)
    shield: bool | None  # whether a shield replaced the action; None: there is no shield
    ended: bool  # whether the episode has ended

    @property
    def shield_words(self) -> str:
        """Text about the shield in this step: "shield: stepped in" (replaced an action) or "shield: let it pass"."""
        return "shield: stepped in" if self.shield else "shield: let it pass"

    def command_words(self, i: int) -> str:
        """Return a text about the command that vehicle ``i`` executes, such as "brakes 3.0 m/s2"."""
        command = float(self.command_mps2[i])
        if self.latency_s[i] > self.time_s:
            return f"acts from {self.latency_s[i]:.2f} s" if math.isfinite(self.latency_s[i]) else "never acts"
        if command == 0.0:
            return "coasts"
        return f"{'brakes' if command < 0.0 else 'drives'} {abs(command):.1f} m/s2"

    def text(self) -> str:
        """Return the scene as text: one line shows the road to scale, and one line describes each vehicle."""
        left, right = self.view

        def column(place_m: float) -> int:
            return min(max(int((float(place_m) - left) / (right - left) * _TEXT_WIDTH), 0), _TEXT_WIDTH - 1)

        road, lines = ["."] * _TEXT_WIDTH, []
        for i in range(len(self.front_m) - 1, -1, -1):
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
        facts = [
            f"{self.title}  {self.time_s:.2f} s after the alert{'  (ended)' if self.ended else ''}",
            "".join(road),
            *reversed(lines),
            f"harm {self.first_harm:.2f} m2/s2 by first impacts, {self.total_harm:.2f} in total",
            *(f"impact: {struck.who} at {struck.speed}, {struck.time_s:.2f} s" for struck in self.struck),
        ]
        return "\n".join([*facts, self.shield_words] if self.shield is not None else facts) + "\n"

    def frame(self) -> Frame:
        """Return the scene as a picture, [H, W, 3] uint8. If two scenes are equal, their pictures are equal, too."""
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
    """Return the colour of vehicle ``i`` (0 = front) in all pictures, such as ``#0072B2``."""
    return COLOURS[(i + 1) % len(COLOURS)]


def follow(view: View, front_m: Floats) -> View:
    """Return a new view: ``view``, moved forward and widened until it contains the whole line of vehicles.

    ``front_m`` [N] are the positions at which the front bumpers are drawn (m).
    """
    on = max(float(front_m[0]) + AHEAD_M - view.right_m, 0.0)
    left = min(view.left_m + on, float(front_m[-1]) - BODY_M - BEHIND_M)
    return View(left if on else min(left, view.left_m), view.right_m + on)


def star(x: float, y: float, far: float, near: float) -> list[tuple[float, float]]:
    """Return the 16 corners of a star with eight points and the centre (x, y).

    ``far`` and ``near`` are the distances of the points and of the inner corners from the centre.
    """
    return [
        (x + r * math.cos(k * math.pi / 8), y + r * math.sin(k * math.pi / 8)) for k, r in enumerate([far, near] * 8)
    ]


WIDTH, HEIGHT = 800, 304  # multiples of 16, for video codecs

_MARGIN = 12

_ROAD_TOP, _ROAD_BOTTOM = 84, 138

_LANE = (_ROAD_TOP + _ROAD_BOTTOM) // 2

_BODY = 13  # half of a body's height

_PANEL_TOP = 172

_TITLE = 540  # largest width of the title, beside the clock

_FINE = 2  # factor by which shapes are drawn larger, for smooth edges

_PAPER, _INK, _GREY = "#ffffff", "#1a1a1a", "#6b6b6b"

_ASPHALT, _DASH = "#4a4d52", "#e8e8e8"

_BRAKE, _DRIVE, _FLASH, _SHIELD = "#c1121f", "#2a7f3f", "#ffd60a", "#6a3d9a"


class _Pen:
    """Pen that draws on a picture ``_FINE`` times as large as the final one; shrinking the picture smooths the edges.

    All coordinates are in pixels of the final picture.
    """

    def __init__(self, draw: ImageDraw.ImageDraw) -> None:
        self._draw = draw

    def box(self, left: float, top: float, right: float, bottom: float, fill: str, edge: str | None = None) -> None:
        """Draw a box with slightly round corners in the colour ``fill``, with an edge in the colour ``edge``."""
        corners = [value * _FINE for value in (left, top, max(right, left + 1), max(bottom, top + 1))]
        self._draw.rounded_rectangle(corners, 2 * _FINE, fill=fill, outline=edge, width=_FINE * 2)

    def line(self, x1: float, y1: float, x2: float, y2: float, colour: str, width: float = 1.0) -> None:
        """Draw a straight line from (x1, y1) to (x2, y2), ``width`` pixels wide."""
        self._draw.line([x1 * _FINE, y1 * _FINE, x2 * _FINE, y2 * _FINE], fill=colour, width=round(width * _FINE))

    def shape(self, points: list[tuple[float, float]], fill: str, edge: str | None = None) -> None:
        """Draw a polygon with the corners ``points`` in the colour ``fill``, with an edge in the colour ``edge``."""
        self._draw.polygon([(x * _FINE, y * _FINE) for x, y in points], fill=fill, outline=edge, width=_FINE)


def _draw_road(pen: _Pen, scene: Scene) -> None:
    pen.box(0, _ROAD_TOP, WIDTH, _ROAD_BOTTOM, _ASPHALT)
    for place in _marks(scene, 5.0):  # dashes of 2 m at the edges of the lane
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
    """Draw the panel of vehicle ``i``. Its bar extends to the left for braking and to the right for driving."""
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
    for left, right, gap_m, hit in _spaces(scene):  # a label without enough space is written one line higher
        middle, words = (left + right) / 2, f"{gap_m:.1f} m"
        half = _font(14).getlength(words) / 2 + 3
        high = middle + half > free
        colour = _BRAKE if hit else _INK
        text.text((middle, _ROAD_TOP - (27 if high else 13)), words, colour, _font(14), anchor="ms")
        free = math.inf if high else middle - half
    if scene.struck:  # write the hardest current impact of each pair, for at most two pairs
        hardest = {struck.pair: struck for struck in sorted(scene.struck, key=lambda struck: struck.closing_mps)}
        hits = sorted(hardest.values(), key=lambda struck: -struck.closing_mps)[:2]
        words = "impact of " + ", ".join(f"{struck.who} at {struck.speed}" for struck in hits)
        half = _font(15).getlength(words) / 2
        middle = sum(_contact(scene, struck) for struck in hits) / len(hits)
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
    """Return the first of ``words`` that is at most ``width`` pixels wide; if all are wider, return the last one."""
    return next((each for each in words if _font(size).getlength(each) <= width), words[-1])


def _share(scene: Scene, i: int) -> float:
    """Return the command of vehicle ``i`` as a share of its capacity, from -1 (brake fully) to 1 (drive fully)."""
    command = float(scene.command_mps2[i])
    capacity = float((scene.braking_mps2 if command < 0.0 else scene.driving_mps2)[i])
    return command / capacity if command != 0.0 else 0.0


def _panel(scene: Scene, i: int) -> tuple[float, float]:
    """Return left edge and width (pixels) of the panel of vehicle ``i``. The panel of Vehicle 1 is on the right."""
    count = len(scene.front_m)
    gap = 24.0 if count <= 5 else 10.0
    width = min((WIDTH - 2 * _MARGIN - gap * (count - 1)) / count, 240.0)
    return WIDTH - _MARGIN - width - i * (WIDTH - 2 * _MARGIN - width) / max(count - 1, 1), width


def _x(scene: Scene, place_m: float) -> float:
    """Return the horizontal position (pixels) of the place ``place_m`` on the road (m)."""
    return (float(place_m) - scene.view.left_m) / (scene.view.right_m - scene.view.left_m) * WIDTH


def _spaces(scene: Scene) -> list[tuple[float, float, float, bool]]:
    """Return the gap to an obstacle, if there is one, and the gaps between the vehicles, from front to rear.

    A gap is a tuple: left end (pixels), right end (pixels), length (m), and whether the bodies at its ends have had an
    impact.
    """
    front, obstacle = float(scene.front_m[0]), scene.obstacle_m
    spaces = [(_x(scene, front), _x(scene, obstacle), obstacle - front, any(s.pair < 0 for s in scene.struck))]
    for p, gap in enumerate(scene.gaps_m.tolist()):
        left, right = _x(scene, scene.front_m[p + 1]), _x(scene, scene.front_m[p] - BODY_M)
        spaces.append((left, right, gap, bool(scene.hit[p])))
    return spaces if math.isfinite(obstacle) else spaces[1:]


def _marks(scene: Scene, every_m: float) -> list[float]:
    """Return all positions (m) in view that are multiples of ``every_m`` (m)."""
    first, last = math.ceil(scene.view.left_m / every_m), math.floor(scene.view.right_m / every_m)
    return [k * every_m for k in range(first, last + 1)]


def _spacing(scene: Scene) -> float:
    """Return a distance (m) between labelled marks on the road, so large that at most about 12 marks are in view."""
    width = scene.view.right_m - scene.view.left_m
    return next((every for every in (5.0, 10.0, 20.0, 50.0, 100.0, 200.0) if width <= 12 * every), 500.0)


def _contact(scene: Scene, struck: Struck) -> float:
    """Return the horizontal position (pixels) in the picture where an impact is drawn: between the two bodies."""
    if struck.pair < 0:
        return _x(scene, scene.front_m[0])
    return (_x(scene, scene.front_m[struck.pair + 1]) + _x(scene, scene.front_m[struck.pair] - BODY_M)) / 2


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    """Return Pillow's built-in font in the size ``size``. This font is the same on every computer."""
    from PIL import ImageFont

    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont)
    return font
