"""Films of episodes as one animated SVG file without scripts.

Any browser plays the file, in light or dark colours as the browser prefers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from xml.sax.saxutils import escape

from ethbrake_marl.envs.rendering import BODY_M, Scene, Struck, star, vehicle_colour
from ethbrake_marl.errors import plain_text

_FILM_WIDTH = 800

_HOLD_S = 2.5  # time for which the end is shown before the film starts again, s

_STRIP = 132  # height of the strip with one agent's road

_FOOT = 34  # height of the clock below the last road

_FILM_LANE, _HALF_ROAD, _HALF_BODY = 82, 24, 13  # distance of the lane from a strip's top; half heights

_SHOWN_S = 1.0  # time for which an impact is shown, s

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
    """Return the text of an SVG file that shows films of one world in real time, below each other, to the same scale.

    The keys of ``films`` are titles. ``fps`` is the number of scenes per second.
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
    """Horizontal strip of the picture that shows the film of one agent: a road with vehicles, and a title.

    ``left_m`` and ``right_m`` are the positions on the road at the edges of the picture.
    """

    def __init__(self, film: Sequence[Scene], title: str, left_m: float, right_m: float, fps: int) -> None:
        self.title = title
        self._film, self._fps = film, fps
        self._left, self._scale = left_m, _FILM_WIDTH / (right_m - left_m)

    def _x(self, place_m: float) -> float:
        return (float(place_m) - self._left) * self._scale

    def drawn(self) -> Iterator[str]:
        """Yield the SVG elements that draw this strip."""
        yield f'<text x="12" y="22" font-weight="bold">{escape(self.title)}</text>'
        texts = [
            f"harm {scene.first_harm:.1f} by first impacts, {scene.total_harm:.1f} in total" for scene in self._film
        ]
        for words in dict.fromkeys(texts):  # a text is visible as long as it states the harm so far
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
        for start, until, struck in self._events():  # the closing speed of each impact, above the road
            x = self._x(self._film[start].front_m[struck.pair + 1])
            lit = [start <= k < until for k in range(len(self._film))]
            yield (
                f'<text class="impact" x="{min(max(x, 90), _FILM_WIDTH - 90):.1f}" y="46" opacity="0">'
                f"{struck.who}: {struck.speed}{self._switched(lit)}</text>"
            )

    def _vehicle(self, i: int) -> Iterator[str]:
        """Yield the SVG elements of vehicle ``i``: its body, lights that show its command, a star for each impact."""
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
        for start, until, struck in self._events():  # a star at the front for each impact ahead
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
        """Return the impacts to show, each as (start, stop, impact): scenes ``start`` to ``stop - 1`` show the impact.

        Only one impact is shown at a time. An impact replaces the shown one if it is at least as strong; otherwise it
        is never shown.
        """
        known: set[tuple[int, float]] = set()
        events: list[tuple[int, int, Struck]] = []
        for k, scene in enumerate(self._film):
            new = [struck for struck in scene.struck if (struck.pair, struck.time_s) not in known]
            known |= {(struck.pair, struck.time_s) for struck in new}
            hardest = max(new, key=lambda struck: struck.closing_mps, default=None)
            if hardest is None or (events and k < events[-1][1] and hardest.closing_mps < events[-1][2].closing_mps):
                continue
            if events:
                events[-1] = (events[-1][0], min(events[-1][1], k), events[-1][2])
            events.append((k, k + round(_SHOWN_S * self._fps), hardest))
        return events

    def _switched(self, lit: Sequence[bool]) -> str:
        """Return an SVG animation that shows an element only in the scenes in which ``lit`` is True."""
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
    """Yield the SVG elements of the clock: a scale in seconds since the alert, and a bar that grows with time.

    ``last`` is the index of the last scene of the longest film; ``frames`` is the number of scenes after which the
    animation starts again. ``y`` is the vertical position of the bar.
    """
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
