"""The demonstration's report and its parts."""
