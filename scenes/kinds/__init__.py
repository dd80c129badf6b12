"""Kinds of scenes. Each module is one, by the name of the field `kind` of a scene.

A module has

- `Config`: a pydantic model of the scene's fields;
- `build(config)`: the `scenes.scene_types.Scene`, of the module's name;
- `MADE_OF`, if ultrasound is to see into it: names of `scenes.acoustics.TISSUES` by the names of its things without their
  numbers, and by "" what surrounds them.
"""
