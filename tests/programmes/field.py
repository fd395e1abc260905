"""Other simulators, formats and clusters: SUMO, HighwayEnv, ASAM's checkers, floating-car data, Ray and Dask agree.

Each has its own environment in ``.venvs/``; one that cannot be installed is skipped with the reason.

- SUMO (``sumo.py``): an agent drives Vehicle 2 there, on 200 roads; the same worlds collide, with the same harm.
- HighwayEnv (``highway.py``): the same worlds collide.
- ASAM: the checkers of OpenSCENARIO and OpenDRIVE read what ``ethbrake watch --output emergency.xosc`` writes.
- floating-car data: the gaps of a scenario that was made from SUMO's traffic are those that SUMO itself writes.
- CommonRoad (``recordings.py``): the page's program reads a recording, and the gaps are those by hand.
- clusters (``clusters.py``): the bits are those of one process.
"""

import json
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd

from tests.programmes import Cases, Given, NotInstalled, Told, ready_python, watched

AGENTS = ("full_brake", "e_v2x_bm", "plan")
REQUIRES = {
    "sumo": ("eclipse-sumo==1.28.0", "libsumo==1.28.0", "pandas>=2.2.3"),
    "highway": ("highway-env==1.12.1",),
    "asam": ("asam-qc-openscenarioxml==1.0.0", "asam-qc-opendrive==1.0.0"),
    "recordings": ("commonroad-io==2026.1",),
    "clusters": (
        "ray[tune]==2.60.0",
        "distributed==2026.8.0",
        "stable-baselines3==2.9.2",
        "joblib>=1.5",
        "tensorboard>=2.18",
    ),
}
EXPORTED = ("paper-random", "paper-random-obstacle", "cooperation-2-five", "realistic-truck", "standards-ccrs-followed")
CHECKERS = {"xosc": ("qc_openscenario", "xoscBundle", 17), "xodr": ("qc_opendrive", "xodrBundle", 22)}
GAP_M, MOTION_M, HARM = 1e-12, 1e-10, 0.01  # largest differences; the last one relative
LIMIT_S = 900.0


def cases(given: Given) -> Cases:
    for agent in AGENTS:
        yield f"SUMO: {agent}", partial(compared, "sumo", agent, given, agrees_with_sumo)
    yield "SUMO: floating-car data", partial(installed, "sumo", reads_traffic)
    yield "CommonRoad", partial(installed, "recordings", reads_commonroad)
    for agent in AGENTS:
        yield f"HighwayEnv: {agent}", partial(compared, "highway", agent, given, agrees_with_highway)
    for scenario in EXPORTED:
        yield f"ASAM: {scenario}", partial(installed, "asam", partial(passes_asam, scenario))
    for where in ("joblib", "Ray", "Dask", "Ray Tune"):
        yield f"clusters: {where}", partial(compared, "clusters", where, given, has_same_bits)


def installed(name: str, check: Any) -> Told:
    """Call ``check`` with the Python of an environment."""
    try:
        python = ready_python(name, REQUIRES[name], project=name != "asam", torch=name == "clusters")
    except NotInstalled as reason:
        return Told(None, f"skipped: {reason}")
    result: Told = check(python)
    return result


def compared(name: str, what: str, given: Given, verdict: Any) -> Told:
    """Run ``tell`` of the module of this name in its environment, and judge what it prints."""

    def check(python: Path) -> Told:
        call = f"from tests.programmes import {name}; {name}.tell({what!r})"
        limit = min(LIMIT_S, given.until - time.monotonic())
        status, told = watched([str(python), "-W", "ignore", "-c", call], limit, OMP_NUM_THREADS="1")
        rows = [line for line in told.splitlines() if line.startswith("{")]
        if status != 0 or not rows:
            return Told(None if status is None else False, told.strip()[-1500:] or "no time left")
        row = json.loads(rows[-1])
        return Told(verdict(row), json.dumps(row))

    return installed(name, check)


def agrees_with_sumo(row: dict[str, Any]) -> bool:
    close = all(abs(there - here) <= HARM * here for there, here in (row["first"], row["total"]))
    return row["inserted_m"] < GAP_M and row["moved_m"] < MOTION_M and row["same_worlds"] == 1.0 and close


def agrees_with_highway(row: dict[str, Any]) -> bool:
    return bool(row["same_worlds"] == 1.0 and row["crashed"] > 0.0)


