"""Scenes where methods for many lights fail, one for each way to fail.

A camera looks straight at a small receiver, so that all samples of an image see nearly the same
lights and their distribution can be studied. Lengths are in units of the scene, the receiver is at
the origin and faces up (z) unless a case says otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import mitsuba as mi
import numpy as np

from tests.light_scenes import area, diffuse, make_mesh, octahedron, rgb, transform

TINTS = np.array([[1.0, 0.8, 0.6], [0.6, 0.8, 1.0], [0.9, 0.9, 0.9]])
BROWN = diffuse(0.6, 0.5, 0.4)
"""The material of receivers, unless another one is what is hard."""


@dataclass(frozen=True)
class Case:
    """A scene and how it is judged."""

    hard: str
    """What is hard about it."""
    scene: Callable[[], dict]
    """Makes the dictionary for `mi.load_dict`, without integrator."""
    same_as: Callable[[], dict] | None = None
    """Another scene of the same mean that the reference is rendered from."""
    parameters: dict = field(default_factory=dict)
    """Of the integrator under test; with `max_depth` it is `manylights_volpath`."""
    variance: float = 0.0
    """Largest relative variance of a sample: half more than what was measured (README.md)."""
    tail: float = 10.0
    """How much brighter than those of exhaustive resampling rare samples may be."""
    black: bool = False
    """Is the image exactly zero?"""
    slow: bool = False
    """Do its tests take more than ten seconds?"""
    plain: bool = True
    """Is it a diffuse floor under points and spots, which has a closed form?"""


def rng(seed=0):
    """Random numbers of a case."""
    return np.random.default_rng(seed)


def camera(size=0.5, target=(0, 0, 0), origin=(0, 0, 0.5), near=1e-2, rfilter="box"):
    """An orthographic view of a square of the given size; the film's size is set later."""
    frame = transform().look_at(list(origin), list(target), [0, 1, 0])
    return {
        "type": "orthographic",
        "to_world": frame.scale([size / 2, size / 2, 1]),
        "near_clip": near,
        "far_clip": 1e9,
        "film": {
            "type": "hdrfilm",
            "rfilter": {"type": rfilter},
            "pixel_format": "rgb",
            "component_format": "float32",
        },
        "sampler": {"type": "manylights_sobol"},
    }


def scene(lights, bsdf=None, half=20.0, **sensor):
    """A floor and its camera, with lights: a dictionary, or a list of them."""
    if not isinstance(lights, dict):
        lights = {f"light_{index}": light for index, light in enumerate(lights)}
    floor = {
        "type": "rectangle",
        "to_world": transform().scale(half),
        "bsdf": bsdf or BROWN,
    }
    return {"type": "scene", "sensor": camera(**sensor), "floor": floor, **lights}


def point(position, intensity):
    """A point light."""
    return {
        "type": "point",
        "position": [float(x) for x in position],
        "intensity": rgb(np.broadcast_to(intensity, 3)),
    }


def points(count, seed=1, total=20.0, decades=1.0, low=(-2, -2, 1), high=(2, 2, 3)):
    """Point lights at random places of a box."""
    generator = rng(seed)
    places = generator.uniform(low, high, (count, 3))
    values = 10 ** generator.uniform(-decades, 0, count)
    values *= total / values.sum()
    tints = TINTS[generator.integers(len(TINTS), size=count)]
    return [point(p, v * tint) for p, v, tint in zip(places, values, tints)]


def toward(origin, target):
    """The frame at `origin` whose z axis looks at `target`."""
    return transform().look_at(
        [float(x) for x in origin], [float(x) for x in target], [0.1, 1, 0.2]
    )


def lamp(to_world, radiance, kind="rectangle", **more):
    """An emitter with a shape."""
    return {
        "type": kind,
        "to_world": to_world,
        "emitter": area(
            radiance if isinstance(radiance, dict) else rgb(np.broadcast_to(radiance, 3))
        ),
        **more,
    }


# ------------------------------------------------------------------------- distance and position


