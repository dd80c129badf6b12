"""Spatial phase unwrapping from a projected centre line, and what other ways take of it. New methods go to `fringe_orders`."""
