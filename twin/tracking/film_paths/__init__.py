"""Paths of films. Each module is a kind of path: a subclass `Kind` of `twin.tracking.film_path.FilmPath`.

It has

- `kind`: a literal of the module's name, and the path's own fields, whose usual values stand in `conf/path/NAME.yaml`;
- `lead`: the pose of the target at any time, from a seed;
- `room_mm`: where surroundings stand behind it;
- `truth`, if there is more of it than the poses.
"""