def in_emitter_plane():
    """Lamps flush with the floor all around the receiver, and fewer lights above."""
    generator = rng()
    places = generator.uniform(-1, 1, (100, 2))
    places = places[np.abs(places).max(axis=1) > 0.35][:60]
    flush = [lamp(transform().translate([*map(float, p), 0]).scale(0.04), 50.0) for p in places]
    return scene(flush + points(20), half=20)


def ripples(cells=16, height=0.1):
    """Triangles of hills and valleys that face each other."""
    grid = np.linspace(-1, 1, cells + 1)
    x, y = np.meshgrid(grid, grid)
    z = height * np.cos(9 * x) * np.cos(7 * y)
    corner = np.stack([x, y, z], axis=-1)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    triangles = np.concatenate([np.stack([a, b, c], -2), np.stack([a, c, d], -2)])
    return triangles.reshape(-1, 3, 3)


def on_emitter():
    """A receiver that is itself made of 512 lamps."""
    lights = {"lamps": make_mesh(ripples(), rgb([2.0] * 3), material=BROWN)}
    lights |= {f"point_{index}": light for index, light in enumerate(points(50))}
    return {"type": "scene", "sensor": camera(size=1.5), **lights}


def inside_cluster():
    """A tight ring of points around the receiver, in a ball of a thousand points."""
    generator = rng()
    directions = generator.normal(size=(1000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ball = directions * generator.uniform(0.3, 1, (1000, 1)) ** (1 / 3)
    angle = np.arange(64) * np.pi / 32
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle + 0.2], axis=-1) * 0.05
    lights = [point(p, 0.02) for p in ball] + [point(p, 2e-5) for p in ring]
    return scene(lights, size=0.01)


def near(distance):
    """A point light very near to a receiver that is as small as the distance."""
    return lambda: scene(
        [point((0, 0, distance), distance**2), *points(300)],
        # Positions on a large triangle are not that exact
        half=2 * distance,
        size=distance,
    )


def at_receiver():
    """A point light exactly where the receiver is: its light is infinite times zero."""
    return scene([point((0, 0, 0), 1.0), *points(300)], size=1e-25)


def beside_receiver():
    """The same receiver without that light."""
    return scene(points(300), size=1e-25)


def far_scene(shift):
    """A scene of 10,000 units whose centre is far from the origin of the coordinates."""

    def make():
        generator = rng()
        places = generator.uniform((-4000, -4000, 2000), (4000, 4000, 6000), (500, 3))
        result = scene(
            [point(p + shift, 1e5) for p in places],
            size=1000,
            target=shift,
            origin=np.add(shift, (0, 0, 10_000)),
        )
        result["floor"]["to_world"] = transform().translate([float(x) for x in shift]).scale(20_000)
        return result

    return make


def far_lights():
    """Lights in groups a million units away, and near ones."""
    generator = rng()
    groups = generator.normal(size=(20, 3))
    groups[:, 2] = np.abs(groups[:, 2]) + 0.2
    groups *= 1e6 / np.linalg.norm(groups, axis=1, keepdims=True)
    places = groups[np.arange(200) % 20] + generator.uniform(-5, 5, (200, 3))
    return scene([point(p, 5e10) for p in places] + points(200))


# ------------------------------------------------------------------------------- number and power


def coincident(count):
    """Lights of different power at one place."""
    values = 10 ** rng().uniform(-2, 0, count)
    values *= 10 / values.sum()
    return lambda: scene([point((0.3, 0.2, 1), value) for value in values])


def twelve_decades():
    """Powers over twelve decades; the bright ones are far."""
    generator = rng()
    power = 10 ** generator.uniform(-12, 0, 500)
    directions = generator.normal(size=(500, 3))
    directions[:, 2] = np.abs(directions[:, 2]) + 0.3
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    places = directions * np.maximum(np.sqrt(power) * 100, 0.3)[:, np.newaxis]
    return scene([point(p, 100 * value) for p, value in zip(places, power)], size=0.1)


