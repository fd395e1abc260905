"""Distributions that are fitted to recorded gaps and speeds.

There are independent distributions of each pair's time gap (gap divided by speed), of the mean speed of the line of
vehicles, and of each vehicle's deviation from this mean speed.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.physics.elementary import exp, log
from ethbrake_marl.first_edition.physics.state import Floats

DataDraw = Literal["rows", "normal", "lognormal", "quantiles"]  # how the scenario draws worlds: rows, or kind of a fit

QUANTILES = 40

SLOWEST_MPS, LONGEST_S = 0.5, 60.0  # least speed and longest time gap of rows that are used for fits


def fit_rows(rows: Floats, draw: DataDraw) -> dict[str, Any]:
    """Return scenario keys with distributions of time gaps, of the line's mean speed, and of deviations from this mean.

    ``rows`` [k, 2 N - 1] are gaps (m) and speeds (m/s) of k chains of N vehicles. ``draw`` is the kind of
    distribution, not ``rows``. Raises ``InvalidInput`` if fewer than ``QUANTILES`` chains have speeds of at least
    ``SLOWEST_MPS``, and time gaps above 0 and at most ``LONGEST_S``.
    """
    gaps, speeds = np.split(rows, [rows.shape[1] // 2], axis=1)
    times = gaps / np.maximum(speeds[:, 1:], SLOWEST_MPS)
    used = (speeds >= SLOWEST_MPS).all(axis=1) & ((times > 0.0) & (times <= LONGEST_S)).all(axis=1)
    if used.sum() < QUANTILES:
        raise InvalidInput(
            f"draw = {draw}: a fit needs at least {QUANTILES} rows with time gaps above 0 and up to {LONGEST_S:g} s,"
            f" but there are only {used.sum()}; give more recordings, or use draw = rows"
        )
    line = speeds[used].mean(axis=1)
    off = speeds[used] - line[:, None]
    signed: DataDraw = "normal" if draw == "lognormal" else draw
    return {
        "time_gaps_s": [_fit(each, draw) for each in times[used].T],
        "line_speed_mps": _fit(
            np.clip(line, -off.min(), speeds.max() - off.max()), signed
        ),  # clipped, to keep mean plus deviation between 0 and the highest recorded speed
        "speed_deviations_mps": [_fit(each, signed) for each in off.T],
    }


def _fit(values: Floats, draw: DataDraw) -> Any:
    """Return a distribution fitted to ``values`` [k], limited to their range, in the form of a scenario file."""
    low, high = float(values.min()), float(values.max())
    if draw == "quantiles" or low == high:
        return {"choice": np.quantile(values, (np.arange(QUANTILES) + 0.5) / QUANTILES).tolist()}
    if draw == "lognormal":
        logs = np.array([log(value) for value in values])
        median, sigma = exp(logs.mean()), float(logs.std())
        return {"lognormal": {"median": median, "sigma": sigma, "low": low, "high": high}}
    return {"normal": {"mean": float(values.mean()), "sd": float(values.std()), "low": low, "high": high}}
