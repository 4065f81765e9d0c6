"""Small scenes with many lights, one per kind of light and material, for comparisons of means.

Each scene is a floor with a ball and a block on it, seen from low above the floor by a film of
24 x 16 pixels; the lights hang above the picture. They keep a distance from the surfaces, so that
the noise has no heavy tail and means over a few dozen renderings are close to normal.

`SCENES` maps a name to a function without arguments that returns a dictionary for `mi.load_dict`
(without an integrator). `REFERENCE_SCENES` has a second dictionary of equal expectation for the
lights that Mitsuba itself cannot sample.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

WIDTH, HEIGHT = 24, 16
EXTENT = 2.5
"""Half the side of the floor."""
TINTS = np.array([[1.0, 0.8, 0.6], [0.6, 0.8, 1.0], [0.9, 0.9, 0.9], [1.0, 0.5, 0.5]])


def transform():
    """The identity, to chain transformations of the current variant."""
    return mi.ScalarTransform4f()


def rgb(values):
    """A colour as a dictionary."""
    return {"type": "rgb", "value": [float(value) for value in values]}


def rotation(vectors, axis, degrees):
    """The vectors rotated about x (0) or y (1)."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = [[1, 0, 0], [0, c, -s], [0, s, c]] if axis == 0 else [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    return vectors @ np.array(matrix).T


def sensor():
    """Camera low above the floor; the horizon is near the upper border of the film."""
    return {
        "type": "perspective",
        "fov": 45,
        "to_world": transform().look_at([0, -4, 1.2], [0, 0, 0.2], [0, 0, 1]),
        "film": {
            "type": "hdrfilm",
            "width": WIDTH,
            "height": HEIGHT,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        },
        "sampler": {"type": "manylights_sobol"},
    }


def diffuse(*values):
    """A diffuse material."""
    return {"type": "diffuse", "reflectance": rgb(values or (0.5, 0.5, 0.5))}


def stage(floor=None, ball=None, block=True):
    """The scene without lights; the materials of the floor and of the ball may be given."""
    scene = {
        "type": "scene",
        "sensor": sensor(),
        "floor": {
            "type": "rectangle",
            "to_world": transform().scale(EXTENT),
            "material": floor or diffuse(0.6, 0.5, 0.4),
        },
        "ball": {
            "type": "sphere",
            "center": [-0.6, -0.2, 0.45],
            "radius": 0.45,
            "material": ball or diffuse(0.3, 0.6, 0.6),
        },
    }
    if block:
        scene["block"] = {
            "type": "cube",
            "to_world": transform().translate([0.9, 0.4, 0.3]).rotate([0, 0, 1], 30).scale(0.3),
            "material": {"type": "twosided", "material": diffuse(0.5, 0.5, 0.7)},
        }
    return scene


def positions(count, generator, below=False):
    """Random positions above the picture, or below the floor."""
    x = generator.uniform(-2, 2, (count, 2))
    height = generator.uniform(1.6, 2.6, (count, 1))
    return np.concatenate([x, -0.6 * height if below else height], axis=1)


def powers(count, generator, decades=1.5):
    """Log-uniform brightness with a mean of about 1."""
    values = 10 ** generator.uniform(-decades, 0, count)
    return values / values.mean()


def colours(count, generator, total):
    """Tinted colours of random brightness that sum to about `total`."""
    tints = TINTS[generator.integers(len(TINTS), size=count)]
    return total / count * powers(count, generator)[:, np.newaxis] * tints


def points(count=200, seed=1, total=12.0, below=False):
    """Point lights."""
    generator = np.random.default_rng(seed)
    spots = zip(positions(count, generator, below), colours(count, generator, total))
    return {
        f"point_{index}": {"type": "point", "position": position.tolist(), "intensity": rgb(colour)}
        for index, (position, colour) in enumerate(spots)
    }


