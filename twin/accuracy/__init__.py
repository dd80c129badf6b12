"""Accuracy of the twin and of the pipeline, as numbers that a command measures."""
