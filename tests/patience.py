"""How long tests wait for what comes at once unless something hangs: no measure of anything, however busy the machine is."""

PATIENCE_S = 600.0
