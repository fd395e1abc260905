"""A scene is one world at one moment. A motion is what happens in a world between two decisions."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.commands import action_of
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State, require
from ethbrake_marl.evaluation.record import advance_worlds
from ethbrake_marl.motion.layout import (
    FAR_M,
    FIRST,
    GAP,
    IMPACTS,
    LATENCY,
    NEXT_CLOSING,
    NEXT_TIME,
    SPEED,
    TOTAL,
    Floats,
    scratch_for,
)

BODY_M = 4.5  # drawn length of a vehicle (m); in the physics, vehicles have no length
FLASH_S = 0.3  # time for which an impact is shown (s)
SCENE_POST_M = 1e6  # place of a post far ahead, from which the way of Vehicle 1 is measured (m)
BEHIND_M, AHEAD_M = 3.0, 5.0  # free road behind and ahead of the line (m)
LEAST_WIDTH_M = 40.0  # shortest road that is shown (m)
LATE_S = 3.0  # longest latency that counts for the length of road (s)
ROAD_COLUMNS = 100  # width of the road in characters


class Impact(NamedTuple):
    """First impact of a pair of vehicles in a step."""

    pair: int  # 0: Vehicle 1 and the obstacle
    closing_mps: float
    time_s: float  # since the alert

    def __str__(self) -> str:
        who = f"Vehicles {self.pair} and {self.pair + 1}" if self.pair else "Vehicle 1 and the obstacle"
        return f"{who} at {self.closing_mps:.1f} m/s" if self.closing_mps >= 0.05 else f"{who} at < 0.1 m/s"


class Scene(NamedTuple):
    """One world at one moment.

    Places on the road are in m ahead of Vehicle 1's front bumper at the start of the motion.
    """

    title: str
    learners: tuple[int, ...]  # bodies
    ended: bool
    time_s: float  # since the alert
    line: Floats  # [LINE_ROWS, N + 1]
    car: Floats  # [CAR_ROWS, N + 1]
    wanted: Floats  # [N + 1] commands (m/s2)
    front_m: float  # place of Vehicle 1's front bumper
    impacts: tuple[Impact, ...]  # of the last FLASH_S
    road_m: tuple[float, float]  # places of the ends of the road that the episode needs

    @property
    def fronts_m(self) -> list[float]:
        """Places of the front bumpers (m). Gaps are true, and every vehicle is drawn ``BODY_M`` long."""
        behind = np.concatenate([[0.0], np.cumsum(self.line[GAP, 1:-1] + BODY_M)])
        return [float(self.front_m - way) for way in behind]

    @property
    def shown_m(self) -> tuple[float, float]:
        """Both ends of the road to draw (m): ``road_m``, moved and widened until it holds the whole line."""
        (left, right), fronts = self.road_m, self.fronts_m
        on = max(fronts[0] + AHEAD_M - right, 0.0)
        return min(left + on, fronts[-1] - BODY_M - BEHIND_M), right + on

    @property
    def has_obstacle(self) -> bool:
        return bool(self.line[GAP, 0] < FAR_M)

    @property
    def obstacle_m(self) -> float:
        return self.front_m + float(self.line[GAP, 0])

    def command(self, body: int) -> float:
        """Command in effect (m/s2); 0 before the vehicle's latency has elapsed."""
        return float(self.wanted[body]) if self.car[LATENCY, body] <= self.time_s else 0.0

    def share(self, body: int) -> float:
        """Command in effect as an action in [-1, 1]."""
        return float(action_of(self.car, body, self.command(body)))

    def said_of(self, body: int) -> str:
        """What a vehicle does, in words such as "brakes 3.0 m/s2"."""
        latency, command = float(self.car[LATENCY, body]), self.command(body)
        if latency > self.time_s:
            return f"acts from {latency:.2f} s" if latency < math.inf else "never acts"
        return f"{'brakes' if command < 0.0 else 'drives'} {abs(command):.1f} m/s2" if command else "coasts"

    @property
    def clock(self) -> str:
        return f"{self.time_s:.2f} s after the alert{' (ended)' if self.ended else ''}"

    @property
    def harm(self) -> str:
        first, total = (float(self.line[row, :-1].sum()) for row in (FIRST, TOTAL))
        return f"harm {first:.2f} by first impacts, {total:.2f} in total (m2/s2)"

    def text(self) -> str:
        left, right = self.shown_m

        def column(place_m: float) -> int:
            return min(max(int((place_m - left) / (right - left) * ROAD_COLUMNS), 0), ROAD_COLUMNS - 1)

        road, lines, fronts = ["."] * ROAD_COLUMNS, [], self.fronts_m
        for body in range(len(fronts), 0, -1):
            first, last = column(fronts[body - 1] - BODY_M), column(fronts[body - 1])
            road[first : last + 1] = f"[{body}>".center(last + 1 - first, "=")[: last + 1 - first]
            gap = f"gap ahead {self.line[GAP, body - 1]:6.2f} m" if body > 1 or self.has_obstacle else ""
            learns = "learns" if body in self.learners else ""
            lines.append(
                f"vehicle_{body:<3} {learns:6}  {self.line[SPEED, body]:6.2f} m/s  {gap:18}  {self.said_of(body)}"
            )
        if self.has_obstacle:
            road[column(self.obstacle_m)] = "#"
        for impact in self.impacts:
            road[column(fronts[impact.pair])] = "*"
        lines = [f"{self.title}  {self.clock}", "".join(road), *(line.rstrip() for line in reversed(lines)), self.harm]
        return "\n".join([*lines, *(f"impact of {impact}, {impact.time_s:.2f} s" for impact in self.impacts)]) + "\n"


