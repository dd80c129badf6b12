"""Faces of arrays whose lines fan out. Each module is one, by the name of the field that a transducer's file has.

A module has a `Face`: a pydantic model of the field's settings, with

- `lines`: number of lines, which begin on an arc at right angles; `pitch_mm`: from line to line on the arc; `bend`: 1/mm, one
  over the arc's radius;
- `chord_mm`: from the arc's end to its end; `foot_mm`: width of what touches the skin; `sagitta_mm`: by which the middle of the
  arc stands out before its ends.

Without such a field an array is linear: a line a column of the image, parallel.
"""
