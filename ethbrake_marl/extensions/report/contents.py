"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {
    "pages": {"evaluation": "report:write_evaluation", "worlds": "figures:write_worlds", "run": "run:RunReport"}
}
