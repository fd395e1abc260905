"""The parts that this extension adds: group -> name -> module of this folder and object."""

PARTS = {"algorithm_variants": {"vine.cuda": "vine:CudaVine"}}
