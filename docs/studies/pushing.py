"""What the training blocks of docs/howto-train.md and README come to, over five seeds: the table of docs/exploits.md.

    .venv/bin/python docs/studies/pushing.py one one-bootstrap pair readme

Each argument is a block; ``-bootstrap`` trains it with ``horizon_is_end=False``, which lets PPO expect reward beyond
the horizon. A training takes a minute or two of one core.
"""

from __future__ import annotations

import sys
from statistics import median

import torch
from stable_baselines3 import PPO

import ethbrake_marl as eb

SHAPED = {"harm": 0.05, "shaping": 0.05, "shaping_discount": 0.99}
BLOCKS = {  # scenario, worlds at once, reward
    "one": ("paper-random", 64, SHAPED),
    "pair": ("cooperation-3-pair", 32, SHAPED),
    "readme": ("paper-random", 64, "harm"),
}
SEEDS, STEPS, WORLDS = range(5), 200_000, 500
MEASURES = {  # heading -> measure and digits
    "first-impact harm": ("first_impact_harm", 2),
    "total harm": ("total_harm", 2),
    "sampled harm": ("sampled_harm", 1),
    "Vehicle 1 shoved (m)": ("vehicle_1_shoved_m", 1),
    "shoved > 5 m (%)": ("vehicle_1_shoved_far_rate", 1),
    "moving at 8 s (%)": ("moving", 1),
}


def train(block: str, seed: int) -> PPO:
    """The model of a block, trained as the page does with another seed."""
    name, _, bootstrap = block.partition("-")
    scenario, worlds, reward = BLOCKS[name]
    venv = eb.make_sb3_vec_env(scenario, n_envs=worlds, seed=seed, reward=reward, horizon_is_end=not bootstrap)
    return PPO("MlpPolicy", venv, n_steps=64, batch_size=512, learning_rate=1e-3, seed=seed).learn(STEPS)


def measure(block: str, model: PPO) -> dict[str, float]:
    """The measures of the policy on worlds that no training has seen."""
    agents = {"full_brake": eb.make_agent("full_brake"), block: eb.policy_agent(model, clip=True)}
    row = eb.summarise(eb.evaluate(agents=agents, scenario=BLOCKS[block.partition("-")[0]][0], episodes=WORLDS))[1]
    told = {name: estimate.value for name, estimate in row.estimates.items() if estimate is not None}
    return (
        told
        | {"moving": 100.0 * row.horizon_ends / row.episodes}
        | {name: 100.0 * told[name] for name in ("vehicle_1_shoved_far_rate",)}
    )


def line(block: str, seeds: list[dict[str, float]]) -> str:
    """The row of a block: median and range of each measure over its seeds."""
    cells = []
    for name, digits in MEASURES.values():
        values = sorted(each[name] for each in seeds if name in each)
        cells.append(
            "–" if not values else f"{median(values):.{digits}f} ({values[0]:.{digits}f} to {values[-1]:.{digits}f})"
        )
    return f"| {' | '.join([f'`{block}`', *cells])} |"


if __name__ == "__main__":
    torch.set_num_threads(1)
    rows = []
    for block in sys.argv[1:]:
        found = []
        for seed in SEEDS:
            found.append(measure(block, train(block, seed)))
            print(
                block,
                seed,
                {name: round(found[-1][name], 3) for name, _ in MEASURES.values() if name in found[-1]},
                flush=True,
            )
        rows.append(line(block, found))
    print("\n".join([f"| {' | '.join(['block', *MEASURES])} |", "| --- |" + " ---: |" * len(MEASURES), *rows]))