class Motion:
    """Exact motion of one world between two decisions. Raises ``InvalidInput`` for a world of another physics."""

    def __init__(self, game: Game, state: State, row: int) -> None:
        require(state, "a picture", simulates=True)
        self.game, self.row, self.road_m = game, row, whole_road(state, row)
        self.line, self.car, self.wanted = state.line[row].copy(), state.car[row], state.wanted[row].copy()
        self.start_s = self.until_s = float(state.time_s[row])
        self.front_m, self.impacts, self.ended = 0.0, tuple[Impact, ...](), False

    def step(self, state: State) -> None:
        self.line, self.front_m, self.impacts = self.at(self.until_s)
        self.start_s, self.until_s = self.until_s, float(state.time_s[self.row])
        self.wanted, self.ended = state.wanted[self.row].copy(), bool(state.ended[self.row])

    def at(self, time_s: float) -> tuple[Floats, float, tuple[Impact, ...]]:
        """``line``, place of Vehicle 1's front bumper (m), and recent impacts, ``time_s`` after the alert."""
        line = self.line.copy()
        line[GAP, 0] = ahead_m = min(line[GAP, 0], SCENE_POST_M)
        counts, scratch = line[IMPACTS].copy(), scratch_for(len(self.wanted))
        times = np.array([self.start_s]), np.array([time_s])
        if time_s > self.start_s:
            advance_worlds(line[np.newaxis], self.car[np.newaxis], *times, self.wanted[np.newaxis], scratch)
        new = [
            Impact(int(p), float(scratch[NEXT_CLOSING, p]), self.start_s + float(scratch[NEXT_TIME, p]))
            for p in np.flatnonzero(line[IMPACTS] > counts)
        ]
        recent = tuple(impact for impact in (*self.impacts, *new) if impact.time_s > time_s - FLASH_S)
        front_m = self.front_m + float(ahead_m - line[GAP, 0])
        if ahead_m == SCENE_POST_M:
            line[GAP, 0] = self.line[GAP, 0]
        return line, front_m, recent

    def scene(self, time_s: float) -> Scene:
        line, front_m, impacts = self.at(time_s)
        learners, ended = tuple(map(int, self.game.settings.learners)), self.ended and time_s == self.until_s
        return Scene(
            self.game.name, learners, ended, time_s, line, self.car, self.wanted, front_m, impacts, self.road_m
        )


def whole_road(state: State, row: int) -> tuple[float, float]:
    """Both ends (m) of the road that the line needs until it rests if all brake fully; nobody stops ahead of those in
    front.
    """
    speeds, braking = state.speeds_mps[row], state.braking_capacity_mps2[row]
    behind = np.concatenate([[0.0], np.cumsum(state.gaps_m[row])])
    late = np.clip(state.latency_s[row] - state.time_s[row], 0.0, LATE_S)
    ways = speeds * late + speeds * speeds / (2.0 * braking) - behind
    left = -float(behind[-1]) - state.vehicles * BODY_M - BEHIND_M
    right = min(float(ways.max()), float(state.obstacle_gap_m[row])) + AHEAD_M
    return left, max(right, left + LEAST_WIDTH_M)
