"""Freehand 3-D ultrasound: tracked sequences, and volumes compounded from them."""