def has_same_bits(row: dict[str, Any]) -> bool:
    return bool(row["here"] == row["there"])


def passes_asam(scenario: str, python: Path) -> Told:
    """Write an emergency of a scenario, and let ASAM's checkers read it and its road."""
    texts = []
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "emergency.xosc"
        words = ["watch", "--scenario", scenario, "--agents", "full_brake", "--world", "1", "--output", str(written)]
        subprocess.run([sys.executable, "-m", "ethbrake_marl", *words], check=True, capture_output=True)
        for ending, (checker, bundle, count) in CHECKERS.items():
            report, config = Path(folder) / f"{ending}.xqar", Path(folder) / f"{ending}.xml"
            config.write_text(
                f'<Config><Param name="InputFile" value="{written.with_suffix(f".{ending}")}"/>'
                f'<CheckerBundle application="{bundle}"><Param name="resultFile" value="{report}"/></CheckerBundle>'
                "</Config>"
            )
            subprocess.run([str(python.with_name(checker)), "-c", str(config)], check=True, capture_output=True)
            read = [*ElementTree.parse(report).getroot().iter("Checker")]
            passed = [each for each in read if each.get("status") == "completed" and not [*each.iter("Issue")]]
            texts.append(f"{len(passed)} of {len(read)} checks of {checker}")
            if len(passed) < count or any([*each.iter("Issue")] for each in read):
                return Told(False, "; ".join(texts))
    return Told(True, "; ".join(texts))


def reads_traffic(python: Path) -> Told:
    """Let SUMO write floating-car data, make a scenario of them as docs/simulators.md says, and compare the gaps."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        call = f"from pathlib import Path; from tests.programmes import traffic; traffic.main(Path({name!r}))"
        status, told = watched([str(python), "-c", call], LIMIT_S)
        if status != 0:
            return Told(False, told.strip()[-1500:])
        cars = pd.read_csv(folder / "fcd.csv", sep=";")
        lengths = {"c": 4.5, "t": 12.0}
        cars.assign(length=cars["vehicle_type"].map(lengths)).to_csv(folder / "cars.csv", index=False)
        columns = "time=timestep_time,vehicle=vehicle_id,lane=vehicle_lane,front=vehicle_pos,length=length,units=m,"
        words = ["scenario", "from-data", "cars.csv", "--format", "table", "--columns", f"{columns}speed=vehicle_speed"]
        words += ["--based-on", "realistic-pair", "--every", "0.5", "--output", "traffic.yaml"]
        subprocess.run([sys.executable, "-m", "ethbrake_marl", *words], check=True, capture_output=True, cwd=folder)
        rows = pd.read_csv(folder / "traffic.csv")
        cars = cars.sort_values(["timestep_time", "vehicle_lane", "vehicle_pos"])
        ahead = cars.groupby(["timestep_time", "vehicle_lane"])["vehicle_id"].shift(-1)
        own = cars["vehicle_leaderGap"].groupby(ahead + "-" + cars["vehicle_id"]).apply(np.array)
        pairs = rows["recording"].str.partition(": ")[2]
        equal = sum(np.abs(own[pair] - gap).min() < 1e-3 for pair, gap in zip(pairs, rows["gap_1_m"], strict=True))
    return Told(bool(equal == len(rows) > 10_000), f"{equal:,} of {len(rows):,} gaps are SUMO's own")


def reads_commonroad(python: Path) -> Told:
    """Let the page's program write a table, make a scenario of it, and compare its first row."""
    with tempfile.TemporaryDirectory() as folder:
        call = f"import os; from tests.programmes import recordings; os.chdir({folder!r}); recordings.main()"
        status, told = watched([str(python), "-W", "ignore", "-c", call], LIMIT_S)
        if status != 0:
            return Told(False, told.strip()[-1500:])
        columns = "time=t,vehicle=id,lane=lane,front=front,length=length,speed=v,units=m"
        words = ["scenario", "from-data", "cars.csv", "--format", "table", "--columns", columns, "--output", "new.yaml"]
        subprocess.run([sys.executable, "-m", "ethbrake_marl", *words], check=True, capture_output=True, cwd=folder)
        row = pd.read_csv(Path(folder) / "new.csv").drop(columns="recording").iloc[0].tolist()
    return Told(row == [15.5, 25.5, 20.0, 19.0, 22.0], str(row))
