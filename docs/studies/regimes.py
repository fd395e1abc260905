"""One pair of vehicles in each regime of the closed form: figure of docs/proofs/constant-deceleration.md.

.venv/bin/python docs/studies/regimes.py docs/figures/regimes.png
"""

from __future__ import annotations

import argparse

import matplotlib.pyplot as plt
import numpy as np

CASES = {  # regime -> gap, leader's speed and deceleration, follower's speed and deceleration, latency tau (SI units)
    "A: follower coasts": (2.0, 20.0, 6.0, 20.0, 6.0, 1.2),
    "A': coasts, leader stands": (2.0, 4.0, 6.0, 4.0, 6.0, 1.2),
    "B: both brake": (3.5, 20.0, 6.0, 20.0, 6.0, 0.8),
    "C: leader stands": (12.0, 12.0, 7.0, 14.0, 6.0, 0.5),
}


def way(speed, braking, onset, time):
    """Distance covered at ``time``: coasting until ``onset``, then braking to rest."""
    after = np.clip(time - onset, 0.0, speed / braking)
    return speed * np.minimum(time, onset) + speed * after - braking * after**2 / 2


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("picture", help="file for the figure")
picture = parser.parse_args().picture
figure, panels = plt.subplots(1, 4, figsize=(11, 2.9), layout="constrained")
for axes, (name, (gap, v_l, a_l, v_f, a_f, tau)) in zip(panels, CASES.items(), strict=True):
    time = np.linspace(0.0, max(v_l / a_l, tau + v_f / a_f), 4001)
    ahead, behind = gap + way(v_l, a_l, 0.0, time), way(v_f, a_f, tau, time)
    meets = int(np.argmax(behind >= ahead))
    axes.plot(time, ahead, color="#d55e00", label="leader")
    axes.plot(time[: meets + 1], behind[: meets + 1], color="#0072b2", linestyle="--", label="follower")
    axes.plot(time[meets:], behind[meets:], color="#0072b2", linestyle=":", linewidth=0.8)
    axes.plot(time[meets], behind[meets], "ko", markersize=5)
    axes.axvline(tau, color="grey", linewidth=0.8, linestyle=(0, (1, 2)))
    axes.axvline(v_l / a_l, color="grey", linewidth=0.8, linestyle=(0, (5, 3)))
    axes.set_title(name, fontsize=9.5, loc="left")
    axes.set_xlabel("time (s)", fontsize=9)
    axes.tick_params(labelsize=8)
panels[0].set_ylabel("position (m)", fontsize=9)
panels[0].legend(frameon=False, fontsize=8.5)
figure.savefig(picture, dpi=110)
