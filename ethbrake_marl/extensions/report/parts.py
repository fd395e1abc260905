"""The parts that this extension adds: group -> name -> module of this folder and object."""

PARTS = {"pages": {"evaluation": "report:write_evaluation", "worlds": "figures:write_worlds", "run": "run:RunReport"}}
