"""SUMO's floating-car data of five minutes on a motorway, with the gap that SUMO measures. See field.py."""

import subprocess
from pathlib import Path

import sumo

NODES = '<nodes><node id="a" x="0" y="0"/><node id="b" x="3000" y="0"/></nodes>'
EDGES = '<edges><edge id="m" from="a" to="b" numLanes="2" speed="33.3"/></edges>'
FLOW = 'route="r" begin="0" end="300"'
ROUTES = f"""<routes>
<vType id="c" length="4.5" tau="0.9" sigma="0.7" speedDev="0.12"/><vType id="t" length="12" maxSpeed="25"/>
<route id="r" edges="m"/>
<flow id="f" type="c" {FLOW} vehsPerHour="3000" departLane="random" departSpeed="25"/>
<flow id="g" type="t" {FLOW} vehsPerHour="400" departLane="0" departSpeed="22"/>
</routes>"""


def main(folder: Path) -> None:
    """Write ``fcd.csv``."""
    for name, text in (("n.nod.xml", NODES), ("e.edg.xml", EDGES), ("r.rou.xml", ROUTES)):
        (folder / name).write_text(text)
    programs = Path(sumo.__path__[0]) / "bin"
    network = ["-n", "n.nod.xml", "-e", "e.edg.xml", "-o", "m.net.xml"]
    subprocess.run([programs / "netconvert", *network], cwd=folder, check=True, capture_output=True)
    written = ["--fcd-output", "fcd.csv", "--fcd-output.attributes", "id,lane,pos,speed,type,leaderGap"]
    further = ["--fcd-output.max-leader-distance", "400", "--precision", "6", "--step-length", "0.5", "--end", "300"]
    traffic = ["-n", "m.net.xml", "-r", "r.rou.xml", *written, *further]
    subprocess.run([programs / "sumo", *traffic], cwd=folder, check=True, capture_output=True)
