"""Kinds of calibration boards. Each module is one, by the name of the field `kind` of a board.

A module has `Kind`, a subclass of `recon.model.boards.Board` with

- `kind`: a literal of the module's name; `columns` and `rows`; and further fields of its lengths. `STEP` is the name of that
  which is the distance from point to point, mm;
- `points()`: where its points are : (n, 3) mm, in OpenCV's order;
- `rim_mm`, a property: breadth of what is printed beyond them, mm;
- `half_turn_is_alike`, a property: whether it looks the same after half a turn, so that either corner may be the first;
- `find(image, full)`: its points in an image : (h, w) of values up to `full`, as of `recon.board_detection.detect.detect`;
- `shapes()`: what is printed.

A board of discs is a subclass of `Discs`, which has all but `kind`, `NEIGHBOURS`, `points`, `half_turn_is_alike` and `find`:
`circle_grid.find_circles` finds them by their `NEIGHBOURS`.
"""