def spots(count=60, seed=2, total=40.0, texture=None):
    """Spot lights of various angles that point down, more or less."""
    generator = np.random.default_rng(seed)
    lights = {}
    spots = zip(positions(count, generator), colours(count, generator, total))
    for index, (position, colour) in enumerate(spots):
        target = [*generator.uniform(-1.5, 1.5, 2), 0]
        cutoff = generator.uniform(15, 60)
        lights[f"spot_{index}"] = {
            "type": "spot",
            "to_world": transform().look_at(position.tolist(), target, [0.1, 1, 0.2]),
            "intensity": rgb(colour),
            "cutoff_angle": float(cutoff),
            "beam_width": float(cutoff * generator.uniform(0.3, 0.95)),
        }
        if texture and index % 2:
            lights[f"spot_{index}"]["texture"] = {**texture}
    return lights


def frames(count, generator, tilt=60):
    """Transformations that put a shape above the picture, its normal roughly downwards."""
    for position in positions(count, generator):
        turn = generator.uniform(-tilt, tilt, 2)
        yield (
            transform()
            .translate(position.tolist())
            .rotate([1, 0, 0], 180 + float(turn[0]))
            .rotate([0, 1, 0], float(turn[1]))
        )


def area(radiance):
    """An area emitter."""
    return {"type": "area", "radiance": radiance}


def shapes(kind, count=16, seed=3, total=40.0, size=0.15, tilt=60, radiance=None):
    """Area lights on rectangles, disks, cylinders or spheres of random size."""
    generator = np.random.default_rng(seed)
    lights = {}
    values = zip(frames(count, generator, tilt), colours(count, generator, total / size**2))
    for index, (frame, colour) in enumerate(values):
        scale = [float(x) for x in size * generator.uniform(0.4, 1.2, 3)]
        if kind == "sphere":
            scale = [scale[0]] * 3
        elif kind == "cylinder":
            scale = [scale[0], scale[0], 2 * scale[2]]
        lights[f"{kind}_{index}"] = {
            "type": kind,
            "to_world": frame.scale(scale),
            "emitter": area(radiance or rgb(colour)),
        }
    return lights


def triangles(count=100, seed=4, size=0.35):
    """Vertices (count, 3, 3) of small triangles that face in random, mostly downward directions."""
    generator = np.random.default_rng(seed)
    corners = np.array([[1, 0, 0], [-0.5, -0.9, 0], [-0.5, 0.9, 0]])
    result = []
    for position in positions(count, generator):
        corner = corners * size * generator.uniform(0.3, 1.0)
        corner = rotation(rotation(corner, 0, generator.uniform(-70, 70)), 1, 0)
        corner = rotation(corner, 1, generator.uniform(-70, 70))
        result.append(corner + position)
    return np.array(result)


def triangle_colours(count=100, seed=5, total=150.0):
    """Radiance of each triangle."""
    return colours(count, np.random.default_rng(seed), total)


def make_mesh(
    vertices, radiance, face_colours=None, vertex_normals=None, name="lamps", material=None
):
    """A mesh of separate triangles (count, 3, 3) with an area emitter, unless `radiance` is None.

    The material is a dictionary, or that of Mitsuba's default.
    """
    properties = mi.Properties()
    if material is not None:
        properties["mesh_bsdf"] = mi.load_dict(material)
    if radiance is not None:
        properties["mesh_emitter"] = mi.load_dict(area(radiance))
    count = len(vertices)
    mesh = mi.Mesh(
        name, 3 * count, count, has_vertex_normals=vertex_normals is not None, props=properties
    )
    if face_colours is not None:
        mesh.add_attribute("face_color", 3, np.ravel(face_colours).astype(np.float32))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ravel(vertices).astype(np.float32)
    parameters["faces"] = np.arange(3 * count, dtype=np.uint32)
    if vertex_normals is not None:
        parameters["vertex_normals"] = np.ravel(vertex_normals).astype(np.float32)
    parameters.update()
    return mesh


def mesh_constant():
    """100 triangles of equal radiance in one mesh."""
    return {**stage(), "lamps": make_mesh(triangles(), rgb([2, 1.5, 1]))}


