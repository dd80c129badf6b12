"""Kinds of calibration boards. Each module is one, by the name of the field `kind` of a board.

A module has `Kind`, a subclass of `recon.model.boards.Board` (of `Discs` with discs) with

- `kind`: a literal of the module's name; its fields, with `columns` and `rows`; `STEP`: the name of that of the points' distance;
- `points`: where its points are, in OpenCV's order; `rim_mm`: breadth of what is printed beyond them;
- `half_turn_is_alike`: whether it looks the same after half a turn, so that either corner may be taken for the first;
- `find`: its points in an image, as of `recon.board_detection.detect.detect`;
- `shapes`: what is printed.
"""
