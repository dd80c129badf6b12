"""Targets of the probe. Each module is a kind of target: three to eight circles, c0, c1, c2 and on, at places that lengths tell.

A module has `Kind`, a subclass of `recon.model.rig.Target` with

- `kind`: a literal of the module's name; in a file `rig.target.kind` names it;
- `LENGTHS`: names of the fields that tell the places, in this order: `c1_mm`; then of each further circle k `ck_aside_mm` (along
  x) and `ck_mm` (along y). Other names, or another order, are refused when the kind is loaded;
- these fields, in any order. What isn't aside is to be 5 to 1000 mm long, unless a target is `unusual`.

The frame, as one looks at the printed face: c0 is the origin, at the lower left; c1 lies on +x, to the right, and the others at
y > 0, above them. All else follows from the lengths: which circle is which in a view, pose and covariance, print, rendering and
training. The networks of another kind of target name other circles, so they are trained anew.
"""
