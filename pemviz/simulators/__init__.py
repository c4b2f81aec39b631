"""Back ends of the braking scenario, behind one protocol."""
