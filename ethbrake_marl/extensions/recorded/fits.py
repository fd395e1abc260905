"""Fits to recorded rows: independent distributions of time gaps, mean speed of a row, and deviations from it."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics.elementary import exp, log
from ethbrake_marl.physics.state import Floats

DataDraw = Literal["rows", "normal", "lognormal", "quantiles"]  # how the scenario draws its worlds

QUANTILES = 40

SLOWEST_MPS, LONGEST_S = 0.5, 60.0  # least speed and longest time gap of rows that are used for fits


def fit_rows(rows: Floats, draw: DataDraw) -> dict[str, Any]:
    """Return keys of a scenario with independent fits to time gaps, mean speed of a row, and deviations from it.

    ``rows`` [k, 2 N - 1] holds the gaps (m) and speeds (m/s) of each chain; ``draw`` is the kind of fit.
    """
    gaps, speeds = np.split(rows, [rows.shape[1] // 2], axis=1)
    times = gaps / np.maximum(speeds[:, 1:], SLOWEST_MPS)
    used = (speeds >= SLOWEST_MPS).all(axis=1) & ((times > 0.0) & (times <= LONGEST_S)).all(axis=1)
    if used.sum() < QUANTILES:
        raise InvalidInput(f"draw = {draw}: {used.sum()} rows have time gaps to fit; at least {QUANTILES} are needed")
    line = speeds[used].mean(axis=1)
    off = speeds[used] - line[:, None]
    signed: DataDraw = "normal" if draw == "lognormal" else draw
    return {
        "time_gaps_s": [_fit(each, draw) for each in times[used].T],
        "line_speed_mps": _fit(
            np.clip(line, -off.min(), speeds.max() - off.max()), signed
        ),  # so that mean plus deviation stays in range
        "speed_deviations_mps": [_fit(each, signed) for each in off.T],
    }


def _fit(values: Floats, draw: DataDraw) -> Any:
    """Return a distribution for a scenario file, fitted to ``values`` [k] and limited to their range.

    ``draw`` is its kind: ``normal``, ``lognormal`` or ``quantiles``.
    """
    low, high = float(values.min()), float(values.max())
    if draw == "quantiles" or low == high:
        return {"choice": np.quantile(values, (np.arange(QUANTILES) + 0.5) / QUANTILES).tolist()}
    if draw == "lognormal":
        logs = np.array([log(value) for value in values])
        median, sigma = exp(logs.mean()), float(logs.std())
        return {"lognormal": {"median": median, "sigma": sigma, "low": low, "high": high}}
    return {"normal": {"mean": float(values.mean()), "sd": float(values.std()), "low": low, "high": high}}
