"""A run from its configuration to its folder: built, carried out, judged, kept, resumed."""
