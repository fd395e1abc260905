"""Progress of a long piece of work, for those who asked to be told."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Progress:
    """``done`` of ``total`` of the part called ``name``.

    Of a training ``done`` counts decisions of learners, and ``total`` is what they come to in whole updates.

    >>> import ethbrake_marl as eb
    >>> eb.Progress("full_brake", 500, 1000)
    Progress(name='full_brake', done=500, total=1000, metrics={}, note='', updates=0, wall_s=0.0)

    """

    name: str  # "training", an agent that drives, "figures", ...
    done: int  # worlds, or decisions of learners
    total: int  # the same when it is done
    metrics: Mapping[str, float] = field(default_factory=dict)  # of a policy while it is trained: its last evaluation
    note: str = ""  # to be told once
    updates: int = 0  # of a training
    wall_s: float = 0.0  # of a training


OnProgress = Callable[[Progress], None]
