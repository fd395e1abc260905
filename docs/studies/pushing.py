"""Results of the training programs in docs/train.md with five seeds; the program of README is ``one-honest``.

    python docs/studies/pushing.py one-honest pair-honest
    python docs/studies/pushing.py one pair one-bootstrap pair-bootstrap one-speed pair-speed

Each argument names a program. ``-honest`` trains for the honest cost, as the pages do, all others for first-impact
harm: ``-bootstrap`` with ``horizon_is_end=False``, ``-speed`` with a reward term that makes a vehicle stop. A training
takes one or two minutes on one core.
"""

from __future__ import annotations

import argparse
from statistics import median

import torch
from stable_baselines3 import PPO

import ethbrake_marl as eb
from ethbrake_marl.motion.layout import Floats

SHAPED = {"harm": 0.05, "shaping": 0.05, "shaping_discount": 0.99}
BLOCKS = {  # program -> scenario, parallel worlds, observation (None: as in the scenario)
    "one": ("paper-random", 64, ["own", "front_1", "rear_1", "plan"]),
    "pair": ("cooperation-3-pair", 32, None),
}
SEEDS, STEPS = range(5), 200_000
WORLDS = {"paper-random": 10_000, "cooperation-3-pair": 2_000}
MEASURES = {  # heading -> measure, factor, digits
    "first-impact harm": ("first_impact_harm", 1.0, 2),
    "total harm": ("total_harm", 1.0, 2),
    "honest cost": ("honest_cost", 1.0, 2),
    "push (m/s)": ("pushed_mps", 1.0, 2),
    "Vehicle 1 pushed (m)": ("pushed_m_1", 1.0, 1),
    "moving at 8 s (%)": ("moving", 100.0, 1),
}


def speed(before: eb.State, step: eb.Step, after: eb.State) -> Floats:
    """Minus the speed of each vehicle, m/s."""
    return -after.speeds_mps


def train(block: str, seed: int) -> PPO:
    """Model of a program, trained as on its page, with this seed."""
    name, _, variant = block.partition("-")
    scenario, worlds, observation = BLOCKS[name]
    reward = {**SHAPED, "speed": 5e-4} if variant == "speed" else SHAPED
    reward = {**reward, "harm_count": "honest" if variant == "honest" else "first"}
    settings = {"horizon_is_end": False} if variant == "bootstrap" else {}
    venv = eb.make_sb3_vec_env(scenario, n_envs=worlds, observation=observation, reward=reward, **settings)
    return PPO("MlpPolicy", venv, n_steps=64, batch_size=512, learning_rate=1e-3, seed=seed).learn(STEPS)


def measure(block: str, model: PPO) -> dict[str, float]:
    scenario = BLOCKS[block.partition("-")[0]][0]
    agents = {block: eb.policy_agent(model, clip=True, scenario=scenario)}
    asked = "pushed_m,pushed_mps"
    columns = eb.evaluate(scenario, agents, episodes=WORLDS[scenario], measures=asked)[block]
    values = {name: float(columns[name].mean()) for name, _, _ in MEASURES.values() if name in columns}
    return values | {"moving": float((columns["ended"] == "horizon").mean())}


def line(block: str, seeds: list[dict[str, float]]) -> str:
    """Row of a program: median and range of each measure over its seeds."""
    cells = [f"`{block}`"]
    for name, scale, digits in MEASURES.values():
        values = sorted(scale * each[name] for each in seeds if name in each)
        texts = [f"{value:.{digits}f}" for value in (median(values), values[0], values[-1])] if values else []
        cells.append(f"{texts[0]} ({texts[1]} to {texts[2]})" if texts else "–")
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("programs", nargs="+")
    given = parser.parse_args()
    torch.set_num_threads(1)
    eb.register_term("speed", speed, unit="m/s")
    rows = [line(block, [measure(block, train(block, seed)) for seed in SEEDS]) for block in given.programs]
    print("\n".join([f"| {' | '.join(['block', *MEASURES])} |", "| --- |" + " ---: |" * len(MEASURES), *rows]))
