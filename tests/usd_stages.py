"""Small USD stages as texts, the irradiance that their lights give, and quadrature to compare."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from tests.statistics_tools import assert_same_mean, render_seeds

REFLECTANCE = 0.5
"""Of the small white floor on which irradiance is measured."""

SEEDS = range(16)


def write_stage(folder, text, name="stage.usda", **metadata):
    """Write a stage and return its path; `;` in the text ends a line. Metadata: upAxis="Z"."""
    lines = [f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value}"
             for key, value in metadata.items()]  # fmt: skip
    header = "(\n" + "\n".join(lines) + "\n)\n" if lines else ""
    path = folder / name
    path.write_text("#usda 1.0\n" + header + text.replace(";", "\n").replace("}", "\n}\n"))
    return path


def matrix_op(matrix):
    """Return the text that gives a prim a matrix for row vectors."""
    rows = ", ".join(f"({', '.join(repr(float(x)) for x in row)})" for row in np.asarray(matrix))
    order = 'uniform token[] xformOpOrder = ["xformOp:transform"]'
    return f"matrix4d xformOp:transform = ({rows});{order};"


def placed(x=0.0, y=0.0, z=5.0, turn=0.0):
    """Return the text that moves a prim and then turns it around its X axis."""
    order = 'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]'
    return f"double3 xformOp:translate = ({x}, {y}, {z});float xformOp:rotateX = {turn};{order};"


def floor_scene(scene, at=(0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0), size=0.01):
    """Return a scene with a small white floor, and a camera that sees nothing else."""
    at, up = np.array(at, dtype=float), np.array(up, dtype=float) / np.linalg.norm(up)
    side = np.eye(3)[np.argmin(np.abs(up))]
    look = mi.ScalarTransform4f().look_at
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [REFLECTANCE] * 3}}
    result = dict(scene)
    frame = look(origin=at.tolist(), target=(at + up).tolist(), up=side.tolist())
    result["probe"] = {"type": "rectangle", "bsdf": white}
    result["probe"]["to_world"] = frame @ mi.ScalarTransform4f().scale(size)
    frame = look(origin=(at + 2 * size * up).tolist(), target=at.tolist(), up=side.tolist())
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    film.update(pixel_format="rgb", component_format="float32")
    result["sensor"] = {"type": "orthographic", "near_clip": size / 10, "film": film}
    result["sensor"]["to_world"] = frame @ mi.ScalarTransform4f().scale(size / 2)
    result["integrator"] = {"type": "manylights_direct"}
    return result


def irradiance(scene, spp=64, seeds=SEEDS, **place):
    """Return the irradiance on a small floor, once a seed: (seeds, 8, 8, 3)."""
    loaded = mi.load_dict(floor_scene(scene, **place))
    return render_seeds(loaded, spp=spp, seeds=seeds) * np.pi / REFLECTANCE


def constant_image(value):
    """Return a value, grey or of three channels, as the exact image."""
    return np.broadcast_to(np.asarray(value, dtype=float), (1, 8, 8, 3)).copy()


def assert_irradiance(scene, expected, rounding=0.0, **options):
    """Assert the irradiance of a scene, and that a factor of 1.05 would be caught.

    `rounding` is a known relative error, of tessellated lights.
    """
    images = irradiance(scene, **options)
    exact = constant_image(expected)
    if rounding:
        means, target = images.mean(axis=(0, 1, 2)), exact.mean(axis=(0, 1, 2))
        assert np.allclose(means, target, rtol=rounding + 0.004), (means, target)
        assert not np.allclose(1.05 * means, target, rtol=rounding + 0.004)
        return
    assert_same_mean(images, exact)
    try:
        assert_same_mean(1.05 * images, exact)
    except AssertionError:
        return
    raise AssertionError("a factor of 1.05 was not caught")


# -- Quadrature: points, normals times areas, and from them irradiance


def rect_surface(matrix, width=1.0, height=1.0, cells=200):
    middles = (np.arange(cells) + 0.5) / cells - 0.5
    x, y = np.meshgrid(middles * width, middles * height)
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    normals = np.tile([0.0, 0.0, -width * height / cells**2], (len(points), 1))
    return moved_surface(points, normals, matrix)


def disk_surface(matrix, radius=0.5, cells=300):
    r, phi = np.meshgrid(
        np.sqrt((np.arange(cells) + 0.5) / cells), 2 * np.pi * (np.arange(cells) + 0.5) / cells
    )
    points = radius * np.stack([r * np.cos(phi), r * np.sin(phi), 0 * r], axis=-1).reshape(-1, 3)
    normals = np.tile([0.0, 0.0, -np.pi * radius**2 / cells**2], (len(points), 1))
    return moved_surface(points, normals, matrix)


def sphere_surface(matrix, radius=0.5, cells=400):
    z, phi = np.meshgrid(
        (np.arange(cells) + 0.5) / cells * 2 - 1, 2 * np.pi * (np.arange(cells) + 0.5) / cells
    )
    rho = np.sqrt(1 - z * z)
    normals = np.stack([rho * np.cos(phi), rho * np.sin(phi), z], axis=-1).reshape(-1, 3)
    return moved_surface(radius * normals, normals * 4 * np.pi * radius**2 / cells**2, matrix)


def cylinder_surface(matrix, radius=0.5, length=1.0, cells=400):
    x, phi = np.meshgrid(
        (np.arange(cells) + 0.5) / cells - 0.5, 2 * np.pi * (np.arange(cells) + 0.5) / cells
    )
    normals = np.stack([0 * x, np.cos(phi), np.sin(phi)], axis=-1).reshape(-1, 3)
    points = radius * normals
    points[:, 0] = length * x.ravel()
    return moved_surface(points, normals * 2 * np.pi * radius * length / cells**2, matrix)


def moved_surface(points, normals, matrix):
    """Transform points and normals times areas by a matrix for row vectors."""
    linear, offset = np.asarray(matrix)[:3, :3], np.asarray(matrix)[3, :3]
    cofactors = np.linalg.inv(linear).T * abs(np.linalg.det(linear))
    return points @ linear + offset, normals @ cofactors


def area(surface):
    """Return the area of a surface."""
    return np.linalg.norm(surface[1], axis=1).sum()


def seen(surface, at=(0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0)):
    """Return the irradiance that a surface of radiance 1 gives."""
    to_light = surface[0] - np.array(at, dtype=float)
    squares = (to_light**2).sum(axis=1)
    here = np.maximum(to_light @ (np.array(up, dtype=float) / np.linalg.norm(up)), 0.0)
    there = np.maximum(-(to_light * surface[1]).sum(axis=1), 0.0)
    return (here * there / squares**2).sum()


SURFACES = {
    "SphereLight": sphere_surface,
    "RectLight": rect_surface,
    "DiskLight": disk_surface,
    "CylinderLight": cylinder_surface,
}
"""By the type of light, with the schema's fallbacks for all lengths."""
