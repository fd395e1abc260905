"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {"physics": {"paper-map": "paper_map:PAPER_MAP"}, "commands": {"reproduce": "commands:REPRODUCE"}}
