"""Targets of the probe. Each module is a kind of target: three to eight circles, c0, c1, c2 and on, at places that lengths tell.

A module has `Kind`, a subclass of `recon.model.rig.Target` with

- `kind`: a literal of the module's name; in a file `rig.target.kind` names it;
- `LENGTHS`: names of the fields that tell the places, as `recon.model.circle_layout` has them; and these fields.

All else follows from the lengths: which circle is which in a view, pose and covariance, print, rendering and training. c0 is the
lowest one at the left. The networks of another kind of target name other circles, so they are trained anew.
"""