def bright_far(count=10_000):
    """One bright light far away that gives half of the light, among weak near ones."""
    generator = rng()
    places = generator.uniform((-4, -4, 0.5), (4, 4, 2), (count, 3))
    return scene([point(p, 20 / count) for p in places] + [point((300, -200, 400), 4e5)])


def behind_wall():
    """A wall hides nine of ten lights, which are the brighter ones."""
    generator = rng()
    hidden = generator.uniform((0.6, -2, 0.5), (2, 2, 2), (225, 3))
    seen = generator.uniform((-2, -2, 0.5), (-0.6, 2, 2), (25, 3))
    wall = {
        "type": "rectangle",
        "to_world": transform().translate([0.4, 0, 2]).rotate([0, 1, 0], 90).scale(6),
        "bsdf": {"type": "twosided", "material": diffuse(0, 0, 0)},
    }
    lights = [point(p, 1.0) for p in hidden] + [point(p, 0.1) for p in seen]
    return {**scene(lights), "wall": wall}


def no_power(others=()):
    """A hundred points and a hundred lamps without power."""
    generator = rng()
    places = generator.uniform((-2, -2, 1), (2, 2, 3), (200, 3))
    dark = [point(p, 0.0) for p in places[:100]]
    dark += [lamp(toward(p, (0, 0, 0)).scale(0.2), 0.0) for p in places[100:]]
    return scene(dark + list(others))


def few(count):
    """That many points of different power."""
    return lambda: scene(points(count))


# ------------------------------------------------------------------------ direction and occlusion


def spots(cutoff, away=False, count=400):
    """Narrow spots; each one meets the receiver's neighbourhood, or all point up."""
    generator = rng()
    places = generator.uniform((-2, -2, 2), (2, 2, 4), (count, 3))
    targets = np.concatenate([generator.uniform(-1, 1, (count, 2)), np.zeros((count, 1))], 1)
    if away:
        targets = 2 * places - targets
    lights = [
        {
            "type": "spot",
            "to_world": toward(p, t),
            "intensity": rgb([1.0] * 3),
            "cutoff_angle": float(angle),
            "beam_width": float(angle * 0.8),
        }
        for p, t, angle in zip(places, targets, np.resize(cutoff, count))
    ]
    return lights


def edge_on():
    """Bright one-sided lamps that the receiver sees along their surface, weak ones that face it."""
    generator = rng()
    places = generator.uniform((-2, -2, 1), (2, 2, 3), (120, 3))
    lamps = []
    for place, tilt in zip(places[:100], generator.uniform(-2, 2, 100)):
        frame = toward(place, (0, 0, 0)).rotate([1, 0, 0], 90 + float(tilt)).scale(0.1)
        lamps.append(lamp(frame, 20.0))
    lamps += [lamp(toward(place, (0, 0, 0)).scale(0.1), 5.0) for place in places[100:]]
    return scene(lamps)


def wet_street():
    """Points above a floor whose lobe points into the distance."""
    shiny = {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": 0.15,
        "diffuse_reflectance": rgb([0.05] * 3),
    }
    lights = points(500, low=(-3, -2, 0.2), high=(3, 8, 3))
    return scene(lights, bsdf=shiny, size=0.1, origin=(0, -2, 0.4))


def frosted_glass():
    """Points behind a pane of rough glass, most of them off its lobe."""
    glass = {"type": "roughdielectric", "distribution": "ggx", "alpha": 0.1}
    lights = points(500, low=(-3, -3, -4), high=(3, 3, -0.5))
    return scene(lights, bsdf=glass, size=0.02)


def hair_above():
    """A lamp a thousandth above the floor, seen from the gap, and points."""
    lid = lamp(transform().translate([0, 0, 1e-3]).rotate([1, 0, 0], 180).scale(0.2), 1.0)
    return scene([lid, *points(100)], size=0.1, origin=(0, 0, 8e-4), near=1e-6)


