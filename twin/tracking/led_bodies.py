"""Bodies besides the probe that cameras track: their looks, and the paths that lead them."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.errors import InputError
from recon.model.rig import BodyName, Part, Rig, Target
from scenes.handheld.body_look import Look, look_of
from twin import conditions
from twin.tracking.film_path import STILL, Aimed, FilmPath, Way
from twin.tracking.film_paths import hand, still
from twin.tracking.views_of_target import cameras_of

Array = NDArray[np.float64]

# of bodies that no path is given for, beside the probe's usual one: the first above, the second below, facing the cameras
PLACES_MM = ((70.0, -46.0, 660.0), (76.0, 46.0, 668.0))
ROLLS_DEG = (75.0, 20.0)
# beside what is scanned, where neither the probe's board nor the phantom hides one that stands there
STANDS_MM = ((-82.0, 66.0, 652.0), (-82.0, -66.0, 652.0))
BREATH_MM, BREATH_S, SWAY_MM = 1.5, 4.0, 12.0  # by which a body on a post moves, in what time, and by which a hand does


class LedBody(Part):
    """Look and path of a body besides the probe."""

    look: Look | None = None  # that of its name if there is one, or a board on a post
    path: FilmPath | None = None  # beside the probe's usual one


class LedBodies(Part):
    """Settings of bodies besides the probe."""

    bodies: dict[BodyName, LedBody] = Field(default_factory=dict)  # of those that the rig has

    def look(self, name: str) -> Look:
        """Look of a body."""
        given = self.bodies.get(name)
        return look_of(name) if given is None or given.look is None else given.look

    def path_of(self, name: str, number: int) -> FilmPath:
        """Path of a body, the rig's one of a number; beside the probe's usual one if none is given.

        Raises
        ------
        InputError
            If none is given, and there is no room left.
        """
        given = self.bodies.get(name)
        return beside(name, number, self.look(name)) if given is None or given.path is None else given.path

    def standing(self, rig: Rig) -> dict[str, FilmPath]:
        """Paths of the bodies that stand beside what is scanned, by name: at rest, if none is given.

        Raises
        ------
        InputError
            If there is no room left for one without a path.
        """
        paths, places = dict[str, FilmPath](), iter(STANDS_MM)
        for name in rig.bodies:
            given = self.bodies.get(name)
            if self.look(name).IN_A_HAND:
                continue
            if given is not None and given.path is not None:
                paths[name] = given.path
            elif place := next(places, None):
                paths[name] = still.Kind(place_mm=place)
            else:
                raise InputError(
                    f"bodies.{name}.path: needs a value: {len(STANDS_MM)} bodies stand beside what is scanned, this is another"
                )
        return paths

    def lead(
        self,
        name: str,
        path: FilmPath,
        rig: Rig,
        world_from_face: Array,
        seed: int,
        errors: conditions.Motion,
        others: Sequence[tuple[Target, Array]] = (),
    ) -> Way:
        """Lead a body of the rig along a path.

        Parameters
        ----------
        world_from_face : (4, 4) mm
            Where the array's face stands; see `Aimed`.
        errors : of hands, which what stands on a post doesn't have
        others : see `Aimed`

        Raises
        ------
        InputError
            If the path isn't one for such a body.
        """
        look, target, number = self.look(name), rig.bodies[name], list(rig.bodies).index(name) + 1
        cameras = cameras_of(rig)
        eyes = np.mean([camera.centre for camera in cameras], axis=0)
        aimed = Aimed(look.line_mm(target), world_from_face, cameras, others)
        try:
            return path.lead(target, eyes, seed, errors if look.IN_A_HAND else STILL, [number], aimed)
        except InputError as error:
            raise InputError(f"bodies.{name}.{error}") from None


def check_names(bodies: Mapping[str, LedBody], rig: Rig) -> None:
    """Check that the rig has bodies of these names; ValueError if not."""
    if unknown := [name for name in bodies if name not in rig.bodies]:
        there = ", ".join(rig.bodies) or "none, such as rig=three_bodies has"
        raise ValueError(f"bodies: expected names of the rig's further bodies ({there}), found {', '.join(unknown)}")


def beside(name: str, number: int, look: Look) -> FilmPath:
    """The path of a body that none is given for; InputError if there is no room left."""
    if number >= len(PLACES_MM):
        raise InputError(
            f"bodies.{name}.path: needs a value: {len(PLACES_MM)} bodies have one beside the probe's, this is another"
        )
    place, roll = np.array(PLACES_MM[number]), ROLLS_DEG[number]
    if not look.IN_A_HAND:
        breath = tuple(
            (*place[:2].tolist(), float(place[2]) + depth) for depth in (0.0, 0.5 * BREATH_MM, BREATH_MM, 0.5 * BREATH_MM)
        )
        return hand.Kind(seconds=BREATH_S, places_mm=breath, roll_deg=roll, turn_deg=0.0, unsteady_mm=0.0)
    swayed = tuple(
        tuple((place + SWAY_MM * np.array(way)).tolist()) for way in ((0, 0, 0), (0.6, -0.3, 1), (1, 0.4, 0), (0.2, 0.6, -1))
    )
    return hand.Kind(places_mm=swayed, roll_deg=roll)
