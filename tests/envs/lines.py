"""Small lines of vehicles whose episodes a person can follow by hand."""

from __future__ import annotations

from ethbrake_marl.scenario import Scenario

# Vehicle 1 brakes with 6 m/s2 from 20 m/s; Vehicle 2 may act after 0.5 s. Coasting, it closes 3 m in 1 s and hits with
# w = 6 m/s: harm 36, of which masses 1 and 3 give Vehicle 1 three quarters (27) and Vehicle 2 the rest (9).
CRASH = Scenario(
    name="crash",
    vehicles=2,
    gaps_m=3,
    speeds_mps=20,
    braking_capacity_mps2=[6, 8],
    driving_capacity_mps2=[6, 4],
    mass_t=[1, 3],
    latency_s=[0, 0.5],
    restitution=0,
    horizon_s=1.3,
)

# Far apart and nearly at rest: Vehicle 2, from 5.7 m/s with 6 m/s2 after 0.5 s, rests at 1.45 s, in its 10th step.
REST = Scenario(
    name="rest",
    vehicles=2,
    gaps_m=50,
    speeds_mps=5.7,
    braking_capacity_mps2=6,
    driving_capacity_mps2=6,
    mass_t=1,
    latency_s=[0, 0.5],
)