def huge_and_tiny(alpha):
    """A lamp that fills half of the sky and thousands of small ones, on metal."""

    def make():
        generator = rng()
        small = np.array([[1, 0, 0], [-0.5, -0.9, 0], [-0.5, 0.9, 0]]) * 0.02
        places = generator.uniform((-2, -2, 1), (2, 2, 3), (4000, 1, 3))
        bulbs = make_mesh(small + places, rgb([40.0] * 3))
        huge = lamp(transform().translate([-15, 0, 8]).rotate([1, 0, 0], 180).scale(14), 1.0)
        metal = {"type": "roughconductor", "material": "Al", "alpha": alpha}
        view = {"origin": (0.4, 0.2, 0.8), "size": 0.2}
        return scene({"bulbs": bulbs, "huge": huge}, metal, **view)

    return make


def one_texel():
    """Lamps whose picture is black but for one texel."""
    generator = rng()
    lights = {}
    for index, place in enumerate(generator.uniform((-2, -2, 1), (2, 2, 3), (20, 3))):
        image = np.zeros((8, 8, 3), np.float32)
        image[tuple(generator.integers(8, size=2))] = 100
        bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True}
        bitmap["filter_type"] = "nearest" if index % 2 else "bilinear"
        lights[f"lamp_{index}"] = lamp(toward(place, (0, 0, 0)).scale(0.2), bitmap)
    return scene(lights)


def distorted():
    """Stretched, mirrored and sheared lamps."""
    generator = rng()
    lights = []
    for index, place in enumerate(generator.uniform((-2, -2, 1), (2, 2, 3), (12, 3))):
        frame = toward(place, generator.uniform((-1, -1, 0), (1, 1, 0)))
        shape = ("rectangle", "disk", "cube")[index % 3]
        if index % 2:
            matrix = np.eye(4)
            matrix[0, 1], matrix[2, 0] = 3, 2
            frame = frame @ mi.ScalarTransform4f(matrix)
        mirrored = -1 if index % 5 == 0 else 1
        stretch = 2.0 if shape != "cube" else 0.5
        frame = frame.scale([mirrored * stretch, 0.005, 0.05])
        lights.append(lamp(frame, 40.0, shape))
    return scene(lights)


def broken_triangles(broken=True):
    """A glowing mesh in which a quarter of the triangles has no area or no position."""
    generator = rng()
    small = np.array([[1, 0, 0], [-0.5, -0.9, 0], [-0.5, 0.9, 0]]) * 0.1
    places = generator.uniform((-2, -2, 1), (2, 2, 3), (300, 1, 3))
    whole = small + places
    if not broken:
        return scene({"lamps": make_mesh(whole, rgb([30.0] * 3))})
    bad = whole[:100] + 0.1
    bad[:50, 2] = bad[:50, 1]
    bad[50:60] = bad[50:60, :1]
    bad[60:80, 0] = np.nan
    bad[80:, 1, 2] = np.inf
    mixed = generator.permutation(np.concatenate([whole, bad]))
    return scene({"lamps": make_mesh(mixed, rgb([30.0] * 3))})


# ---------------------------------------------------------------------------- receivers and media


def coarse_ball():
    """An octahedron with the normals of a sphere, lit from the side."""
    corners, normals = octahedron(0, 1)
    ball = make_mesh(corners, None, None, normals, "ball", BROWN)
    lights = points(300, low=(2, -2, -1), high=(4, 2, 1), total=100.0)
    lights = {f"light_{index}": light for index, light in enumerate(lights)}
    return {"type": "scene", "sensor": camera(size=1.6, origin=(0, 0, 5)), "ball": ball, **lights}


def lit_from_below():
    """Rough glass with all the light below it."""
    lights = points(300, low=(-2, -2, -3), high=(2, 2, -1), total=100.0)
    return scene(lights, {"type": "roughdielectric", "alpha": 0.4})


