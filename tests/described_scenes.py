"""Makes Mitsuba's scenes of the descriptions that `scene_strategies` draws, in any variant."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np

from tests.light_scenes import rgb, transform

SIDE = 8
"""Pixels along the side of a film of any scene."""

PATCH_PIXELS = 4
PATCH_HEIGHT = 0.5
PATCH_FOV = 8.0
PATCH_NEAR = 1e-3
"""Film of a lit patch; its camera looks down from that height, with that angle of view."""


PLACES = {
    "everywhere": ([0.0, 0.0, 1.0], [9.0, 9.0, 9.0]),
    "camera": ([0.0, -4.0, 1.0], [1.0, 1.0, 1.0]),
    "floor": ([0.0, 0.0, 0.0], [3.0, 3.0, 0.6]),
    "lights": ([0.0, 0.0, 2.0], [2.5, 2.5, 1.2]),
    "beside": ([1.0, 0.5, 0.6], [0.5, 0.5, 0.5]),
}
"""Middle and half size of the box of fog in any scene. The camera is at (0, -4, 1)."""


def matrix_of(steps):
    """Steps of a transformation as one of the current variant; the last one is applied first."""
    result = transform()
    for name, *values in steps:
        if name == "shear":
            matrix = np.eye(4)
            matrix[[0, 0, 1], [1, 2, 2]] = values[0]
            result = result @ mi.ScalarTransform4f(matrix)
        elif name == "rotate":
            # Mitsuba takes the axis as it is, and a longer one stretches
            axis = np.array(values[0]) / np.linalg.norm(values[0])
            result = result.rotate(axis.tolist(), values[1])
        else:
            result = getattr(result, name)(values[0])
    return result


def uv_matrix_of(steps):
    """The same for texture coordinates."""
    result = mi.ScalarTransform3f()
    for name, value in steps:
        result = getattr(result, name)(value)
    return result


def texels(texture):
    """Pixels (height, width, 3) of a bitmap, in single precision."""
    generator = np.random.default_rng(texture["seed"])
    width, height = texture["size"]
    pixels = generator.uniform(0.05, 1, (height, width, 3)) ** 2
    if texture["kind"] == "plain":
        pixels[:] = pixels[0, 0]
    return (texture["scale"] * pixels).astype(np.float32)


def mesh_arrays(light):
    """Corners (n, 3, 3), texture coordinates (n, 3, 2), normals (n, 3, 3) and colours (n, 3, 3).

    All are in object space and drawn for each corner; `face_color` has those of the first corner.
    Triangles keep apart: shadow rays end 0.1 % before their light, and see through what is there.
    """
    generator = np.random.default_rng(light["seed"])
    count = light["triangles"]
    corners = generator.uniform(-1, 1, (count, 3, 3))
    layer = np.arange(count)[:, np.newaxis]
    corners[..., 2] = (2 * layer + 1 + 0.7 * corners[..., 2]) / count - 1
    uv = generator.uniform(-1, 2, (len(corners), 3, 2))
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.linalg.norm(flat, axis=-1, keepdims=True)
    normals = flat[:, np.newaxis] + generator.uniform(-0.5, 0.5, corners.shape)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    colours = generator.uniform(0, 1, corners.shape)
    return corners, uv, normals, colours


def regular(middle, width, scale):
    """A triangle of that width at the bottom, sampled every nanometre."""
    wavelengths = np.arange(360, 831)
    values = scale * np.maximum(0, 1 - np.abs(wavelengths - middle) / (0.5 * width + 1))
    text = ", ".join(f"{value:.6g}" for value in values)
    return {"type": "regular", "wavelength_min": 360.0, "wavelength_max": 830.0, "values": text}


def radiance_dict(value):
    """A radiance, or a texture, as a dictionary."""
    kind = value["kind"]
    if kind == "rgb":
        return rgb(value["value"])
    if kind == "uniform":
        return {"type": "uniform", "value": value["value"]}
    if kind in ("bitmap", "plain"):
        return {
            "type": "bitmap",
            "bitmap": mi.Bitmap(texels(value)),
            "raw": not mi.is_spectral,
            "wrap_mode": value["wrap"],
            "filter_type": value["filter"],
            "to_uv": uv_matrix_of(value["to_uv"]),
        }
    if kind == "checkerboard":
        colours = {f"color{index}": field(c) for index, c in enumerate(value["colours"])}
        return {"type": "checkerboard", **colours, "to_uv": uv_matrix_of(value["to_uv"])}
    if kind in ("vertex_color", "face_color"):
        return {"type": "mesh_attribute", "name": kind, "scale": value["scale"]}
    if kind == "blackbody":
        return {"type": kind, "temperature": value["temperature"]}
    middle, width, scale = value["middle"], value["width"], value["scale"]
    if kind == "regular":
        return regular(middle, width, scale)
    ends = f"360, {middle - width / 2}, {middle}, {middle + width / 2}, 830"
    return {"type": "irregular", "wavelengths": ends, "values": f"0, 0, {scale}, 0, 0"}


def field(colour):
    """A colour of a checkerboard, which takes plain ones up to 1 only."""
    if max(colour) <= 1:
        return rgb(colour)
    pixel = np.array(colour, np.float32).reshape(1, 1, 3)
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixel), "raw": not mi.is_spectral}


# --------------------------------------------------------------------------------------- lights


def mesh_object(light, name, material=None):
    """A mesh with its attributes and its emitter."""
    properties = mi.Properties()
    properties["mesh_emitter"] = mi.load_dict(area(light))
    if material:
        properties["mesh_bsdf"] = mi.load_dict(material)
    corners, uv, normals, colours = mesh_arrays(light)
    matrix = np.array(matrix_of(light["steps"]).matrix, float)
    corners = corners @ matrix[:3, :3].T + matrix[:3, 3]
    normals = normals @ np.linalg.inv(matrix[:3, :3])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    if light["flip"]:
        corners, uv, normals, colours = (a[:, ::-1] for a in (corners, uv, -normals, colours))
    count = len(corners)
    mesh = mi.Mesh(
        name,
        3 * count,
        count,
        props=properties,
        has_vertex_normals=light["normals"],
        has_vertex_texcoords=light["uv"],
    )
    kind = light["radiance"]["kind"]
    if kind == "vertex_color":
        mesh.add_attribute(kind, 3, np.ravel(colours).astype(np.float32))
    elif kind == "face_color":
        first = colours[:, -1 if light["flip"] else 0]
        mesh.add_attribute(kind, 3, np.ravel(first).astype(np.float32))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ravel(corners).astype(np.float32)
    parameters["faces"] = np.arange(3 * count, dtype=np.uint32)
    if light["normals"]:
        parameters["vertex_normals"] = np.ravel(normals).astype(np.float32)
    if light["uv"]:
        parameters["vertex_texcoords"] = np.ravel(uv).astype(np.float32)
    parameters.update()
    return mesh


def area(light):
    """The emitter of a shape."""
    return {"type": "area", "radiance": radiance_dict(light["radiance"])}


@functools.cache
def curve_folder():
    """A folder for files of curves, which is deleted when the process ends."""
    return tempfile.TemporaryDirectory()


def curve_file(light):
    """A file with a short curve: Mitsuba takes them from files only."""
    points = np.random.default_rng(light["seed"]).uniform(-0.5, 0.5, (6, 3))
    text = "".join(f"{x:.4f} {y:.4f} {z:.4f} 0.05\n" for x, y, z in points)
    path = Path(curve_folder().name) / f"{light['seed']}.txt"
    path.write_text(text)
    return str(path)


def light_object(light, name):
    """A light as a dictionary, or as an object where it is a mesh."""
    kind = light["kind"]
    colour = radiance_dict(light["radiance"]) if "radiance" in light else rgb(light["value"])
    if kind == "point":
        return {"type": kind, "position": light["position"], "intensity": colour}
    if kind == "directional":
        return {"type": kind, "direction": light["direction"], "irradiance": colour}
    to_world = matrix_of(light["steps"])
    if kind in ("spot", "projector"):
        result = {"type": kind, "to_world": to_world}
        image = light["texture"] and radiance_dict(light["texture"])
        if kind == "projector":
            return result | {"irradiance": image or colour, "fov": light["cutoff"]}
        result |= {"intensity": colour, "cutoff_angle": light["cutoff"]}
        result |= {"beam_width": light["beam"]}
        return result | ({"texture": image} if image else {})
    material = lamp_surface(light.get("surface", "none"))
    if kind == "mesh":
        return mesh_object(light, name, material)
    result = {"type": kind, "to_world": to_world, "emitter": area(light)}
    if kind in ("linearcurve", "bsplinecurve"):
        result["filename"] = curve_file(light)
    else:
        result["flip_normals"] = light["flip"]
    return result | ({"bsdf": material} if material else {})


def lamp_surface(name):
    """The material of a lamp."""
    return None if name == "none" else material_dict(name)


def diffuse():
    """A diffuse material."""
    return {"type": "diffuse", "reflectance": rgb([0.6, 0.5, 0.4])}


def material_dict(name):
    """A material by its name."""
    bumps = np.random.default_rng(0).uniform(0.3, 0.7, (4, 4, 3)).astype(np.float32)
    bumps[..., 2] = 1
    return {
        "diffuse": diffuse,
        "roughconductor": lambda: {"type": "roughconductor", "alpha": 0.4, "material": "Cu"},
        "roughdielectric": lambda: {"type": "roughdielectric", "alpha": 0.4},
        "dielectric": lambda: {"type": "dielectric"},
        "principled": lambda: {
            "type": "principled",
            "base_color": rgb([0.7, 0.5, 0.3]),
            "roughness": 0.3,
            "spec_trans": 0.4,
        },
        "plastic": lambda: {"type": "plastic", "diffuse_reflectance": rgb([0.4, 0.3, 0.2])},
        "null": lambda: {"type": "null"},
        "mask": lambda: {"type": "mask", "opacity": 0.5, "nested": diffuse()},
        "twosided": lambda: {"type": "twosided", "nested": diffuse()},
        "normalmap": lambda: {
            "type": "normalmap",
            "normalmap": {"type": "bitmap", "bitmap": mi.Bitmap(bumps), "raw": True},
            "nested": diffuse(),
        },
    }[name]()


# ------------------------------------------------------------------------------------ lit patch


def film(width, height):
    """A film without a filter. In spectral variants XYZ, which is positive for any light."""
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": "box"},
        "pixel_format": "xyz" if mi.is_spectral else "rgb",
        "component_format": "float32",
    }


def fog_grid(values, low, high, name="sigma_t"):
    """Values (z, y, x, channels) in a box."""
    size = (np.array(high) - low).tolist()
    return {
        "type": "gridvolume",
        "grid": mi.VolumeGrid(values.astype(np.float32)),
        "to_world": transform().translate(np.array(low).tolist()).scale(size),
        "raw": values.shape[-1] == 1 or not mi.is_spectral,
    }


def coefficients(extinction):
    """Extinction in three channels, with a scale, since colours may be up to 1 here, too."""
    scale = max(extinction) or 1.0
    return {"sigma_t": rgb([value / scale for value in extinction]), "scale": scale}


def fog_bounds(fog):
    """Corners of the box that has fog in it: the smaller one of the shape and its grid."""
    center, half = np.array(fog["center"]), np.array(fog["half"])
    if fog["kind"] == "smaller":
        half = 0.6 * half
    return center - half, center + half


def patch_medium(fog):
    """The absorbing medium of a lit patch."""
    extinction = fog["extinction"]
    if fog["kind"] == "homogeneous":
        return {"type": "homogeneous", **coefficients(extinction), "albedo": 0.0}
    factor = {"smaller": 0.6, "equal": 1.0, "larger": 1.5}[fog["kind"]]
    center, half = np.array(fog["center"]), factor * np.array(fog["half"])
    grid = np.broadcast_to(extinction, (2, 2, 2, 3))
    sigma_t = fog_grid(grid, center - half, center + half)
    return {"type": "heterogeneous", "sigma_t": sigma_t, "albedo": 0.0}


def scaled(scene, unit):
    """The description of a lit patch in another unit of length, with the same image."""

    def steps(old):
        return [["scale", 3 * [unit]], *old]

    lights = []
    for light in scene["lights"]:
        light = dict(light)
        if "steps" in light:
            light["steps"] = steps(light["steps"])
        if "position" in light:
            light["position"] = [unit * value for value in light["position"]]
        if light["kind"] in ("point", "spot"):
            light["value"] = [unit**2 * value for value in light["value"]]
        lights.append(light)
    scene = scene | {"lights": lights, "unit": unit}
    if "fog" in scene:
        fog = dict(scene["fog"])
        fog["center"], fog["half"] = ([unit * v for v in fog[key]] for key in ("center", "half"))
        fog["extinction"] = [value / unit for value in fog["extinction"]]
        scene["fog"] = fog
    return scene


def patch_dict(unit, material):
    """The patch and the camera that looks down at it."""
    sensor = {
        "type": "perspective",
        "fov": PATCH_FOV,
        "near_clip": PATCH_NEAR * unit,
        "far_clip": 1e3 * unit,
        "to_world": transform().look_at([0, 0, PATCH_HEIGHT * unit], [0, 0, 0], [0, 1, 0]),
        "film": film(PATCH_PIXELS, PATCH_PIXELS),
    }
    patch = {"type": "rectangle", "to_world": transform().scale(0.05 * unit), "bsdf": material}
    return {"type": "scene", "sensor": sensor, "patch": patch}


def load_lamps(scene):
    """The scene of `wide_lamps`."""
    result = patch_dict(1.0, material_dict(scene["material"]))
    if scene["environment"]:
        result["environment"] = environment_dict(scene["environment"])
    for index, light in enumerate(scene["lights"]):
        result[f"light_{index}"] = light_object(light, f"light_{index}")
    return mi.load_dict(result)


def load_patch(scene):
    """The scene of a `lit_patch`."""
    unit = scene["unit"]
    scene = scaled(scene, unit)
    result = patch_dict(unit, {"type": "diffuse", "reflectance": rgb(scene["albedo"])})
    sensor, eye = result["sensor"], [0, 0, PATCH_HEIGHT * unit]
    if "fog" in scene:
        fog = scene["fog"]
        result["fog"] = {"id": "fog", **patch_medium(fog)}
        low, high = np.array(fog["center"]) - fog["half"], np.array(fog["center"]) + fog["half"]
        to_world = transform().translate(fog["center"]).scale(fog["half"])
        reference = {"type": "ref", "id": "fog"}
        border = {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}}
        result["border"] = border | {"interior": reference}
        if (low < eye).all() and (eye < high).all():
            sensor["medium"] = reference
    for index, light in enumerate(scene["lights"]):
        name = f"light_{index}"
        result[name] = light_object(brighter(light, scene["power"]), name)
    return mi.load_dict(result)


# ------------------------------------------------------------------------------------ any scene


def any_medium(medium):
    """The fog of any scene."""
    center, half = PLACES[medium["place"]]
    phase = {"type": "hg", "g": medium["g"]} if medium["g"] else {"type": "isotropic"}
    if medium["kind"] == "homogeneous":
        result = {"type": "homogeneous", **coefficients(medium["extinction"])}
        return result | {"albedo": rgb(medium["albedo"]), "phase": phase}
    generator = np.random.default_rng(medium["seed"])
    shape = (2, 3, 4, 3 if medium["spectral"] else 1)
    density = np.ones(shape) if medium["constant"] else generator.uniform(0, 1, shape)
    density = density * (medium["extinction"] if medium["spectral"] else medium["extinction"][1])
    half = np.array(half) * {"smaller": 0.5, "equal": 1.0, "larger": 2.0}[medium["kind"]]
    return {
        "type": "heterogeneous",
        "sigma_t": fog_grid(density, np.array(center) - half, np.array(center) + half),
        "albedo": rgb(medium["albedo"]),
        "phase": phase,
        "has_spectral_extinction": medium["spectral"],
    }


def camera_dict(camera):
    """The sensor of any scene."""
    result = {
        "type": camera["kind"],
        "to_world": transform().look_at([0, -4, 1], [0, 0, 0.4], [0, 0, 1]),
        "film": film(SIDE, SIDE),
        "sampler": {"type": camera["sampler"], "sample_count": camera["spp"]},
    }
    if camera["kind"] == "orthographic":
        result["to_world"] = result["to_world"].scale([2, 2, 1])
    else:
        result["fov"] = 45.0
    if camera["kind"] == "thinlens":
        result |= {"aperture_radius": 0.1, "focus_distance": 4.0}
    if camera["crop"]:
        result["film"] |= {"width": 2 * SIDE, "height": 3 * SIDE, "crop_offset_x": 3}
        result["film"] |= {"crop_offset_y": SIDE, "crop_width": SIDE, "crop_height": SIDE}
    return result


def environment_dict(environment):
    """The environment of any scene."""
    kind = environment["kind"]
    if kind == "constant":
        emitted = environment["radiance"]
        return {"type": kind, "radiance": radiance_dict(emitted) if emitted else 0.1}
    if kind == "envmap":
        pixels = np.random.default_rng(environment["seed"]).uniform(0, 0.3, (5, 9, 3))
        bitmap = mi.Bitmap(pixels.astype(np.float32))
        return {"type": kind, "bitmap": bitmap, "to_world": matrix_of(environment["steps"])}
    up = transform().rotate([1, 0, 0], 90)
    return {"type": kind, "hour": environment["hour"], "sun_scale": 0.01, "to_world": up}


def instances(material):
    """A ball and a block in a group, and two of that group."""
    group = {
        "type": "shapegroup",
        "ball": {"type": "sphere", "radius": 0.2, "bsdf": material_dict(material)},
        "block": {
            "type": "cube",
            "to_world": transform().translate([0, 0, 0.4]).scale(0.15),
            "bsdf": material_dict(material),
        },
    }
    result = {"group": group}
    for index, x in enumerate((-1.0, 0.4)):
        frame = transform().translate([x, 0.5, 0.3]).rotate([0, 1, 0], 40 * x).scale([1, 2, 1])
        reference = {"type": "ref", "id": "group"}
        result[f"instance_{index}"] = {"type": "instance", "to_world": frame, "group": reference}
    return result


def brighter(light, power):
    """The light with its power times a number."""
    if power == 1:
        return light
    light = dict(light)
    if "value" in light:
        light["value"] = [power * value for value in light["value"]]
    else:
        emitted = dict(light["radiance"])
        if "colours" in emitted:
            emitted["colours"] = [[power * c for c in colour] for colour in emitted["colours"]]
        elif "scale" in emitted:
            emitted["scale"] *= power
        elif emitted["kind"] == "rgb":
            emitted["value"] = [power * value for value in emitted["value"]]
        elif emitted["kind"] == "uniform":
            emitted["value"] *= power
        light["radiance"] = emitted
    return light


def any_scene_dict(scene):
    """The dictionary of any scene, without its integrator."""
    sensor = camera_dict(scene["camera"])
    floor = {"type": "rectangle", "to_world": transform().scale(2.5)}
    ball = {"type": "sphere", "center": [-0.6, -0.2, 0.45], "radius": 0.4}
    result = {
        "type": "scene",
        "sensor": sensor,
        "floor": floor | {"bsdf": material_dict(scene["floor"])},
        "ball": ball | {"bsdf": material_dict(scene["ball"])},
    }
    if scene["instances"]:
        result |= instances(scene["instances"])
    if scene["environment"]:
        result["environment"] = environment_dict(scene["environment"])
    medium = scene["medium"]
    if medium:
        center, half = PLACES[medium["place"]]
        result["fog"] = {"id": "fog", **any_medium(medium)}
        reference = {"type": "ref", "id": "fog"}
        to_world = transform().translate(center)
        to_world = to_world.scale(half if medium["border"] == "cube" else max(half))
        border = {"type": medium["border"], "to_world": to_world, "bsdf": {"type": "null"}}
        result["border"] = border | {"interior": reference}
        if medium["place"] in ("everywhere", "camera"):
            sensor["medium"] = reference
    for index, light in enumerate(scene["lights"]):
        name = f"light_{index}"
        result[name] = light_object(brighter(light, scene["power"]), name)
    return result


def load_any(scene):
    """Load a description of any scene; returns the scene and its integrator."""
    integrator = mi.load_dict(scene["integrator"])
    return mi.load_dict(any_scene_dict(scene)), integrator