def mesh_face_colours():
    """100 triangles in one mesh, each with a radiance of its own."""
    radiance = {"type": "mesh_attribute", "name": "face_color"}
    return {**stage(), "lamps": make_mesh(triangles(), radiance, triangle_colours())}


def mesh_face_colours_separate():
    """The same light from 100 meshes of one triangle with constant radiance."""
    lights = {
        f"lamp_{index}": make_mesh(corners[np.newaxis], rgb(colour), name=f"lamp_{index}")
        for index, (corners, colour) in enumerate(zip(triangles(), triangle_colours()))
    }
    return {**stage(), **lights}


def octahedron(center, radius):
    """Triangles (8, 3, 3) and their smooth vertex normals."""
    axes = np.eye(3)
    faces = []
    for signs in np.ndindex(2, 2, 2):
        signs = 1 - 2 * np.array(signs)
        corners = axes * signs[:, np.newaxis]
        faces.append(corners if signs.prod() > 0 else corners[::-1])
    normals = np.array(faces, dtype=float)
    return center + radius * normals, normals


def mesh_smooth():
    """Octahedra whose vertex normals are those of spheres."""
    lights = {}
    generator = np.random.default_rng(6)
    for index, position in enumerate(positions(8, generator)):
        vertices, normals = octahedron(position, 0.3)
        mesh = make_mesh(vertices, rgb(TINTS[index % 4] * 4), None, normals, f"lamp_{index}")
        lights[f"lamp_{index}"] = mesh
    return {**stage(), **lights}


def stripes(scale):
    """A bitmap with strong contrast and dark borders."""
    y, x = np.mgrid[0:8, 0:8]
    value = scale * (0.05 + 3.0 * ((x * 3 + y) % 5 == 0) * (x + 1) / 8)
    image = np.stack([value, value[::-1], 0.3 * scale + 0 * value], axis=-1).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(image)}


def textured():
    """Area lights with a bitmap, on rectangles and disks, among point lights."""
    lights = shapes("rectangle", 6, seed=7, size=0.5, radiance=stripes(12.0))
    lights |= shapes("disk", 3, seed=8, size=0.4, radiance=stripes(12.0))
    return {**stage(), **lights, **points(12, total=3.0)}


def projectors():
    """Projectors and spots with a texture, among point lights."""
    lights = {}
    for index, x in enumerate((-1.0, 0.2, 1.1)):
        lights[f"projector_{index}"] = {
            "type": "projector",
            "irradiance": stripes(2.0),
            "fov": 40 + 10 * index,
            "to_world": transform().look_at([x, -1, 2.2], [0.5 * x, 0, 0], [0, 1, 0]),
        }
    return {**stage(), **lights, **spots(6, texture=stripes(1.0)), **points(12, total=4.0)}


def sky():
    """A constant environment, two directional lights and point lights."""
    lights = {
        "sky": {"type": "constant", "radiance": rgb([0.1, 0.15, 0.2])},
        "sun": {
            "type": "directional",
            "direction": [0.5, 0.4, -1],
            "irradiance": rgb([1, 0.9, 0.7]),
        },
        "moon": {"type": "directional", "direction": [-1, 0.4, -1], "irradiance": rgb([0.1] * 3)},
    }
    return {**stage(), **lights, **points(40, total=4.0)}


def mirrored():
    """Rectangles, cubes and disks under mirroring transformations, some with flipped normals."""
    lights = {}
    for kind, flip in (("rectangle", False), ("rectangle", True), ("cube", False), ("disk", True)):
        for key, light in shapes(kind, 6, seed=len(lights)).items():
            # Twice flipped is not flipped: all of them still face the floor
            scale = [1, 1, -1] if flip else [-1, 1, 1]
            light["to_world"] = light["to_world"].scale(scale)
            light["flip_normals"] = flip
            lights[f"{key}_{flip}"] = light
    return {**stage(), **lights}