def fog(extinction, lights, half=4.0, albedo=0.8, size=0.5):
    """A floor in a box of fog."""
    medium = {
        "type": "homogeneous",
        "sigma_t": extinction,
        "albedo": albedo,
        "phase": {"type": "hg", "g": 0.4},
    }
    box = {
        "type": "cube",
        "to_world": transform().translate([0, 0, half - 0.01]).scale(half),
        "bsdf": {"type": "null"},
        "interior": medium,
    }
    return {**scene(lights, size=size, origin=(0, 0, 3 * half)), "fog": box}


def bulbs(count, radius, radiance, low, high):
    """Glowing balls in a box."""
    return [
        {
            "type": "sphere",
            "center": [float(x) for x in place],
            "radius": radius,
            "emitter": area(rgb([radiance] * 3)),
        }
        for place in rng().uniform(low, high, (count, 3))
    ]


def dense_fog(within=False):
    """Bulbs below the top of dense fog; `within`: in nothing but fog, seen from where its top was.

    The light is the same, and no ray passes a border, behind which Mitsuba's begin too deep.
    """
    balls = bulbs(100, 0.02, 100.0, (-0.6, -0.6, 1.9), (0.6, 0.6, 1.95))
    result = fog(50.0, balls, half=1.0)
    if within:
        medium = result.pop("fog")["interior"]
        result["sensor"] = {**camera(origin=(0, 0, 2), near=0.01), "medium": medium}
    return result


def wide_filter():
    """A filter that spreads each sample over several pixels."""
    return scene(points(300), size=2.0, rfilter="gaussian")


def units(scale):
    """A scene of points, spots and lamps, 100 units across, in other units of length."""

    def make():
        generator = rng()
        places = 20 * generator.uniform((-2, -2, 1), (2, 2, 3), (300, 3))
        lights = [point(scale * p, 10 * scale**2) for p in places[:150]]
        for light in spots(20, count=50):
            frame = np.array(light["to_world"].matrix)
            frame[:3, 3] *= 20 * scale
            light["to_world"] = mi.ScalarTransform4f(frame)
            light["intensity"] = rgb([10 * scale**2] * 3)
            lights.append(light)
        for place in places[150:]:
            lights.append(lamp(toward(scale * place, (0, 0, 0)).scale(2 * scale), 1.0))
        view = {"size": 20 * scale, "origin": (0, 0, 10 * scale), "near": scale}
        return scene(lights, half=400 * scale, **view)

    return make


