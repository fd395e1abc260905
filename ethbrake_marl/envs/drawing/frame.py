"""A moment as pixels: the road to scale, below it a panel for each vehicle; and the window that shows such frames.

Importing this file imports Pillow; pygame is imported by the first window.
"""

from __future__ import annotations

import math
import os
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from ethbrake_marl.envs.drawing.scene import (
    BODY_M,
    Scene,
    Struck,
    command_words,
    pair_words,
    shield_words,
    speed_words,
    star,
    vehicle_colour,
)
from ethbrake_marl.errors import InvalidInput, need, plain_text

Frame = NDArray[np.uint8]  # [HEIGHT, WIDTH, 3]

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


class _Space(NamedTuple):
    """The free road between two neighbours (pixels), and its length."""

    left: float
    right: float
    gap_m: float
    hit: bool


def draw_frame(scene: Scene) -> Frame:
    """The moment as a picture; the same moment gives the same bytes."""
    image = Image.new("RGB", (WIDTH * _FINE, HEIGHT * _FINE), _PAPER)
    pen = _Pen(ImageDraw.Draw(image))
    _draw_road(pen, scene)
    for i in range(len(scene.front_m)):
        _draw_panel(pen, scene, i)
    fine = image.reduce(_FINE)
    text = ImageDraw.Draw(fine)
    _write_head(text, scene)
    _write_road(text, scene)
    for i in range(len(scene.front_m)):
        _write_panel(text, scene, i)
    return np.array(fine)


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
    for space in _spaces(scene):
        for x in (space.left, space.right):
            pen.line(x, _ROAD_TOP - 10, x, _ROAD_TOP - 2, _GREY)
        pen.line(space.left, _ROAD_TOP - 6, space.right, _ROAD_TOP - 6, _GREY)
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
        words, colour = shield_words(scene.shield), _SHIELD if scene.shield else _GREY
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
    for space in _spaces(scene):  # from the right; a label without room stands one line higher
        middle, words = (space.left + space.right) / 2, f"{space.gap_m:.1f} m"
        half = _font(14).getlength(words) / 2 + 3
        high = middle + half > free
        colour = _BRAKE if space.hit else _INK
        text.text((middle, _ROAD_TOP - (27 if high else 13)), words, colour, _font(14), anchor="ms")
        free = math.inf if high else middle - half
    if scene.struck:
        _write_impacts(text, scene)


def _write_impacts(text: ImageDraw.ImageDraw, scene: Scene) -> None:
    """The hardest impact of each pair that is being shown, the two hardest of them, above the line."""
    hardest = {struck.pair: struck for struck in sorted(scene.struck, key=lambda struck: struck.closing_mps)}
    told = sorted(hardest.values(), key=lambda struck: -struck.closing_mps)[:2]
    words = "impact of " + ", ".join(
        f"{pair_words(struck.pair)} at {speed_words(struck.closing_mps)}" for struck in told
    )
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
    words = command_words(scene, i)
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


def _spaces(scene: Scene) -> list[_Space]:
    """Free road from the front backwards: to the obstacle, if there is one, and between the vehicles."""
    front, obstacle = float(scene.front_m[0]), scene.obstacle_m
    spaces = [_Space(_x(scene, front), _x(scene, obstacle), obstacle - front, any(s.pair < 0 for s in scene.struck))]
    for p, gap in enumerate(scene.gaps_m.tolist()):
        left, right = _x(scene, scene.front_m[p + 1]), _x(scene, scene.front_m[p] - BODY_M)
        spaces.append(_Space(left, right, gap, bool(scene.hit[p])))
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
    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont)
    return font


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
