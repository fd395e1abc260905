"""A scene as a picture: pixels, drawn with Pillow, whose font is the same on every computer; or SVG, for slides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from ethbrake_marl.errors import plain_text
from ethbrake_marl.extensions.rendering.scene import BODY_M, Impact, Scene
from ethbrake_marl.motion.layout import GAP, HIT, MASS, SPEED

Frame = NDArray[np.uint8]  # [HEIGHT, WIDTH, 3]

WIDTH, HEIGHT = 800, 304  # multiples of 16, for video codecs
FINE = 2  # everything is drawn so much larger, and shrunk, for smooth edges
MARGIN = 12
ROAD_TOP, ROAD_BOTTOM = 84, 138
LANE = (ROAD_TOP + ROAD_BOTTOM) // 2
BODY = 13  # half of a body's height
TRUCK_T = 12.0  # a vehicle of this mass is drawn as a truck: the EU's category N3
PANEL_TOP = 172
SPACINGS_M = (5.0, 10.0, 20.0, 50.0, 100.0, 200.0)  # between written distances, of which at most twelve are in view

SVG_ANCHORS = {  # of Pillow -> of SVG, and way down to the baseline as a share of the size
    "la": ("start", 0.8), "ra": ("end", 0.8), "ma": ("middle", 0.8), "mm": ("middle", 0.36), "ms": ("middle", 0.0),
}  # fmt: skip

PAPER, INK, GREY, PALE = "#ffffff", "#1a1a1a", "#6b6b6b", "#eeeeee"
ASPHALT, DASH, GLASS = "#4a4d52", "#e8e8e8", "#dfefff"
BRAKE, DRIVE, FLASH, LIGHT = "#c1121f", "#2a7f3f", "#ffd60a", "#ff2b2b"
# Palette of Okabe and Ito for colour-blind readers, without its yellow, which is hard to see on white.
PALETTE = ("#000000", "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")


def vehicle_colour(body: int) -> str:
    return PALETTE[body % len(PALETTE)]


@cache
def font(size: int) -> Any:
    return ImageFont.load_default(size * FINE)


def text_width(words: str, size: int) -> float:
    return float(font(size).getlength(words)) / FINE


def fitting(choices: Sequence[str], width: float, size: int) -> str:
    """First of ``choices`` that is at most ``width`` pixels wide in the font size ``size``, else the last."""
    return next((words for words in choices if text_width(words, size) <= width), choices[-1])


class Pen:
    """Draws one scene. Coordinates are in pixels of the finished picture; places on the road are in m."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.fronts_m, (self.left_m, self.right_m) = scene, scene.fronts_m, scene.shown_m
        self.image = Image.new("RGB", (WIDTH * FINE, HEIGHT * FINE), PAPER)
        self.draw = ImageDraw.Draw(self.image)

    def x(self, place_m: float) -> float:
        return (place_m - self.left_m) / (self.right_m - self.left_m) * WIDTH

    def ends(self, body: int) -> tuple[float, float]:
        if body == 0:
            return self.x(self.scene.obstacle_m), self.x(self.scene.obstacle_m) + 9
        return self.x(self.fronts_m[body - 1] - BODY_M), self.x(self.fronts_m[body - 1])

    def marks(self, every_m: float) -> list[float]:
        first, last = math.ceil(self.left_m / every_m), math.floor(self.right_m / every_m)
        return [k * every_m for k in range(first, last + 1)]

    def box(self, left: float, top: float, right: float, bottom: float, fill: str, edge: str | None = None) -> None:
        corners = [value * FINE for value in (left, top, max(right, left + 1), max(bottom, top + 1))]
        self.draw.rounded_rectangle(corners, 2 * FINE, fill=fill, outline=edge, width=2 * FINE)

    def line(self, x1: float, y1: float, x2: float, y2: float, colour: str, width: float = 1.0) -> None:
        self.draw.line([x1 * FINE, y1 * FINE, x2 * FINE, y2 * FINE], fill=colour, width=round(width * FINE))

    def shape(self, points: Sequence[tuple[float, float]], fill: str, edge: str | None = None) -> None:
        self.draw.polygon([(x * FINE, y * FINE) for x, y in points], fill=fill, outline=edge, width=FINE)

    def write(self, x: float, y: float, words: str, colour: str, size: int, anchor: str = "la") -> None:
        self.draw.text((x * FINE, y * FINE), words, colour, font(size), anchor=anchor)

    def frame(self) -> Frame:
        return np.array(self.image.reduce(FINE))


