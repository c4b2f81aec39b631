"""Independent runs of particles: what methods ``splitting`` and ``subset`` have in common."""
