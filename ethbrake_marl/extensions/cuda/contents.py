"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {"algorithm_variants": {"vine.cuda": "vine:CudaVine"}}
