"""Films of docs/gallery.md: one world of a scenario, only the road, in real time.

.venv/bin/python docs/studies/gallery.py docs/figures/gallery
"""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image

import ethbrake_marl as eb
from ethbrake_marl.agent_names import teams_of
from ethbrake_marl.extensions.rendering.film import FPS, LAST_S, ROAD, film_scenes
from ethbrake_marl.extensions.rendering.picture import picture

EVERY = 2  # scenes from one picture to the next
COLOURS = 32
WORLDS = {  # scenario -> agent, world of the list of seed 7
    "paper-random": ("e_v2x_bm", 14),
    "paper-random-obstacle": ("plan", 5),
    "paper-delay-high": ("full_brake", 0),
    "realistic-motorway": ("e_v2x_bm", 1),
    "realistic-mixed": ("full_brake", 0),
    "realistic-truck": ("e_v2x_bm", 4),
    "realistic-platoon": ("full_brake", 3),
    "stress-wide": ("full_brake", 4),
    "cooperation-2-five": ("e_v2x_bm", 0),
    "cooperation-3-five": ("full_brake", 1),
    "cooperation-4-all": ("plan", 1),
    "messages-noisy": ("plan", 0),
}


def write_film(folder: Path, name: str) -> None:
    agent, world = WORLDS[name]
    scenario, game = eb.open_game(name)
    (team,) = teams_of(agent, scenario).values()
    scenes = film_scenes(scenario.sample(1, 7, first=world), team, game)
    shown = [scene._replace(title=f"{name}, world {world}: {agent}") for scene in [*scenes[:-1:EVERY], scenes[-1]]]
    first, *later = (Image.fromarray(picture(scene)[:ROAD]).quantize(COLOURS) for scene in shown)
    times_ms = [*len(later) * [1000 * EVERY // FPS], 1000 * LAST_S]
    first.save(folder / f"{name}.gif", save_all=True, append_images=later, duration=times_ms, loop=0)


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("folder", type=Path, help="folder for the films")
parser.add_argument("--only", choices=[*WORLDS], help="make only the film of this scenario")
chosen = parser.parse_args()
for scenario_name in [chosen.only] if chosen.only else WORLDS:
    write_film(chosen.folder, scenario_name)
