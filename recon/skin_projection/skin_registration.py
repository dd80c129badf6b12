"""The rigid motion of a body from its skin, measured before and after: masses that were found before are moved along.

Symmetric point to plane [Rusinkiewicz 2019], with robust weights: the distance of two points along the mean of their normals,
which is zero for any two points of one arc, so that sampling adds no error of its own. Points and normals are those of small
patches of the skins: normals of single triangles are mostly noise, which would pass for knowledge of motions along the skin. The
uncertainty is that of the weighted least squares; motions by which the skin slides in itself, as a sphere turns about its middle,
are uncertain by it, and so are masses far from that.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from recon.errors import InputError
from recon.estimation.covariance import propagate
from recon.geometry import rigid
from recon.geometry.surface_tree import surface_tree

Array = NDArray[np.float64]

VERTICES = 60_000  # of a skin, evenly chosen
PATCH = 40  # of them in a patch: some 3 mm about its middle, on a breast
OVERLAP = 3  # patches that a vertex is in
SETTLED = np.array([1e-7] * 3 + [1e-5] * 3)  # step, rad and mm, after which it is done
APART = PATCH // OVERLAP  # vertices from the middle of a patch to that of the next
# Variance of Tukey's estimate over `variance * inv(squares)`, of normal errors: E[(w r)^2] / E[d(w r)/dr]^2 = 1.053 by 0.905 of
# E[w r^2] / E[w]^2 [Huber 1981, 7.6].
LOST_BY_WEIGHTS = 1.163
# Factor of the covariance, 3.6: so many patches have a vertex, and its noise, in common; times what the weights lose. Noise that
# vertices have in common isn't in it. Of eight rendered shifts of a breast the squared normalised errors need 3.5 on average, 1.5
# to 8.6 each, about as far apart as means of six squares are.
SHARED_NOISE = PATCH / APART * LOST_BY_WEIGHTS


class Patches(NamedTuple):
    """Small pieces of a skin."""

    middles: Array  # (n, 3) mm
    normals: Array  # (n, 3)


@dataclass(frozen=True, eq=False)
class SkinShift:
    """The rigid motion between two measurements of one skin."""

    new_from_old: Array  # (4, 4)
    covariance: Array  # (6, 6) of the step as in `rigid.moved`, rad and mm
    rms_mm: float  # of the distances along the normals that are left: noise, and any change of shape
    share: float  # of the old skin's points that the new one has, too

    def sigma_mm(self, point: ArrayLike) -> float:
        """Standard deviation of the place to which a point : (3,) mm is moved, along the direction where it is largest."""
        slopes = rigid.slopes(rigid.rotate(self.new_from_old, point))
        return float(np.sqrt(np.linalg.eigvalsh(propagate(slopes, self.covariance))[-1]))


def register(old: trimesh.Trimesh, new: trimesh.Trimesh) -> SkinShift:
    """The motion from an old skin to a new one, both without the table, up to about 15 mm and some degrees.

    Raises
    ------
    InputError
        If too little of the old skin lies on the new one, or its shape leaves the motion open, as a plane's does.
    """
    before, after = patches(old), patches(new)
    least_slack = 1e-9  # see `_slack`: less is a plane or another shape without any noise, whose equations have no solution
    if not len(after.middles) or _slack(before) < least_slack:
        raise InputError("skin: expected one that is bent in all directions, found one that slides in itself: measure more of it")
    first_mm, last_mm = 15.0, 4.0  # farthest pair, at first and at last
    tree, pose, reach = surface_tree(after.middles), np.eye(4), first_mm
    widths = 4.685  # robust standard deviations at which Tukey's weight ends, 95 % efficient for normal errors
    least_turn = 0.8  # cosine between the normals of partners
    rounds = 60
    least_share = 0.4  # of the patches with a partner
    for _ in range(rounds):
        moved, turned = rigid.apply(pose, before.middles), rigid.rotate(pose, before.normals)
        distance, nearest = tree.query(moved)
        others = after.normals[nearest]
        paired = (distance < reach) & ((others * turned).sum(axis=1) > least_turn)
        share = float(paired.mean())
        if share < least_share:
            raise InputError(
                f"skin: expected the earlier skin, moved by up to {first_mm:g} mm, found {share:.0%} of it on the new one: "
                "is it another body, or did it move farther? then find the masses anew"
            )
        between = (turned + others)[paired] / 2
        off = ((after.middles[nearest] - moved)[paired] * between).sum(axis=1)
        slopes = np.column_stack([np.cross(rigid.rotate(pose, before.middles[paired]), between), between])
        scale = max(1.4826 * float(np.median(np.abs(off))), 1e-6)
        weights = np.maximum(1 - (off / (widths * scale)) ** 2, 0) ** 2
        squares = slopes.T @ (weights[:, None] * slopes)
        change = np.linalg.solve(squares, slopes.T @ (weights * off))
        pose, reach = rigid.moved(pose, change), max(reach / 2, last_mm)
        if (np.abs(change) < SETTLED).all():
            break
    variance = float((weights * off**2).sum() / max(weights.sum() - 6, 1))
    return SkinShift(pose, SHARED_NOISE * variance * np.linalg.inv(squares), float(np.sqrt(variance)), share)


def _slack(skin: Patches) -> float:
    """How far a skin is from sliding in itself: the least mean square of its ways along its normals, in any motion of size 1."""
    if len(skin.middles) < len(SETTLED):
        return 0.0
    arms = skin.middles - skin.middles.mean(axis=0)
    arms /= np.linalg.norm(arms, axis=1).mean()
    slopes = np.column_stack([np.cross(arms, skin.normals), skin.normals])
    return float(np.linalg.eigvalsh(slopes.T @ slopes / len(slopes))[0])


def patches(skin: trimesh.Trimesh) -> Patches:
    """Pieces of a skin all over it but at its rim, each the mean and the plane of its nearest vertices."""
    step = max(1, len(skin.vertices) // VERTICES)
    vertices, normals = np.asarray(skin.vertices)[::step], np.asarray(skin.vertex_normals)[::step]
    chosen = np.arange(0, len(vertices), APART)
    _, near = surface_tree(vertices).query(vertices[chosen], min(PATCH, len(vertices)))
    middles = vertices[near].mean(axis=1)
    arms = vertices[near] - middles[:, None]
    radius = np.sqrt(2 * np.einsum("nki,nki->n", arms, arms) / near.shape[1])  # of a disc with that second moment
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", arms, arms))
    planes = axes[:, :, 0]
    planes *= np.where((planes * normals[chosen]).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    aside = middles - vertices[chosen]
    aside -= (aside * planes).sum(axis=1)[:, None] * planes
    one_sided = 0.3  # of a patch's radius, that its middle is off the vertex about which it lies: it lies at the rim
    whole = np.linalg.norm(aside, axis=1) < one_sided * radius
    return Patches(middles[whole], planes[whole])