def many_suns():
    """More directional lights than take part one by one, an environment and point lights."""
    generator = np.random.default_rng(11)
    lights = {"sky": {"type": "constant", "radiance": rgb([0.1, 0.15, 0.2])}}
    for index, colour in enumerate(colours(20, generator, 1.0)):
        x, y = generator.uniform(-1, 1, 2)
        lights[f"sun_{index}"] = {
            "type": "directional",
            "direction": [float(x), float(y), -1],
            "irradiance": rgb(colour),
        }
    return {**stage(), **lights, **points(40, total=4.0)}


def hard_spots():
    """Spots without a transition, and with a beam that is wider than the cone."""
    lights = spots(20, seed=12)
    for index, light in enumerate(lights.values()):
        light["beam_width"] = light["cutoff_angle"] * (1 if index % 2 else 1.5)
    return {**stage(), **lights}


def environment_map():
    """An environment map, a beam, point lights and rectangles."""
    y, x = np.mgrid[0:8, 0:16]
    value = 0.05 + 0.6 * np.exp(-((x - 4) ** 2) / 4 - (y - 2) ** 2)
    image = np.stack([value, value, 0.2 + 0.5 * value], axis=-1).astype(np.float32)
    lights = {
        "sky": {
            "type": "envmap",
            "bitmap": mi.Bitmap(image),
            "to_world": transform().rotate([1, 0, 0], 90),
        },
    }
    return {**stage(), **lights, **points(20, total=3.0), **shapes("rectangle", 8, total=10.0)}


def mixed_lights():
    """Lights of every kind that has a position, and some that have none."""
    lights = points(12, total=2.0) | spots(8, total=6.0)
    for index, kind in enumerate(("rectangle", "sphere", "disk", "cylinder")):
        lights |= shapes(kind, 4, seed=20 + index, total=6.0)
    lights["lamps"] = make_mesh(triangles(20), rgb([1.0, 1.2, 1.4]))
    lights["sky"] = {"type": "constant", "radiance": rgb([0.02, 0.03, 0.05])}
    lights["sun"] = {
        "type": "directional",
        "direction": [0.3, 0.6, -1],
        "irradiance": rgb([0.2, 0.2, 0.1]),
    }
    return lights


def mixed():
    """Lights of every kind."""
    return {**stage(), **mixed_lights()}


def visible_lights():
    """Lights inside the picture, for the emitters that the camera sees."""
    lights = points(10, total=5.0)
    for index, x in enumerate((-1.2, 0.3, 1.4)):
        lights[f"lamp_{index}"] = {
            "type": "sphere",
            "center": [x, 1.0, 0.5],
            "radius": 0.15,
            "emitter": area(rgb(TINTS[index])),
        }
    return {**stage(), **lights}


def lights_above_and_below():
    """Points and larger area lights, on both sides of the floor."""
    lights = points(30, total=8.0) | shapes("rectangle", 8, total=40.0, size=0.4)
    below = points(10, seed=9, total=6.0, below=True)
    lights |= {f"below_{name}": light for name, light in below.items()}
    generator = np.random.default_rng(10)
    for index, position in enumerate(positions(6, generator, below=True)):
        lights[f"under_{index}"] = {
            "type": "rectangle",
            "to_world": transform().translate(position.tolist()).scale(0.4),
            "emitter": area(rgb(TINTS[index % 4] * 3)),
        }
    return lights


def with_material(material):
    """Floor and ball of one material, lights above and below."""
    return {**stage(material, material), **lights_above_and_below()}


def with_mirror(material):
    """Materials with ideal reflection or refraction: large lights, which BSDF samples find."""
    lights = points(5, total=2.0)
    generator = np.random.default_rng(11)
    for index, position in enumerate(positions(12, generator)):
        position[1] = 2.6 + 0.5 * index
        lights[f"wall_{index}"] = {
            "type": ("rectangle", "sphere", "disk")[index % 3],
            "to_world": transform().translate(position.tolist()).rotate([1, 0, 0], 110).scale(0.6),
            "emitter": area(rgb(TINTS[index % 4])),
        }
    for index, position in enumerate(positions(8, generator, below=True)):
        lights[f"under_{index}"] = {
            "type": "rectangle",
            "to_world": transform().translate(position.tolist()).scale(0.7),
            "emitter": area(rgb(TINTS[index % 4])),
        }
    return {**stage(material, material), **lights}


