"""The parts that this extension adds: group -> name -> module of this folder and object."""

PARTS = {"physics": {"paper-map": "paper_map:PAPER_MAP"}, "commands": {"reproduce": "commands:REPRODUCE"}}
