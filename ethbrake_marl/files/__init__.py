"""Read files strictly; write files completely or not at all. All code for file formats is in this folder."""
