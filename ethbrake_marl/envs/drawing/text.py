"""A moment as text: the road to scale in one line, then a line for each vehicle."""

from __future__ import annotations

import math

from ethbrake_marl.envs.drawing.scene import BODY_M, Scene

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
