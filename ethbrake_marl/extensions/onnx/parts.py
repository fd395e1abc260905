"""The parts that this extension adds: group -> name -> module of this folder and object."""

PARTS = {"commands": {"agent.export": "commands:EXPORT"}}
