"""Ways to unwrap: the order of a fringe, which its phase leaves open. Each module is one, named as `unwrap` of patterns has it.

With its order a fringe's phase tells the projector's coordinate: `x = zero + pitch (phase / 2 pi + order)`, px, with `zero` as
of `recon.model.patterns.Fringes.zero`. A module has

- `WHOLE_IMAGE`: whether orders at a place may come from any other place of the image, so that no part of it is enough;
- `ALONE`: types of parts that encode an axis without fringes, `(GrayCode,)` or `()`;
- `check(parts, axis)`: ValueError, in words that begin with "parts: ", if the parts of a sequence don't serve an axis with
  fringes;
- `orders(shots, axis, sets, valid, light)`: the orders of the finest set's fringes as `recon.structured_light.shots.Ordered`,
  with `Orders` of `gray_code`, or InputError if images don't follow their sequence. `shots` are the images; `sets` a list of
  `Measured` of `shots`, each set of fringes of the axis with its phase; `valid` : (h, w) bool the pixels with enough modulation;
  and `light` what the phases say of the light, in words for a refusal of phases that contradict each other: "" as a rule.
"""
