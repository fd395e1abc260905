"""Learning algorithms: one file each, behind the few methods of ``algorithms.protocol.Algorithm``."""