CASES = {
    "in-emitter-plane": Case(
        "60 lamps in the plane of the receiver", in_emitter_plane, plain=False, variance=0.0048
    ),
    "on-emitter": Case(
        "the receiver is made of 512 lamps", on_emitter, plain=False, variance=0.0038
    ),
    "inside-cluster": Case(
        "a ring of 64 lights around the receiver, among 1,000", inside_cluster, variance=0.0053
    ),
    "near-1e-2": Case("a light at 1/100 of a unit", near(1e-2), variance=0.0081),
    "near-1e-4": Case("a light at 1/10,000 of a unit", near(1e-4), variance=0.0081),
    "near-1e-6": Case("a light at a millionth of a unit", near(1e-6), variance=0.0081),
    "at-receiver": Case(
        "a light at the receiver", at_receiver, same_as=beside_receiver, variance=0.0078
    ),
    "coincident-64": Case("64 lights at one place", coincident(64), variance=0.027),
    "coincident-10000": Case(
        "10,000 lights at one place",
        coincident(10_000),
        same_as=lambda: scene([point((0.3, 0.2, 1), 10.0)]),
        variance=0.027,
    ),
    "twelve-decades": Case("powers over 12 decades", twelve_decades, variance=0.04),
    "bright-far": Case(
        "a bright far light among 10,000 weak near ones", bright_far, variance=0.001
    ),
    "behind-wall": Case(
        "the nine tenths that are brighter are hidden", behind_wall, plain=False, variance=0.44
    ),
    "spots-1": Case("400 spots of 1 degree", lambda: scene(spots(1.0)), tail=20, variance=11),
    "spots-5": Case(
        "400 spots of 2 to 5 degrees", lambda: scene(spots([2, 3, 4, 5])), tail=20, variance=0.49
    ),
    "spots-away": Case("all spots point away", lambda: scene(spots(5, True)), black=True),
    "edge-on": Case(
        "one-sided lamps seen along their surface", edge_on, plain=False, variance=0.26
    ),
    "no-power": Case(
        "200 lights without power among 20",
        lambda: no_power(points(20)),
        plain=False,
        variance=0.048,
    ),
    "only-no-power": Case("no light has power", no_power, black=True),
    "no-lights": Case("no lights", lambda: scene([]), black=True),
    "one-light": Case("one light", few(1), variance=0.038),
    "one-less-than-reservoirs": Case("N = m - 1", few(15), variance=0.0003),
    "as-many-as-reservoirs": Case("N = m", few(16), variance=0.00091),
    "one-more-than-reservoirs": Case("N = m + 1", few(17), variance=0.0075),
    "huge-and-tiny-rough": Case(
        "4,000 tiny lamps and a huge one, rough metal",
        huge_and_tiny(0.5),
        plain=False,
        variance=0.016,
    ),
    "huge-and-tiny-specular": Case(
        "the same on nearly specular metal", huge_and_tiny(0.02), plain=False, variance=0.33
    ),
    "wet-street": Case(
        "a shiny floor, nearly from the side", wet_street, plain=False, variance=0.073
    ),
    "frosted-glass": Case("points behind rough glass", frosted_glass, plain=False, variance=0.22),
    "hair-above": Case("a lamp 1/1000 above the floor", hair_above, plain=False, variance=0.011),
    "one-texel": Case("emission from one texel of a bitmap", one_texel, plain=False, variance=3.1),
    "distorted": Case("stretched, mirrored, sheared lamps", distorted, plain=False, variance=1.2),
    "broken-triangles": Case(
        "triangles without area or position",
        broken_triangles,
        same_as=lambda: broken_triangles(False),
        plain=False,
        variance=0.011,
    ),
    "far-origin": Case(
        "all of it 1e6 units from the origin", far_scene((1e6, -1e6, 1e6)), variance=0.00025
    ),
    "far-lights": Case("lights 1e6 units away", far_lights, variance=0.00021),
    "shading-normals": Case(
        "shading normals far from geometric ones", coarse_ball, plain=False, variance=5.9
    ),
    "lit-from-below": Case(
        "transmission with all light below", lit_from_below, plain=False, variance=0.33
    ),
    "dense-fog": Case(
        "mean free path of 1/50",
        dense_fog,
        same_as=lambda: dense_fog(within=True),
        parameters={"max_depth": 2},
        slow=True,
        plain=False,
        variance=15,
    ),
    "fog-layer": Case(
        "light that comes from far above a layer of dense fog",
        lambda: fog(20.0, points(300, decades=0), half=0.05),
        parameters={"max_depth": 2},
        plain=False,
        variance=0.054,
    ),
    "thin-fog": Case(
        "mean free path of 10,000",
        lambda: fog(1e-4, points(300)),
        parameters={"max_depth": 3},
        plain=False,
        variance=0.0016,
    ),
    "lights-in-dense-fog": Case(
        "lights up to 10 mean free paths deep",
        lambda: fog(5.0, bulbs(100, 0.1, 100.0, (-1, -1, 0.1), (1, 1, 1.8)), half=1.0),
        parameters={"max_depth": 3},
        slow=True,
        plain=False,
        variance=0.81,
    ),
    "small-units": Case(
        "lengths of 1e-4", units(1e-4), same_as=units(1.0), slow=True, plain=False, variance=0.022
    ),
    "large-units": Case(
        "lengths of 1e5", units(1e5), same_as=units(1.0), slow=True, plain=False, variance=0.022
    ),
    "wide-filter": Case("a filter wider than a pixel", wide_filter, plain=False, variance=0.0045),
}

QUICK = [name for name, case in CASES.items() if not case.slow]
