"""The body that yields against other finite elements, the conditions of contact, and what rigid motion must do."""

import numpy as np
import pytest
import skfem
import trimesh
from scipy.sparse.linalg import splu
from skfem.helpers import ddot, det, div, eye, grad, inv, mul, sym_grad, trace, transpose

from scenes.scene_types import Material, Scene, Thing
from twin.displacement import moved_to, volume_ratio
from twin.living import elastic_body
from twin.ultrasound.echo_solids import body

SIZE, TOP = np.array([80.0, 60.0, 30.0]), 650.0
DOWN = np.array([0.0, 0.0, 1.0])


def block():
    """A block of silicone on a hard base."""
    box = trimesh.creation.box(SIZE)
    box.apply_translation([0, 0, TOP + SIZE[2] / 2])
    return body(Scene("breast", (Thing("breast", box, Material(0.4)),)))


def foot(depth_mm, half=(20.0, 6.0), radius=15.0):
    """Points of a foot, rounded across, that stands in the block by a depth."""
    x, y = np.meshgrid(np.linspace(-half[0], half[0], 17), np.linspace(-half[1], half[1], 7), indexing="ij")
    return np.stack([x, y, TOP + depth_mm - y**2 / (2 * radius)], axis=-1).reshape(-1, 3)


@pytest.fixture(scope="module")
def soft():
    there = block()
    return elastic_body.elastic_body(there, there.solids[0], None, 3.0)


@pytest.fixture(scope="module")
def pressed(soft):
    return elastic_body.press(soft, foot(2.0), DOWN)


def quarter(shape=(6, 5, 5)):
    """A quarter of the block: nodes that quadratic elements need, and which of them the block's skin, base and middle hold."""
    graded = SIZE[2] * np.linspace(0, 1, shape[2] + 1) ** 1.4
    mesh = skfem.MeshHex.init_tensor(np.linspace(0, SIZE[0] / 2, shape[0] + 1), np.linspace(0, SIZE[1] / 2, shape[1] + 1), graded)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementHex2()), intorder=4)
    axis = np.zeros(basis.N, int)
    for numbers in (basis.dofs.nodal_dofs, basis.dofs.edge_dofs, basis.dofs.facet_dofs, basis.dofs.interior_dofs):
        for k in range(3):
            axis[numbers[k::3]] = k
    return basis, axis


def neo_hookean(skin):
    """Displacements of an incompressible neo-Hookean quarter whose skin is moved as given: Taylor-Hood elements."""
    basis, axis = quarter()
    pressures = basis.with_element(skfem.ElementHex1())
    places = basis.doflocs
    points = places.T + np.array([0, 0, TOP])
    moved = (moved_to(skin, points) - points)[np.arange(basis.N), axis]
    held = np.isclose(places[2], SIZE[2]) | np.isclose(places[2], 0)
    held |= (np.isclose(places[0], 0) & (axis == 0)) | (np.isclose(places[1], 0) & (axis == 1))
    u, p = (
        np.where(np.isclose(places[0] * (axis == 0) + places[1] * (axis == 1), 0) & (axis < 2), 0.0, moved),
        -np.ones(pressures.N),
    )
    free = np.concatenate([np.flatnonzero(~held), basis.N + np.arange(pressures.N)])

    @skfem.BilinearForm
    def stiffness(du, v, w):
        back, change = w["back"], grad(du)
        turned = transpose(back)
        volume = ddot(turned, change) * ddot(turned, grad(v)) - ddot(transpose(mul(back, mul(change, back))), grad(v))
        return ddot(change, grad(v)) + w["p"] * w["ratio"] * volume

    @skfem.BilinearForm
    def coupling(du, q, w):
        return q * w["ratio"] * ddot(transpose(w["back"]), grad(du))

    @skfem.LinearForm
    def forces(v, w):
        return ddot(w["stretch"], grad(v)) + w["p"] * w["ratio"] * ddot(transpose(w["back"]), grad(v))

    @skfem.LinearForm
    def volumes(q, w):
        return q * (w["ratio"] - 1)

    for _ in range(12):
        stretch = grad(basis.interpolate(u)) + np.eye(3)[:, :, None, None]
        there = {"stretch": stretch, "back": inv(stretch), "ratio": det(stretch), "p": pressures.interpolate(p)}
        rows = coupling.assemble(basis, pressures, **there)
        matrix = skfem.bmat([[stiffness.assemble(basis, **there), rows.T], [rows, None]], "csc")
        off = np.concatenate([forces.assemble(basis, **there), volumes.assemble(pressures, **there)])
        step = np.zeros(len(off))
        step[free] = splu(matrix[free][:, free].tocsc()).solve(-off[free])
        u, p = u + step[: basis.N], p + step[basis.N :]
        if np.abs(step[: basis.N]).max() < 1e-4:  # mm; the next one would be far smaller
            break
    else:
        raise AssertionError("expected Newton's steps to end")
    nodes = basis.mesh.p.T + np.array([0, 0, TOP])
    return nodes, np.stack([u[basis.nodal_dofs[k]] for k in range(3)], axis=1)