class VectorPen(Pen):
    """Pen whose ``elements`` are SVG, without a background. Text is as wide as in the reader's font."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self.elements = list[str]()

    def box(self, left: float, top: float, right: float, bottom: float, fill: str, edge: str | None = None) -> None:
        self.elements.append(
            f'<rect x="{left:.2f}" y="{top:.2f}" width="{max(right - left, 1):.2f}" height="{max(bottom - top, 1):.2f}"'
            f' rx="2" fill="{fill}" stroke="{edge or "none"}"/>'
        )

    def line(self, x1: float, y1: float, x2: float, y2: float, colour: str, width: float = 1.0) -> None:
        self.elements.append(
            f'<path d="M{x1:.2f} {y1:.2f}L{x2:.2f} {y2:.2f}" stroke="{colour}" stroke-width="{width}"/>'
        )

    def shape(self, points: Sequence[tuple[float, float]], fill: str, edge: str | None = None) -> None:
        places = " ".join(f"{x:.2f},{y:.2f}" for x, y in points)
        self.elements.append(f'<polygon points="{places}" fill="{fill}" stroke="{edge or "none"}"/>')

    def write(self, x: float, y: float, words: str, colour: str, size: int, anchor: str = "la") -> None:
        across, down = SVG_ANCHORS[anchor]
        self.elements.append(
            f'<text x="{x:.2f}" y="{y + down * size:.2f}" text-anchor="{across}" font-size="{size}" fill="{colour}">'
            f"{escape(words)}</text>"
        )


def picture(scene: Scene) -> Frame:
    """Picture of a scene, [304, 800, 3] uint8."""
    pen = Pen(scene)
    draw_scene(pen)
    return pen.frame()


def vector_picture(scene: Scene) -> str:
    """SVG elements of a picture of a scene."""
    pen = VectorPen(scene)
    draw_scene(pen)
    return "\n".join(pen.elements)


def draw_scene(pen: Pen) -> None:
    scene = pen.scene
    draw_road(pen)
    for body in range(1, len(scene.wanted)):
        draw_vehicle(pen, body)
        draw_panel(pen, body)
    write_gaps(pen)
    show_impacts(pen)
    title = plain_text(scene.title)[:200]
    cut = [title, *(f"{title[:k]}..." for k in range(len(title), -1, -1))]
    pen.write(MARGIN, 10, fitting(cut, WIDTH - 3 * MARGIN - text_width(scene.clock, 18), 15), GREY, 15)
    pen.write(WIDTH - MARGIN, 8, scene.clock, INK, 18, "ra")
    pen.write(MARGIN, HEIGHT - 22, scene.harm, INK, 15)


def draw_road(pen: Pen) -> None:
    """Draw the road with distances (m), and the obstacle."""
    pen.box(0, ROAD_TOP, WIDTH, ROAD_BOTTOM, ASPHALT)
    for place_m in pen.marks(5.0):
        for y in (ROAD_TOP + 5, ROAD_BOTTOM - 5):
            pen.line(pen.x(place_m), y, pen.x(place_m + 2.0), y, DASH, 1.5)
    spacing_m = next((every for every in SPACINGS_M if pen.right_m - pen.left_m <= 12 * every), 500.0)
    for place_m in pen.marks(spacing_m):
        x = pen.x(place_m)
        pen.line(x, ROAD_BOTTOM, x, ROAD_BOTTOM + 5, GREY)
        if 20 <= x <= WIDTH - 20:
            pen.write(x, ROAD_BOTTOM + 7, f"{place_m:.0f} m", GREY, 12, "ma")
    if pen.scene.has_obstacle:
        left, right = pen.ends(0)
        pen.box(left, ROAD_TOP + 4, right, ROAD_BOTTOM - 4, INK, FLASH)


def draw_vehicle(pen: Pen, body: int) -> None:
    left, right = pen.ends(body)
    if pen.scene.car[MASS, body] >= TRUCK_T:  # a trailer, wider than the cab, and the coupling between them
        cab, trailer = left + (right - left) * 0.7, left + (right - left) * 0.62
        pen.line(trailer, LANE, cab, LANE, INK, 4.0)
        pen.box(cab, LANE - BODY + 2, right, LANE + BODY - 2, vehicle_colour(body))
        pen.box(left, LANE - BODY - 2, trailer, LANE + BODY + 2, vehicle_colour(body))
    else:
        pen.box(left, LANE - BODY, right, LANE + BODY, vehicle_colour(body))
    glass = left + (right - left) * 0.72
    pen.box(glass, LANE - BODY + 4, glass + (right - left) * 0.1, LANE + BODY - 4, GLASS)
    if pen.scene.command(body) < 0.0:
        for y in (LANE - BODY, LANE + BODY - 6):
            pen.box(left, y, left + 4, y + 6, LIGHT)
    if body in pen.scene.learners:
        middle = (left + right) / 2
        pen.shape([(middle - 6, ROAD_TOP + 1), (middle + 6, ROAD_TOP + 1), (middle, ROAD_TOP + 10)], PAPER)
    pen.write(left + (right - left) * 0.45, LANE, str(body), PAPER, 16, "mm")


def draw_panel(pen: Pen, body: int) -> None:
    scene, count = pen.scene, len(pen.scene.wanted) - 1
    gap = 24.0 if count <= 5 else 10.0
    width = min((WIDTH - 2 * MARGIN - gap * (count - 1)) / count, 240.0)
    left = WIDTH - MARGIN - width - (body - 1) * (WIDTH - 2 * MARGIN - width) / max(count - 1, 1)
    pen.box(left, PANEL_TOP, left + 20, PANEL_TOP + 18, vehicle_colour(body))
    pen.write(left + 10, PANEL_TOP + 9, str(body), PAPER, 15, "mm")
    names = [f"Vehicle {body}, learner", "learner", "L"] if body in scene.learners else [f"Vehicle {body}", ""]
    pen.write(left + 26, PANEL_TOP + 2, fitting(names, width - 26, 14), INK, 14)
    speed = f"{scene.line[SPEED, body]:.1f}"
    pen.write(left, PANEL_TOP + 28, fitting([f"{speed} m/s", speed], width, 20), INK, 20)
    top, middle, share, said = PANEL_TOP + 62, left + width / 2, scene.share(body), scene.said_of(body)
    pen.box(left, top, left + width, top + 12, PALE)
    if share:
        end = middle + share * width / 2
        pen.box(min(middle, end), top, max(middle, end), top + 12, BRAKE if share < 0.0 else DRIVE)
    pen.line(middle, top - 3, middle, top + 15, INK)
    exact = [f"{said} ({abs(share) * 100:.0f} %)"] if share else []
    pen.write(left, PANEL_TOP + 78, fitting([*exact, said, ""], width, 13), GREY, 13)


def write_gaps(pen: Pen) -> None:
    """Write every gap (m) above the road, one line higher where two texts would overlap."""
    free = math.inf
    for pair in range(0 if pen.scene.has_obstacle else 1, len(pen.scene.wanted) - 1):
        left, right = pen.ends(pair + 1)[1], pen.ends(pair)[0]
        for x in (left, right):
            pen.line(x, ROAD_TOP - 10, x, ROAD_TOP - 2, GREY)
        pen.line(left, ROAD_TOP - 6, right, ROAD_TOP - 6, GREY)
        words = f"{pen.scene.line[GAP, pair]:.1f} m"
        middle, half = (left + right) / 2, text_width(words, 14) / 2 + 3
        high = middle + half > free
        colour = BRAKE if pen.scene.line[HIT, pair] else INK
        pen.write(middle, ROAD_TOP - (27 if high else 13), words, colour, 14, "ms")
        free = math.inf if high else middle - half


def show_impacts(pen: Pen) -> None:
    """Draw a star at every recent impact, and write the closing speeds (m/s) of the two hardest."""

    def x(impact: Impact) -> float:
        return (pen.ends(impact.pair + 1)[1] + pen.ends(impact.pair)[0]) / 2

    for impact in pen.scene.impacts:
        points = [
            (x(impact) + r * math.cos(k * math.pi / 8), LANE + r * math.sin(k * math.pi / 8))
            for k, r in enumerate([17, 8] * 8)
        ]
        pen.shape(points, FLASH, BRAKE)
    hardest = sorted(pen.scene.impacts, key=lambda impact: -impact.closing_mps)[:2]
    if hardest:
        words = "impact of " + ", ".join(str(impact) for impact in hardest)
        half = text_width(words, 15) / 2
        middle = sum(x(impact) for impact in hardest) / len(hardest)
        middle = min(max(middle, MARGIN + half), WIDTH - MARGIN - half)
        pen.box(middle - half - 5, 26, middle + half + 5, 45, FLASH)  # between the title and the higher row of gaps
        pen.write(middle, 35.5, words, INK, 15, "mm")
