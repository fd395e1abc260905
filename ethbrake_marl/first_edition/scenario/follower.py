"""``Follower``: an additional vehicle behind the last vehicle of a scenario, with the speed of that last vehicle."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pydantic import Field, ValidationError

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import FileModel
from ethbrake_marl.files.yaml import Document
from ethbrake_marl.first_edition.scenario.fields import QUANTITY


class Follower(FileModel):
    """An additional vehicle behind the last vehicle, with the same speed; it brakes fully after its latency.

    The default latency (0.75 s) and braking capacity (0.774 g) are those of the competent driver in UN Regulation 157.
    The default time gap (0.6 s) is our choice. The follower's brakes act at once, but the regulation's driver needs
    some time to build up the braking force. The follower's mass equals the mass of the last vehicle.
    """

    time_gap_s: float = Field(
        default=0.6, gt=0.0, le=60.0, description="time gap from the last vehicle of the line to the follower"
    )
    braking_capacity_mps2: float = Field(default=7.59, gt=0.0, le=30.0, description="braking capacity of the follower")
    latency_s: float = Field(default=0.75, ge=0.0, le=60.0, description="time from the alert until the follower brakes")


def with_follower(document: Document, build: Callable[[Document], Any]) -> Document:
    """Return the document with the follower as one more vehicle of the line, and without the key ``follower``.

    The table and all lists also get entries for the follower. ``build`` builds a scenario from a document (the parsed
    content of a file). If the follower is invalid, the document is returned unchanged, and the schema rejects the
    document later. Raises ``InvalidInput`` if the line of vehicles is invalid, if vehicle types are declared, or if the
    speed of the last vehicle is random and not a column of the table.
    """
    content, where = dict(document.content), f"{document.where(('follower',))}: follower"
    try:
        follower = Follower.model_validate(content.pop("follower"))
    except ValidationError:
        return document
    line = build(Document(document.file, content, document.lines))
    if "vehicle_types" in content:
        raise InvalidInput(
            f"{where}: cannot be combined with vehicle_types; instead of the follower, declare a further vehicle"
            f" (vehicles: {line.vehicles + 1})"
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
        raise InvalidInput(
            f"{where}: the follower has the speed of vehicle_{N}, which is random; this speed must be a fixed number or"
            " a column of the table"
        )
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