MATERIALS = {
    "twosided": lambda: {"type": "twosided", "material": diffuse(0.4, 0.5, 0.6)},
    "roughconductor": lambda: {"type": "roughconductor", "alpha": 0.35, "material": "Cu"},
    "roughplastic": lambda: {
        "type": "roughplastic",
        "alpha": 0.2,
        "diffuse_reflectance": rgb([0.4, 0.3, 0.2]),
    },
    "principled": lambda: {
        "type": "principled",
        "base_color": rgb([0.6, 0.4, 0.2]),
        "metallic": 0.3,
        "roughness": 0.4,
        "specular": 0.6,
        "clearcoat": 0.4,
        "clearcoat_gloss": 0.3,
    },
    "principled-transmission": lambda: {
        "type": "principled",
        "base_color": rgb([0.8, 0.7, 0.6]),
        "spec_trans": 0.6,
        "roughness": 0.5,
    },
    "principledthin": lambda: {
        "type": "principledthin",
        "base_color": rgb([0.8, 0.7, 0.6]),
        "spec_trans": 0.3,
        "diff_trans": 0.8,
        "roughness": 0.5,
    },
    "roughdielectric": lambda: {"type": "roughdielectric", "alpha": 0.5},
    "blend": lambda: {
        "type": "blendbsdf",
        "weight": 0.5,
        "first": diffuse(0.3, 0.6, 0.3),
        "second": {"type": "roughdielectric", "alpha": 0.5},
    },
}

MIRRORS = {
    "dielectric": lambda: {"type": "dielectric"},
    "thindielectric": lambda: {"type": "thindielectric"},
    "conductor": lambda: {"type": "conductor", "material": "Ag"},
    "plastic": lambda: {"type": "plastic", "diffuse_reflectance": rgb([0.4, 0.3, 0.2])},
    "mask": lambda: {"type": "mask", "opacity": 0.6, "material": diffuse(0.5, 0.4, 0.6)},
    "null": lambda: {"type": "null"},
}

POINT_COUNTS = (1, 2, 15, 16, 17)
"""Numbers of lights around the default number of reservoirs, and the smallest ones."""

SCENES = {
    "points": lambda: {**stage(), **points()},
    "spots": lambda: {**stage(), **spots()},
    "rectangles": lambda: {**stage(), **shapes("rectangle", 30)},
    "spheres": lambda: {**stage(), **shapes("sphere")},
    "disks": lambda: {**stage(), **shapes("disk")},
    "cylinders": lambda: {**stage(), **shapes("cylinder")},
    "mesh-constant": mesh_constant,
    "mesh-face-colours": mesh_face_colours,
    "mesh-smooth": mesh_smooth,
    "textured": textured,
    "projectors": projectors,
    "sky": sky,
    "environment-map": environment_map,
    "mirrored": mirrored,
    "many-suns": many_suns,
    "hard-spots": hard_spots,
    "mixed": mixed,
    "visible-lights": visible_lights,
}
for count in POINT_COUNTS:
    SCENES[f"points-{count}"] = lambda count=count: {**stage(), **points(count)}
for name, make in MATERIALS.items():
    SCENES[f"material-{name}"] = lambda make=make: with_material(make())
for name, make in MIRRORS.items():
    SCENES[f"material-{name}"] = lambda make=make: with_mirror(make())

REFERENCE_SCENES = {"mesh-face-colours": mesh_face_colours_separate}


def load(name):
    """Load the scene `name` in the current variant."""
    return mi.load_dict(SCENES[name]())


def load_reference(name):
    """Load the scene that the references of `name` are rendered from."""
    return mi.load_dict(REFERENCE_SCENES.get(name, SCENES[name])())
