"""What the module needs beside its panel. Slicer's Python has no sonotwin, so nothing here imports it."""
