"""Faces of arrays whose lines fan out. Each module is one, by the name of the field that a transducer's file has.

A module has a `Face`: a pydantic model of the field's settings, with

- `lines`: number of lines, which begin on an arc at right angles; `pitch_mm`: from line to line on the arc; `bend`: 1/mm, one
  over the arc's radius, over 0 and finite;
- `chord_mm`: from the arc's end to its end; `sagitta_mm`: by which the middle of the arc stands out before its ends;
- `foot_mm`: width of what touches the skin.

A curved array is its arc, and stands on its chord. A phased array's lines leave a small arc about a place behind the middle of
its face; its `foot_mm` is the array's own width, much more than that arc's `chord_mm`. Without such a field an array is linear:
a line a column of the image, parallel.
"""
