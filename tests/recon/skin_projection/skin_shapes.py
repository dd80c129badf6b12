"""Skins with closed forms, a ball beneath, and a projector, for tests of the light on the skin."""

import numpy as np
import trimesh

from recon.geometry import rigid
from recon.geometry.camera import Camera
from scenes.solid_meshes import grid

BALL, BALL_MM = np.array([4.0, -3.0, 700.0]), 9.0  # middle and radius
PLANE_MM, DOME_MM = 670.0, 60.0  # z of the plane; radius of the dome, whose middle lies under its top at the plane's height
STANDS_AT = np.array([-150.0, 60.0, 10.0])  # the projector


def plane(size=(100.0, 80.0), tilt=(0.0, 0.0, 0.0), step=1.0):
    """A flat skin about the line of sight over the ball, turned by a rotation vector in rad about its middle."""
    points, triangles = grid(size, (round(size[0] / step), round(size[1] / step)))
    pose = rigid.from_rotation_vector(tilt, [0, 0, PLANE_MM])
    return trimesh.Trimesh(rigid.apply(pose, np.column_stack([points, np.zeros(len(points))])), triangles[:, ::-1], process=False)


def dome(step=1.0, size=100.0):
    """A cap of a sphere, its top at the plane's height, towards the camera at the origin."""
    points, triangles = grid((size, size), (round(size / step),) * 2)
    inside = (np.hypot(*points.T) < 0.8 * DOME_MM)[triangles].all(axis=1)
    height = np.sqrt(np.maximum(DOME_MM**2 - (points**2).sum(axis=1), 0)) - DOME_MM
    mesh = trimesh.Trimesh(np.column_stack([points, PLANE_MM - height]), triangles[inside][:, ::-1], process=False)
    mesh.remove_unreferenced_vertices()
    return mesh


def ball(radius=BALL_MM, middle=BALL):
    return trimesh.creation.icosphere(subdivisions=5, radius=radius).apply_translation(middle)


def projector():
    """Beside the camera, aimed at the skin, with a distortion that bends lines by several px."""
    forward = (np.array([0, 0, PLANE_MM]) - STANDS_AT) / np.linalg.norm(np.array([0, 0, PLANE_MM]) - STANDS_AT)
    across = np.cross([0, 1, 0], forward)
    axes = np.array([across / np.linalg.norm(across), np.cross(forward, across / np.linalg.norm(across)), forward])
    matrix = np.array([[1900.0, 0, 640], [0, 1900, 400], [0, 0, 1]])
    return Camera((1280, 800), matrix, np.array([-0.3, 0.2, 0.002, -0.001, 0]), rigid.transform(axes, -axes @ STANDS_AT))
