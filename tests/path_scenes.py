"""Small scenes for comparisons of path tracers: materials, chains of mirrors, fog and smoke.

They are built like those of `light_scenes`: the same stage, camera and lights. `SURFACES` have no
media, their reference is Mitsuba's `path`; `FOGS` have media, theirs is `volpath`. Each of them
maps a name to a function without arguments that returns a dictionary for `mi.load_dict`.

Point lights keep a distance from fog wherever paths may scatter next to them: their 1/d^2 has no
variance in a medium, and a t test of such means would say nothing. Where points are in fog, the
camera does not see their surroundings, and the tests of these scenes scatter only once
(`SINGLE_SCATTERING`).
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from tests.light_scenes import (
    MATERIALS,
    MIRRORS,
    area,
    colours,
    diffuse,
    make_mesh,
    points,
    rgb,
    shapes,
    spots,
    stage,
    stripes,
    transform,
    triangles,
    with_material,
    with_mirror,
)

TOP = 1.3
"""Height of fog that is below all lights."""
TALL = 2.9
"""Height of fog that contains all lights."""

# --------------------------------------------------------------------------------------- surfaces


def pane(material, position, size=(0.4, 0.4), degrees=90, axis=(1, 0, 0)):
    """A rectangle, by default an upright one that faces the camera."""
    frame = transform().translate(list(position)).rotate(list(axis), degrees)
    return {
        "type": "rectangle",
        "to_world": frame.scale([size[0], size[1], 1]),
        "material": material,
    }


def ball(material, position, radius):
    """A sphere."""
    return {"type": "sphere", "center": list(position), "radius": radius, "material": material}


def things():
    """A glass ball, rough glass, a mask, thin glass and a mirror, to stand on the stage."""
    mask = {"type": "twosided", "material": diffuse(0.5, 0.4, 0.6)}
    return {
        "glass": ball({"type": "dielectric"}, (0.35, -1.1, 0.35), 0.3),
        "frosted": ball({"type": "roughdielectric", "alpha": 0.4}, (1.3, -0.6, 0.35), 0.35),
        "net": pane({"type": "mask", "opacity": 0.6, "material": mask}, (-1.5, -0.7, 0.5)),
        "window": pane({"type": "thindielectric"}, (-0.4, -1.4, 0.4), (0.3, 0.3)),
        "mirror": pane({"type": "conductor", "material": "Ag"}, (0.2, 1.6, 0.6), (1.2, 0.6), 80),
    }


def rough_metal():
    """A glossy material."""
    return {"type": "roughconductor", "alpha": 0.3, "material": "Cu"}


def gallery_stage():
    """The stage with every kind of material on it."""
    return {**stage(None, rough_metal()), **things()}


def gallery():
    """All materials under points, spots and a mesh of triangles."""
    lamps = make_mesh(triangles(60), rgb([2, 1.5, 1]))
    return {**gallery_stage(), **points(80, total=6.0), **spots(20, total=12.0), "lamps": lamps}


def sky():
    """An environment map without small bright spots, which glass would focus."""
    y, x = np.mgrid[0:8, 0:16]
    value = 0.2 + 0.2 * np.cos(np.pi * x / 8) * np.sin(np.pi * (y + 0.5) / 8)
    image = np.stack([value, value[::-1], 0.3 + 0 * value], axis=-1).astype(np.float32)
    frame = transform().rotate([1, 0, 0], 90)
    return {"type": "envmap", "bitmap": mi.Bitmap(image), "to_world": frame}


def gallery_environment():
    """All materials under an environment map, points and rectangles."""
    rectangles = shapes("rectangle", 8, total=10.0, size=0.3)
    return {**gallery_stage(), "sky": sky(), **points(40, total=4.0), **rectangles}


def white_stage():
    """Much light from the fourth and later bounces: bright walls on three sides."""
    wall = {"type": "twosided", "material": diffuse(0.9, 0.85, 0.8)}
    scene = stage(diffuse(0.85, 0.9, 0.85), diffuse(0.9, 0.9, 0.9))
    for index, degrees in enumerate((-90, 0, 90)):
        frame = transform().rotate([0, 0, 1], degrees).translate([0, 2.8, 1]).rotate([1, 0, 0], 90)
        scene[f"wall_{index}"] = {
            "type": "rectangle",
            "to_world": frame.scale([2.8, 1.2, 1]),
            "material": wall,
        }
    return scene


def bright_walls():
    """Many bounces under points and rectangles."""
    return {**white_stage(), **points(100, total=8.0), **shapes("rectangle", 10, total=10.0)}


def dark():
    """Low albedos, where Russian roulette ends most paths."""
    dark_stage = stage(diffuse(0.25, 0.15, 0.1), diffuse(0.1, 0.2, 0.3))
    return {**dark_stage, **points(100, total=20.0), **shapes("rectangle", 10, total=20.0)}


def mirrors():
    """Lights behind the stage, seen through thin glass and by chains of mirrors."""
    silver = {"type": "conductor", "material": "Ag"}
    return {
        **with_mirror(silver),
        "window": pane({"type": "thindielectric"}, (0, -2.6, 0.8), (1.5, 1)),
        "side": pane(silver, (-1.9, 0, 1), (1, 2), 80, (0, 1, 0)),
    }


def lamps_in_view(count=20, total=20.0):
    """Spheres behind the ball and the block, and above them."""
    lights = {}
    for index, colour in enumerate(colours(count, np.random.default_rng(44), total)):
        x, y, z = -2.2 + 1.1 * (index % 5), 1.9 + 0.3 * (index % 3), 0.2 + 0.25 * (index // 5)
        lights[f"lamp_{index}"] = {
            "type": "sphere",
            "center": [x, y, z],
            "radius": 0.15,
            "emitter": area(rgb(colour)),
        }
    return lights


def visible_through():
    """Lamps in view, some of them behind glass, a mask and an opening."""
    return {
        **stage(),
        **points(40, total=8.0),
        **lamps_in_view(),
        "window": pane({"type": "thindielectric"}, (0.2, 1.4, 0.5), (0.4, 0.4)),
        "net": pane(MIRRORS["mask"](), (1.3, 1.4, 0.9), (0.4, 0.3), -90),
        "hole": pane({"type": "null"}, (-1.1, 1.4, 0.8), (0.4, 0.4)),
        "glass": ball({"type": "dielectric"}, (0.6, -1.1, 0.3), 0.3),
    }


def silhouettes():
    """Things with nothing behind them, and no environment, for the alpha channel."""
    lights = points(40, total=8.0) | shapes("rectangle", 8, total=10.0)
    scene = {**things(), **lights, **shapes("sphere", 4, seed=31, size=0.3, total=4.0)}
    for index in range(4):
        lamp = scene[f"sphere_{index}"]
        lamp["to_world"] = transform().translate([-1.5 + index, 0.5, 0.9]).scale(0.2)
    scene["ball"] = ball(rough_metal(), (-0.6, -0.2, 0.45), 0.3)
    return {"type": "scene", "sensor": stage()["sensor"], **scene}


SURFACES = {
    "gallery": gallery,
    "gallery-environment": gallery_environment,
    "bright-walls": bright_walls,
    "dark": dark,
    "mirrors": mirrors,
    "visible-through": visible_through,
    "silhouettes": silhouettes,
}
for key, make in MATERIALS.items():
    SURFACES[f"material-{key}"] = lambda make=make: with_material(make())
for key, make in MIRRORS.items():
    SURFACES[f"material-{key}"] = lambda make=make: with_mirror(make())

# ------------------------------------------------------------------------------------------ media


def homogeneous(sigma_t=0.4, albedo=0.8, phase=None, **parameters):
    """A homogeneous medium; `sigma_t` and `albedo` may be colours."""
    medium = {"type": "homogeneous", "sigma_t": value(sigma_t), "albedo": value(albedo)}
    if phase:
        medium["phase"] = phase
    return medium | parameters


def value(number_or_colour):
    """A number, or a colour as a dictionary."""
    return rgb(number_or_colour) if np.ndim(number_or_colour) else float(number_or_colour)


def densities(shape=(8, 8, 8)):
    """Density of smoke: a few round clouds on a base of 0.1, none above half of the height."""
    generator = np.random.default_rng(41)
    cells = np.stack(np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij"), axis=-1)
    total = np.full(shape, 0.1)
    for _ in range(5):
        # The first axis of a grid is z
        center = generator.uniform((0.05, 0.2, 0.2), (0.35, 0.8, 0.8))
        total += 0.8 * np.exp(-((cells - center) ** 2).sum(axis=-1) / 0.02)
    return np.where(cells[..., 0] < 0.5, np.minimum(total, 1), 0.0)[..., np.newaxis]


def grid(values, low=(-2.4, -2.4, -0.1), high=(2.4, 2.4, TALL), **parameters):
    """A volume of values (z, y, x, channel) that fills a box."""
    size = [float(b - a) for a, b in zip(low, high)]
    frame = transform().translate([float(a) for a in low]).scale(size)
    values = mi.VolumeGrid(np.ascontiguousarray(values, dtype=np.float32))
    return {"type": "gridvolume", "grid": values, "to_world": frame, **parameters}


def heterogeneous(sigma_t=None, albedo=0.8, phase=None, scale=0.7, **parameters):
    """Smoke; by default with the densities above."""
    medium = {
        "type": "heterogeneous",
        "sigma_t": sigma_t or grid(densities()),
        "albedo": albedo if isinstance(albedo, dict) else value(albedo),
        "scale": scale,
    }
    if phase:
        medium["phase"] = phase
    return medium | parameters


def box(low, high, bsdf=None, interior=None, exterior=None):
    """An axis-parallel box, by default with an index-matched boundary."""
    middle = [(a + b) / 2 for a, b in zip(low, high)]
    half = [(b - a) / 2 for a, b in zip(low, high)]
    shape = {
        "type": "cube",
        "to_world": transform().translate(middle).scale(half),
        "bsdf": bsdf or {"type": "null"},
    }
    return shape | media(interior, exterior)


def media(interior, exterior):
    """The media on both sides of a boundary."""
    sides = {"interior": interior, "exterior": exterior}
    return {side: medium for side, medium in sides.items() if medium}


def fog_box(medium, top=TOP):
    """A box of fog that covers what stands on the floor."""
    return box((-2.4, -2.4, -0.1), (2.4, 2.4, top), interior=medium)


def lamps():
    """Points, spots and rectangles above the picture."""
    rectangles = shapes("rectangle", 10, total=15.0, size=0.25)
    return points(60, total=8.0) | spots(20, total=15.0) | rectangles


def round_lamps(count=24, seed=42, total=40.0, size=0.2):
    """Larger spheres, which fog may touch: what they give at a point is bounded."""
    return shapes("sphere", count, seed, total, size)


def fog(medium=None, top=TOP, lights=None):
    """The stage in fog."""
    return {**stage(), **(lights or lamps()), "fog": fog_box(medium or homogeneous(), top)}


def reference(name):
    """A reference to a medium at the top level of the scene."""
    return {"type": "ref", "id": name}


def hg(g):
    """The phase function of Henyey and Greenstein."""
    return {"type": "hg", "g": g}


TABULATED = (0.5, 1.5, 0.2, 0.4, 1.0, 3.0)
PHASES = {
    "isotropic": lambda: {"type": "isotropic"},
    "hg-forward": lambda: hg(0.7),
    "hg-backward": lambda: hg(-0.5),
    "rayleigh": lambda: {"type": "rayleigh"},
    "tabphase": lambda: {"type": "tabphase", "values": ", ".join(map(str, TABULATED))},
    "blendphase": lambda: {
        "type": "blendphase",
        "weight": 0.3,
        "first": hg(0.6),
        "second": {"type": "rayleigh"},
    },
    "sggx": lambda: {"type": "sggx", "S": microflakes()},
}


def microflakes(*values):
    """Flakes, the six values of their symmetric matrix: by default round ones."""
    return grid(np.reshape(values or (0.5, 0.5, 0.5, 0, 0, 0), (1, 1, 1, 6)))


def flat_flakes():
    """Flakes that lie flat, more or less, under points.

    Mitsuba 3.9.1 samples `sggx` in the transposed frame, so that only what it evaluates is right:
    light of points, scattered once.
    """
    flakes = {"type": "sggx", "S": microflakes(0.15, 0.35, 0.9, 0.05, 0.1, -0.1)}
    return fog(homogeneous(0.6, 0.9, flakes), lights=points(100, total=12.0))


CHROMATIC = {"sigma_t": (0.25, 0.4, 0.6), "albedo": (0.9, 0.8, 0.6)}


def chromatic_smoke():
    """Densities and albedos that differ by colour and place."""
    density = densities() * np.array([0.6, 0.8, 1.0])
    generator = np.random.default_rng(43)
    albedo = grid(generator.uniform(0.3, 0.95, (3, 3, 3, 3)))
    return heterogeneous(grid(density), albedo)


def camera_inside(medium, lights=None):
    """Fog around the camera, up to above the lights; the sensor knows its medium."""
    scene = {**stage(), **(lights or round_lamps()), "mist": medium}
    scene["sensor"]["medium"] = reference("mist")
    scene["fog"] = box((-3, -5, -0.1), (3, 3, TALL), interior=reference("mist"))
    return scene


def unbounded(lights, **parameters):
    """Fog everywhere: no boundary, only the sensor has a medium."""
    medium = homogeneous(**({"sigma_t": 0.08} | parameters))
    scene = {**stage(), **lights}
    scene["sensor"]["medium"] = medium
    return scene


def points_in_bubble():
    """Tall fog with a hollow around the points: a boundary that is seen from outside."""
    scene = {**stage(), **points(60, total=12.0), "mist": homogeneous()}
    scene["fog"] = fog_box(reference("mist"), TALL)
    scene["bubble"] = box((-2.2, -2.2, 1.3), (2.2, 2.2, 2.7), exterior=reference("mist"))
    return scene


def nested_media():
    """A ball of dense, coloured fog within thin fog; it knows what is outside."""
    scene = fog(reference("mist"))
    scene["mist"] = homogeneous(0.25, 0.7)
    inner = homogeneous((0.9, 0.5, 0.7), (0.5, 0.9, 0.8), hg(0.4), scale=3.0)
    scene["puff"] = ball({"type": "null"}, (0.3, -0.8, 0.6), 0.45)
    scene["puff"] |= media(inner, reference("mist"))
    return scene


def overlapping_media():
    """Boxes that cut each other, and one in another that does not know what is outside.

    Which medium a path is in depends on the boundaries that it has crossed, in every path tracer.
    """
    return {
        **stage(),
        **lamps(),
        "left": box((-2.3, -2.2, -0.1), (0.4, 2.3, 1.2), interior=homogeneous(0.4, 0.9)),
        "right": box((-0.5, -2.3, -0.2), (2.3, 2.1, 1.0), interior=homogeneous(0.7, 0.5, hg(0.3))),
        "inner": box((0.6, -1.5, 0.2), (1.6, -0.4, 0.8), interior=homogeneous(1.5, 0.9)),
    }


def glass_in_fog():
    """Glass balls in fog, one of them filled with it and one hollow, and rough glass."""
    scene = fog(reference("mist"), lights=points(40, total=5.0) | round_lamps(12, total=12.0))
    scene["mist"] = homogeneous(0.3, 0.8)
    scene["full"] = ball({"type": "dielectric"}, (0.35, -1.1, 0.4), 0.3)
    scene["hollow"] = ball({"type": "dielectric"}, (-0.9, -1.2, 0.4), 0.3)
    scene["hollow"] |= media(None, reference("mist"))
    scene["frosted"] = ball({"type": "roughdielectric", "alpha": 0.4}, (1.3, -0.6, 0.45), 0.35)
    return scene


def fog_in_glass(sample_emitters=True):
    """Milk in glass: lights are out of reach of shadow rays."""
    sky = {"type": "constant", "radiance": rgb([0.3, 0.4, 0.5])}
    milk = homogeneous((0.8, 0.9, 1.0), (0.9, 0.8, 0.7), scale=3.0, sample_emitters=sample_emitters)
    scene = {**stage(), **points(30, total=3.0), **round_lamps(12, total=12.0), "sky": sky}
    scene["milk"] = ball({"type": "dielectric"}, (0.4, -1.0, 0.45), 0.45) | media(milk, None)
    scene["jade"] = ball({"type": "roughdielectric", "alpha": 0.3}, (1.4, -0.2, 0.5), 0.4)
    scene["jade"] |= media(homogeneous(2.0, 0.9, hg(0.3), sample_emitters=sample_emitters), None)
    return scene


def thin_boundary():
    """Flat layers of dense fog."""
    scene = {**stage(), **lamps()}
    for index, height in enumerate((0.5, 0.95, 1.2)):
        layer = homogeneous(12.0 * (index + 1), 0.8)
        scene[f"layer_{index}"] = box(
            (-2, -2.4 + index, height), (2, 2.0, height + 0.01), interior=layer
        )
    return scene


def partial_boundary(bsdf):
    """Fog behind a boundary that lets a part of the light through without a change."""
    scene = {**stage(), **lamps()}
    scene["fog"] = box((-2.4, -2.4, -0.1), (2.4, 2.4, TOP), bsdf, homogeneous(0.3))
    return scene


def nets_in_fog():
    """Masks and thin glass in fog: shadow rays pass them in part."""
    scene = fog(homogeneous(0.3), lights=points(60, total=8.0) | round_lamps(12, total=12.0))
    mask = {"type": "mask", "opacity": 0.5, "material": diffuse(0.6, 0.5, 0.4)}
    scene["net"] = pane(mask, (0, 0, 1.0), (1.2, 1.2), 170)
    scene["window"] = pane({"type": "thindielectric"}, (0.9, -1.2, 0.6), (0.5, 0.4))
    return scene


def room():
    """A closed room full of fog, with walls that bound the medium, and the camera inside."""
    wall = {"type": "twosided", "material": diffuse(0.6, 0.5, 0.5)}
    scene = {**stage(), **round_lamps(), "mist": homogeneous(0.2, 0.8)}
    scene["sensor"]["medium"] = reference("mist")
    scene["walls"] = box((-3, -5, -0.1), (3, 3, 3), wall, reference("mist"))
    # What is outside of these is fog as well, as they say
    for name in ("ball", "floor", *round_lamps()):
        scene[name] |= media(None, reference("mist"))
    return scene


def without_emitter_sampling():
    """Fog that casts no shadow rays: large lamps and the sky, found by the phase function."""
    sky = {"type": "constant", "radiance": rgb([0.3, 0.4, 0.5])}
    scene = fog(homogeneous(0.5, 0.9, hg(0.3), sample_emitters=False), lights=points(30, total=3.0))
    return {**scene, **round_lamps(20, total=40.0, size=0.4), "sky": sky}


def fog_environment():
    """Fog under an environment map, a beam, points and rectangles."""
    sun = {"type": "directional", "direction": [0.5, 0.4, -1], "irradiance": rgb([0.3, 0.3, 0.2])}
    lights = points(40, total=4.0) | shapes("rectangle", 8, total=10.0, size=0.3)
    return {**fog(lights=lights), "sky": sky(), "sun": sun}


def fog_many_kinds():
    """Fog about a mesh, textured rectangles, disks, cylinders and projectors.

    Behind a border Mitsuba loses light of lamps whose surface it nearly runs along.
    """
    lights = {"lamps": make_mesh(triangles(60), rgb([2, 1.5, 1]))}
    lights |= shapes("rectangle", 4, seed=7, size=0.4, radiance=stripes(6.0))
    lights |= shapes("disk", 4, seed=8, total=6.0) | shapes("cylinder", 4, seed=9, total=6.0)
    for index, x in enumerate((-1.0, 0.2, 1.1)):
        lights[f"projector_{index}"] = {
            "type": "projector",
            "irradiance": stripes(2.0),
            "fov": 40 + 10 * index,
            "to_world": transform().look_at([x, -1, 2.2], [0.5 * x, 0, 0], [0, 1, 0]),
        }
    return fog(top=3.0, lights=lights)


def fog_visible_lamps():
    """Lamps in view behind and above fog, for the emitters that the camera sees."""
    scene = {**stage(), **points(40, total=8.0), **lamps_in_view()}
    scene["fog"] = box((-2.4, -2.4, -0.1), (2.4, 1.3, 0.8), interior=homogeneous(0.3))
    return scene


def fog_silhouettes():
    """A ball of fog, a glass ball and a lamp with nothing behind them, for the alpha channel."""
    scene = {**silhouettes(), "puff": ball({"type": "null"}, (-0.2, -0.9, 0.9), 0.5)}
    return {**scene, "puff": scene["puff"] | media(homogeneous(1.5, 0.7), None)}


def two_cameras():
    """One camera in fog that has a medium, and one outside of it that has none."""
    scene = camera_inside(homogeneous(0.15, 0.8))
    outside = stage()["sensor"]
    outside["to_world"] = transform().look_at([-7, -7, 3], [0, 0, 0.8], [0, 0, 1])
    outside["fov"] = 20
    return {**scene, "sensor_outside": outside}


# --------------------------------------------------------------------------- furnaces

EMISSION = (0.3, 0.2, 0.15)
WALL_ALBEDO = (0.5, 0.6, 0.3)
SKY = (1.0, 0.8, 0.5)


def lossless_things():
    """What absorbs nothing: in uniform light one cannot see it."""
    white = {"type": "twosided", "material": diffuse(1, 1, 1)}
    return {
        "glass": ball({"type": "dielectric"}, (0.2, 0.1, 0.15), 0.2),
        "mirror": ball({"type": "conductor", "material": "none"}, (-0.3, 0.4, -0.2), 0.25),
        "white": ball(diffuse(1, 1, 1), (0.4, 0.3, -0.4), 0.2),
        "net": pane({"type": "mask", "opacity": 0.5, "material": white}, (-0.3, 0.1, 0.4)),
        "window": pane({"type": "thindielectric"}, (0.1, -0.3, -0.2), (0.3, 0.2), 70),
    }


def furnace(medium=None, things=None, tiles=3):
    """A closed cube with walls of tiles that all emit and reflect alike."""
    scene = {"type": "scene", "sensor": stage()["sensor"], **(things or {})}
    scene["sensor"]["to_world"] = transform().look_at([0, -0.9, 0], [0, 0, 0], [0, 0, 1])
    scene["sensor"]["fov"] = 70
    if medium:
        scene["sensor"]["medium"] = medium
    turns = [([1, 0, 0], 90 * k) for k in range(4)] + [([0, 1, 0], 90), ([0, 1, 0], -90)]
    for side, (axis, degrees) in enumerate(turns):
        for row, column in np.ndindex(tiles, tiles):
            x, y = (2 * np.array([row, column]) + 1) / tiles - 1
            frame = transform().rotate(axis, degrees).translate([float(x), float(y), -1])
            scene[f"tile_{side}_{row}_{column}"] = {
                "type": "rectangle",
                "to_world": frame.scale([1 / tiles, 1 / tiles, 1]),
                "material": diffuse(*WALL_ALBEDO),
                "emitter": area(rgb(EMISSION)),
            }
    return scene


def furnace_radiance(depth):
    """Radiance in the furnace of all paths with up to `depth` segments, or of all (-1)."""
    emission, albedo = np.array(EMISSION), np.array(WALL_ALBEDO)
    bounces = 1 - albedo**depth if depth >= 0 else 1
    return emission * bounces / (1 - albedo)


def open_air(medium, things=None):
    """A ball of fog under a uniform sky."""
    scene = {"type": "scene", "sensor": stage()["sensor"], **(things or {})}
    scene["sensor"]["to_world"] = transform().look_at([0, -3, 0], [0, 0, 0], [0, 0, 1])
    scene["fog"] = ball({"type": "null"}, (0, 0, 0), 1) | media(medium, None)
    return {**scene, "sky": {"type": "constant", "radiance": rgb(SKY)}}


WHITE_MEDIA = {
    "chromatic": lambda: homogeneous((0.3, 0.6, 0.5), 1.0),
    "not-spectral": lambda: homogeneous(0.5, 1.0, has_spectral_extinction=False),
    "smoke": lambda: heterogeneous(grid(densities(), (-1, -1, -1), (1, 1, 3)), 1.0, scale=2.0),
}
for key, make in PHASES.items():
    WHITE_MEDIA[key] = lambda make=make: homogeneous(0.6, 1.0, make())

# --------------------------------------------------------------------------------------- the lists

FOGS = {
    "fog": fog,
    "fog-chromatic": lambda: fog(homogeneous(**CHROMATIC)),
    "fog-not-spectral": lambda: fog(homogeneous(0.5, has_spectral_extinction=False)),
    "smoke": lambda: fog(heterogeneous(), TALL),
    "smoke-chromatic": lambda: fog(chromatic_smoke(), TALL),
    "smoke-not-spectral": lambda: fog(heterogeneous(has_spectral_extinction=False), TALL),
    "smoke-phase": lambda: fog(heterogeneous(phase=hg(0.6)), TALL),
    "camera-inside": lambda: camera_inside(homogeneous(0.15, 0.8)),
    "camera-inside-smoke": lambda: camera_inside(heterogeneous(scale=0.4)),
    "lamps-inside": lambda: fog(homogeneous(0.3), TALL, round_lamps()),
    "points-inside": lambda: fog(homogeneous(0.2), TALL, points(60, total=12.0)),
    "points-in-bubble": points_in_bubble,
    "points-unbounded": lambda: unbounded(points(60, total=12.0), sigma_t=(0.06, 0.08, 0.12)),
    "lamps-unbounded": lambda: unbounded(round_lamps()),
    "nested": nested_media,
    "overlapping": overlapping_media,
    "glass-in-fog": glass_in_fog,
    "fog-in-glass": fog_in_glass,
    "fog-in-glass-unsampled": lambda: fog_in_glass(sample_emitters=False),
    "thin-boundary": thin_boundary,
    "thin-glass-boundary": lambda: partial_boundary({"type": "thindielectric"}),
    "mask-boundary": lambda: partial_boundary(
        {"type": "mask", "opacity": 0.3, "material": diffuse(0.5, 0.5, 0.5)}
    ),
    "nets": nets_in_fog,
    "room": room,
    "unsampled": without_emitter_sampling,
    "environment": fog_environment,
    "many-kinds": fog_many_kinds,
    "visible-lamps": fog_visible_lamps,
    "fog-silhouettes": fog_silhouettes,
    "two-cameras": two_cameras,
}
for key, make in PHASES.items():
    FOGS[f"phase-{key}"] = lambda make=make: fog(homogeneous(0.6, 0.9, make()))
FOGS["flat-flakes"] = flat_flakes
FOGS["smoke-sggx"] = lambda: fog(heterogeneous(phase=PHASES["sggx"](), scale=1.2), TALL)

SINGLE_SCATTERING = ("points-inside", "points-unbounded", "flat-flakes")
"""Scenes for `max_depth` 2: points in the medium, and what Mitsuba cannot sample."""

CUT_LAMPS = ("nets", "thin-boundary")
"""Scenes where borders of media cut lamps: Mitsuba's shadow rays lose 1 to 2 % of their light."""

SCENES = {**SURFACES, **FOGS}


def load(name, **film):
    """Load the scene `name` in the current variant; values of the film may be replaced."""
    scene = SCENES[name]()
    for sensor in ("sensor", "sensor_outside"):
        if sensor in scene:
            scene[sensor]["film"] |= film
    return mi.load_dict(scene)
