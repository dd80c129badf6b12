"""Joint calibration of cameras and projector from sightings of a board."""
