"""``Follower``: one more vehicle behind the line of a scenario, at the speed of the last one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pydantic import Field, ValidationError

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import FileModel
from ethbrake_marl.files.yaml import Document
from ethbrake_marl.scenario.fields import QUANTITY


class Follower(FileModel):
    """A vehicle behind the last one, at the same speed, that brakes fully after its latency.

    Without values it has latency and hardest braking of UN Regulation 157's competent driver, 0.75 s and 0.774 g; its
    time gap, 0.6 s, is ours. It brakes at once, without that driver's build-up. Its mass is that of the last vehicle.
    """

    time_gap_s: float = Field(default=0.6, gt=0.0, le=60.0, description="its time gap behind the last vehicle")
    braking_capacity_mps2: float = Field(default=7.59, gt=0.0, le=30.0, description="its hardest braking")
    latency_s: float = Field(default=0.75, ge=0.0, le=60.0, description="time from the alert until it brakes")


def with_follower(document: Document, build: Callable[[Document], Any]) -> Document:
    """Return the document of the line with the vehicle that the key ``follower`` adds, and without that key.

    Tables and lists are completed for it. An invalid follower gives the document unchanged; the schema refuses it
    later. Raises ``InvalidInput`` for an invalid line, for vehicle types, and where the last vehicle's speed is drawn.

    Args:
        document: parsed file with a key ``follower``.
        build: function that builds a scenario from a document.

    """
    content, where = dict(document.content), f"{document.where(('follower',))}: follower"
    try:
        follower = Follower.model_validate(content.pop("follower"))
    except ValidationError:
        return document
    line = build(Document(document.file, content, document.lines))
    if "vehicle_types" in content:
        raise InvalidInput(
            f"{where}: cannot stand beside vehicle_types; write out the line of {line.vehicles + 1} instead"
        )
    N, own = line.vehicles, {"braking_capacity_mps2": follower.braking_capacity_mps2, "latency_s": follower.latency_s}
    for key, rule in QUANTITY.declared.items():
        value = content.get(key)
        if rule.per == "vehicle" and value is not None and (key in own or isinstance(value, list | tuple)):
            values = value if isinstance(value, list | tuple) else [value] * N
            content[key] = [*values, own.get(key, values[-1])]
    low, high = line.bounds("speeds_mps")[-1]
    speed, gaps = (QUANTITY.declared[key].column_of(N - k) for k, key in ((1, "speeds_mps"), (2, "gaps_m")))
    columns = list(content["table"]["columns"]) if "table" in content else []
    if speed not in columns and low != high:
        raise InvalidInput(f"{where}: the speed of vehicle_{N} is drawn; it must be a number, or stand in the table")
    if speed in columns or gaps in columns:
        rows = []
        for row in content["table"]["rows"]:
            own_speed = [row[columns.index(speed)]] if speed in columns else []
            rows.append([*row, follower.time_gap_s * (own_speed or [low])[0], *own_speed])
        columns += [f"gap_{N}_m", *[f"speed_{N + 1}_mps"] * (speed in columns)]
        content["table"] = {**content["table"], "columns": columns, "rows": rows}
    else:
        by_time = "time_gaps_s" in content
        key, gap = ("time_gaps_s", follower.time_gap_s) if by_time else ("gaps_m", follower.time_gap_s * low)
        value = content[key]
        content[key] = [*(value if isinstance(value, list | tuple) else [value] * (N - 1)), gap]
    return Document(document.file, {**content, "vehicles": N + 1}, document.lines)
