"""The drawings of docs/model.md are those that docs/drawings.py makes."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.figures import picture_bytes
from tests.docs.site import DOCS, load

drawings = load("../drawings")


@pytest.mark.parametrize("name", drawings.DRAWINGS)
def test_drawing__is_the_one_that_is_shown(name: str) -> None:
    assert f"](figures/model-{name}.svg)" in (DOCS / "model.md").read_text("utf-8").replace("\n", " ")
    made = picture_bytes(drawings.DRAWINGS[name](), "made.svg")
    assert made == (DOCS / "figures" / f"model-{name}.svg").read_bytes()


def test_phases__follow_latency_speed_and_command() -> None:
    time, speed = np.arange(6.0), np.array([5.0, 5.0, 5.0, 4.0, 0.0, 0.0])
    command = np.array([0.0, 0.0, 2.0, -1.0, -1.0, -1.0])
    assert list(drawings.phases(time, speed, command, 1.0)) == [
        (0.0, 1.0, "waits for its news"),
        (1.0, 2.0, "coasts"),
        (2.0, 3.0, "drives"),
        (3.0, 4.0, "brakes"),
        (4.0, 5.0, "stands"),
    ]