def test_the_stiffness_is_that_of_scikit_fem(rng):
    """Of skewed columns, one of them left out: shape in full, volume in the elements' middles alone."""
    shape = 4, 5, len(elastic_body.LAYERS) + 1
    skin = TOP + rng.uniform(-3, 3, shape[:2])
    kept = np.ones((3, 4), bool)
    kept[0, 0] = False
    mesh = elastic_body.Mesh(np.array([0.0, 3.0, 5.0, 9.0]), np.array([0.0, 2.0, 5.0, 7.0, 10.0]), skin, TOP + 30.0, kept)
    modulus = rng.uniform(5.0, 50.0, (3, 4, shape[2] - 1))
    nodes, number = mesh.nodes().reshape(-1, 3), np.arange(np.prod(shape)).reshape(shape)
    order = [(1, 1, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)]  # of scikit-fem's corners
    there = np.broadcast_to(kept[..., None], modulus.shape)
    cells = np.stack([number[i : 3 + i, j : 4 + j, k : shape[2] - 1 + k][there] for i, j, k in order])
    used, compact = np.unique(cells, return_inverse=True)
    hexes, element = skfem.MeshHex(nodes[used].T.copy(), compact.reshape(cells.shape)), skfem.ElementVector(skfem.ElementHex1())
    whole = skfem.Basis(hexes, element, intorder=3)
    middle = skfem.Basis(hexes, element, quadrature=(np.full((3, 1), 0.5), np.ones(1)))

    @skfem.BilinearForm
    def shearing(u, v, w):
        strain = sym_grad(u)
        return 2 * w["shear"] * ddot(strain - eye(trace(strain) / 3, 3), sym_grad(v))

    @skfem.BilinearForm
    def swelling(u, v, w):
        return w["bulk"] * div(u) * div(v)

    shear = modulus[there][:, None] / 3
    bulk = 2 * (1 + elastic_body.POISSON) / (3 * (1 - 2 * elastic_body.POISSON)) * shear
    expected = shearing.assemble(whole, shear=shear * np.ones((1, whole.dx.shape[1]))) + swelling.assemble(middle, bulk=bulk)
    found = elastic_body._stiffness(mesh, modulus)
    places = np.stack([3 * used + k for k in range(3)], axis=1).ravel()  # scikit-fem has a node's numbers side by side, too
    assert (whole.nodal_dofs.T.ravel() == np.arange(3 * len(used))).all()
    assert abs(found[places][:, places] - expected).max() < 1e-10 * abs(expected).max()


@pytest.mark.slow
def test_displacements_are_those_of_a_neo_hookean_body_with_the_same_skin(pressed):
    nodes, expected = neo_hookean(pressed)
    inner = (nodes[:, 2] > TOP + 1) & (nodes[:, 2] < TOP + SIZE[2] - 1)
    found = moved_to(pressed, nodes) - nodes
    off = np.linalg.norm(found - expected, axis=1)[inner]
    depth_mm = np.linalg.norm(found, axis=1).max()
    assert np.sqrt(np.mean(off**2)) < 0.02 * depth_mm  # 1.0 %, at most 7 % of it
    assert off.max() < 0.1 * depth_mm


def test_tissue_keeps_its_volume(pressed):
    ratio = volume_ratio(pressed)
    x, y, z = (start + 2.5 * (np.arange(count) + 0.5) for start, count in zip(pressed.first, ratio.shape, strict=True))
    inner = np.ix_(np.abs(x) < SIZE[0] / 2 - 3, np.abs(y) < SIZE[1] / 2 - 3, (z > TOP + 2) & (z < TOP + SIZE[2] - 2))
    assert np.abs(ratio[inner].mean() - 1) < 1e-3
    assert np.quantile(np.abs(ratio[inner] - 1), 0.99) < 0.01


def test_the_skin_lies_in_the_foot_or_below_it(pressed):
    places = foot(2.0)
    skin = np.column_stack([places[:, :2], np.full(len(places), TOP)])
    gap = moved_to(pressed, skin)[:, 2] - places[:, 2]  # below the foot
    touched = np.abs(places[:, 1]) < 4.5
    assert np.abs(gap[touched]).max() < 0.12  # between nodes of the skin
    assert gap.min() > -0.15


def test_a_foot_above_the_skin_pushes_nothing(soft):
    lifted = elastic_body.press(soft, foot(-0.5), DOWN)
    assert np.abs(lifted.moved).max() == 0


def test_skin_is_drawn_along_by_a_foot_that_slides(soft, pressed):
    drawn = elastic_body.press(soft, foot(2.0), DOWN, drag=np.array([0.0, 1.0, 0.0]))
    under = np.array([[0.0, 0.0, TOP], [10.0, 0.0, TOP]])
    aside = (moved_to(drawn, under) - moved_to(pressed, under))[:, 1]
    assert aside == pytest.approx([1, 1], abs=0.15)
    deep = np.array([[0.0, 0.0, TOP + 25.0]])
    assert abs((moved_to(drawn, deep) - moved_to(pressed, deep))[0, 1]) < 0.2


def test_a_body_goes_along_with_its_base(soft):
    shift = np.array([0.3, -0.2, 0.5])
    moved = soft.moved_base(np.broadcast_to(shift, (*soft.size[:2], 3)))
    np.testing.assert_allclose(moved, np.broadcast_to(shift, moved.shape), atol=1e-6)


def test_responses_have_the_same_bits_in_any_order(soft):
    other = elastic_body.elastic_body(block(), block().solids[0], None, 3.0)
    nodes = np.array([5 * soft.size[1] + 7, 9 * soft.size[1] + 3])
    here, there = soft.respond(nodes), other.respond(nodes[::-1])
    assert all((here[node] == there[node]).all() for node in nodes.tolist())


def test_few_responses_are_kept_and_those_that_come_again_have_the_same_bits(soft, monkeypatch):
    """Feet here and there, each on more tiles than are kept."""
    monkeypatch.setattr(elastic_body, "KEPT", 6)
    first, kept = elastic_body.press(soft, foot(2.0), DOWN), []
    for aside in (-15.0, 15.0):
        elastic_body.press(soft, foot(2.0) + np.array([aside, aside, 0.0]), DOWN)
        kept.append(len(soft.responses))
    again = elastic_body.press(soft, foot(2.0), DOWN)
    assert max(kept) <= 6
    assert (again.moved == first.moved).all()
    assert (again.back == first.back).all()
