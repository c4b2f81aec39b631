"""The panel in the browser (viser); what it shows comes from the engine's events alone."""
