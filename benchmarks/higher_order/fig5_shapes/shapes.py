"""The problems: a sphere of 2562 vertices before pictures of a monkey's head, and one of 2737 with colours before those of a banana.

SUZANNE takes `suzanne.ply` of Mitsuba's tutorials, which the project does not ship. BANANA is made by code, since the paper's mesh is not
public: a bent body with as many vertices, yellow with brown ends; its colours are an attribute of the vertices, unknown as well.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import mi, parts

VERTICES = 2737
"""Of BANANA, as in the paper."""
_DEPTH = 2
_GREY = 0.5


def suzanne(resolution: int, views: int, vertices: int, meshes: Path) -> ur.Problem:
    """A subdivided icosahedron of at most `vertices` vertices, 2562 for the paper's. Raises `InputError` where the file is missing."""
    subdivisions = int(np.log2((vertices - 2) / 10) / 2)
    options = {"subdivisions": subdivisions, "resolution": resolution, "views": views}
    return ur.gallery.problem("sphere-to-mesh", **options, mesh=str(meshes / "suzanne.ply"))


def banana(resolution: int, views: int, vertices: int) -> ur.Problem:
    """`vertices` vertices and their colours, from a grey sphere at the body's middle."""
    directions, faces = ball(vertices)
    body, colours = bent(directions)

    def scene(points: np.ndarray, paint: np.ndarray) -> dict[str, Any]:
        return stage(resolution, views) | {"sphere": _coloured("sphere", points, faces, paint)}

    true = mi.load_dict(scene(body, colours))
    integrator = mi.load_dict({"type": "path", "max_depth": _DEPTH})
    pictures = [
        np.array(mi.render(true, sensor=view, spp=512, seed=view, integrator=integrator)) for view in range(views)
    ]
    return ur.Problem(
        lambda: scene(0.6 * directions, np.full_like(colours, _GREY)),
        [ur.Parameter("sphere.vertex_positions"), ur.Parameter("sphere.vertex_color", bounds=(0.0, 1.0))],
        [ur.View(picture, sensor) for sensor, picture in enumerate(pictures)],
        ur.losses.L2(),
        _DEPTH,
        name="banana",
    )


def ball(vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """The unit sphere as triangles of any number of vertices: positions (V, 3) on a spiral, and faces (2 V - 4, 3), facing outward."""
    from scipy.spatial import ConvexHull

    height = 1 - (2 * np.arange(vertices) + 1) / vertices
    angle = np.pi * (1 + 5**0.5) * np.arange(vertices)
    radius = np.sqrt(1 - height**2)
    points = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], -1)
    faces = ConvexHull(points).simplices
    a, b, c = points[faces.T]
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    return points, faces


def bent(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A thick arc from the unit sphere: positions and colours, (V, 3) each."""
    along, side, depth = directions[:, 1], directions[:, 0], directions[:, 2]
    angle = 1.1 * along
    thick = 0.34
    arc = 1.0 + thick * side
    points = np.stack([arc * np.cos(angle) - 0.8, arc * np.sin(angle), thick * depth], -1)
    end = np.clip((np.abs(along) - 0.8) / 0.15, 0, 1)[:, None]
    return points, (1 - end) * np.array([0.9, 0.75, 0.15]) + end * np.array([0.25, 0.15, 0.08])


def stage(resolution: int, views: int) -> dict[str, Any]:
    """Cameras around, by turns lower and higher, and a sky."""
    angles = 2 * np.pi * np.arange(views) / views
    return {
        "type": "scene",
        **parts.cameras_around(angles, 3.8, (0.6, 2.2), (0, 0, 0), 36.0, resolution),
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 0.5, 0.5]}},
    }


def _coloured(name: str, points: np.ndarray, faces: np.ndarray, colours: np.ndarray) -> Any:
    """A smooth mesh whose reflectance is its vertices' colour."""
    paint = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": paint})
    mesh = mi.Mesh(name, len(points), len(faces), properties, has_vertex_normals=True)
    mesh.add_attribute("vertex_color", 3, colours.ravel().astype(np.float32))
    parameters = mi.traverse(mesh)
    parameters["faces"] = mi.UInt32(faces.ravel().astype(np.uint32))
    parameters["vertex_positions"] = mi.Float(points.ravel().astype(np.float32))
    parameters.update()
    return mesh
