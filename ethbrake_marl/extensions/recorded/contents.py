"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {"commands": {"scenario.from-data": "commands:FROM_DATA"}}
