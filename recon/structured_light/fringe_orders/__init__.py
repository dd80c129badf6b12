"""Ways to unwrap: the order of a fringe, which its phase leaves open. Each module is one, named as `unwrap` of patterns has it.

A module has

- `WHOLE_IMAGE`: whether orders at a place may come from any other place of the image, so that no part of it is enough;
- `ALONE`: types of parts that encode an axis without fringes;
- `check(parts, axis)`: ValueError, with the words of the refusal, if the parts of a sequence don't serve an axis with fringes;
- `orders(shots, axis, sets, valid, light)`: the `Ordered` fringes of the finest set, or InputError if images don't follow their
  sequence. `sets` are the fringes of the axis with what was found of them, `valid` : (h, w) bool the pixels with enough
  modulation, and `light` a suspected cause of phases that contradict each other, in words.
"""
