"""The channel in the worlds of a scenario: their news, and the memory of periodic messages before the first is sent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics.messages import (
    DELAY,
    KEY,
    LINK,
    LOSS_BEGINS,
    LOSS_ENDS,
    NEXT_SENT,
    PERIOD,
    SEEN_FROM,
    TOLD_S,
    link_at,
    message_columns,
    ring_at,
)
from ethbrake_marl.physics.worlds import Floats, Worlds
from ethbrake_marl.scenario.v2x import PER_LINK, V2X, heard_and_seen, with_news


def with_channel(v2x: V2X, worlds: Worlds, u: Floats, key: Floats, time_step_s: float) -> Worlds:
    """These worlds at the alert with their news and, where messages are periodic, the columns of these, none sent yet.

    Args:
        v2x: the channel.
        worlds: whose latencies are all own.
        u: what the news is drawn by, [n, N * N * PER_LINK] in [0, 1).
        key: [n] in [0, 1), one for all later losses of a world.
        time_step_s: between two decisions, at which vehicles sample their states.

    """
    channel, (n, N) = v2x.channel, worlds.speeds_mps.shape
    worlds = replace(worlds, vehicles=with_news(v2x, worlds.vehicles, u))
    if channel.persistence == "first":
        return worlds
    heard, seen = heard_and_seen(v2x, worlds.vehicles, u)
    itself = np.eye(N, dtype=np.bool_)
    columns = np.zeros((n, message_columns(N, channel.samples(time_step_s))))
    columns[:, PERIOD], columns[:, DELAY] = channel.message_period_s, channel.delay_s
    columns[:, LOSS_BEGINS], columns[:, LOSS_ENDS] = channel.loss_begins, channel.loss_ends
    columns[:, KEY] = key * 2.0**53
    links = columns[:, link_at(0, 0, N) : ring_at(N)].reshape(n, N, N, LINK)
    links[..., NEXT_SENT] = np.where(itself, np.inf, heard - channel.delay_s)
    links[..., SEEN_FROM] = np.where(itself, np.inf, seen)
    links[..., TOLD_S] = -1.0
    return replace(worlds, messages=columns)


def with_fixed_news(v2x: V2X, worlds: Worlds, time_step_s: float, where: str) -> Worlds:
    """Worlds that somebody gives with their channel, which leaves nothing to chance; ``InvalidInput`` where it does."""
    if not v2x.by_link:
        return worlds
    if v2x.drawn:
        raise InvalidInput(
            f"{where}: the scenario draws what each vehicle knows when (v2x: {v2x.preset}); take one whose channel is"
            " fixed, for instance scenario.replace(v2x='paper')"
        )
    n, N = worlds.speeds_mps.shape
    return with_channel(v2x, worlds, np.zeros((n, N * N * PER_LINK)), np.zeros(n), time_step_s)
