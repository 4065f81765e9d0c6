"""Random descriptions of small scenes, for Hypothesis and for plain seeds.

A description is a dictionary of numbers, strings and lists: short to print, easy to cut down by
hand. `described_scenes` makes a scene of it, and `light_quadrature` the light that falls on it,
without Mitsuba. The same functions draw for both sources of chance:

    any_scene(Seeded(7))                   the description number 7 of the soak
    strategy(any_scene, spectral=False)    a strategy for Hypothesis

What is drawn first in a list of choices is the plainest, which is where Hypothesis shrinks to.

Left out, since Mitsuba 3.9.1 refuses it or says that it is undefined: shear, mirrors and
non-uniform scales of spheres, the same across the axis of cylinders (it warns and goes on with
something else); more than one environment; instances of emitters; spectra other than colours in
RGB variants, which may have negative colours there; media in shape groups, to which a refusal is a
right answer; `sunsky` in monochromatic variants, where it does not exist.
"""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from tests.described_scenes import PLACES

METHODS = ("resampled_tree", "talk", "adaptive_splitting", "tree", "exhaustive")

POWERS = (1.0, 1.0, 1.0, 1e-20, 1e18)
"""Units of radiance: single precision holds 1e-38 to 1e38, and squares of these do not fit."""

STEPS = 64
"""Numbers are drawn from so many equidistant ones: they print short, and shrink to the lowest."""


class Drawn:
    """Choices of Hypothesis, given the function that `st.composite` hands out."""

    def __init__(self, draw):
        self._draw = draw

    def integer(self, low, high):
        """From low to high, both included."""
        return self._draw(st.integers(low, high))


class Seeded:
    """Choices that follow from a seed."""

    def __init__(self, seed):
        self._generator = np.random.default_rng(seed)

    def integer(self, low, high):
        """From low to high, both included."""
        return int(self._generator.integers(low, high, endpoint=True))


def strategy(function, **arguments):
    """The strategy that draws `function(choice, **arguments)`."""
    return st.composite(lambda draw: function(Drawn(draw), **arguments))()


def one_of(choice, *values):
    """One of the values."""
    return values[choice.integer(0, len(values) - 1)]


def number(choice, low, high):
    """A number from low to high, of four digits."""
    return float(f"{low + (high - low) * choice.integer(0, STEPS) / STEPS:.4g}")


def numbers(choice, count, low, high):
    """A list of them."""
    return [number(choice, low, high) for _ in range(count)]


def often(choice, tenths):
    """True with the probability of so many tenths."""
    return choice.integer(0, 9) >= 10 - tenths


def colour(choice, scale=1.0):
    """A colour, one in eight with a black channel."""
    values = [round(scale * value, 6) for value in numbers(choice, 3, 0.1, 1)]
    if choice.integer(0, 7) == 7:
        values[choice.integer(0, 2)] = 0.0
    return values


# ----------------------------------------------------------------------------------- radiance

WRAPS = ("repeat", "mirror", "clamp")


def uv_transform(choice):
    """Steps of a transformation of texture coordinates, the last one applied first."""
    kind = one_of(choice, "none", "scale", "rotate", "mirror", "all")
    steps = []
    if kind in ("rotate", "all"):
        steps.append(["rotate", number(choice, -180, 180)])
    if kind in ("mirror", "all"):
        steps.append(["scale", one_of(choice, [-1, 1], [1, -1], [-1, -1])])
    if kind in ("scale", "all"):
        steps.append(["scale", numbers(choice, 2, 0.5, 6)])
    if kind == "all":
        steps.append(["translate", numbers(choice, 2, -1, 1)])
    return steps


def texture(choice, scale):
    """A bitmap of a few texels, of one colour or of many, or a checkerboard."""
    kind = one_of(choice, "bitmap", "bitmap", "plain", "checkerboard")
    result = {"kind": kind, "to_uv": uv_transform(choice)}
    if kind == "checkerboard":
        return result | {"colours": [colour(choice, scale), colour(choice, scale)]}
    result |= {"size": [choice.integer(1, 5), choice.integer(1, 5)], "scale": scale}
    result |= {"seed": choice.integer(0, 99), "wrap": one_of(choice, *WRAPS)}
    return result | {"filter": one_of(choice, "bilinear", "nearest")}


def spectrum(choice, scale):
    """A line or a band of wavelengths, or that of a hot body."""
    kind = one_of(choice, "regular", "irregular", "blackbody")
    if kind == "blackbody":
        return {"kind": kind, "temperature": number(choice, 1500, 8000)}
    return {
        "kind": kind,
        "middle": number(choice, 420, 680),
        "width": one_of(choice, 100.0, 20.0, 4.0),
        "scale": scale,
    }


def radiance(choice, scale, spectral, attributes=()):
    """What a light emits: a colour, a number, a texture, a spectrum or an attribute of a mesh."""
    kinds = ["rgb", "uniform", "texture", "texture", *(["spectrum"] if spectral else [])]
    kind = one_of(choice, *kinds, *attributes)
    if kind == "texture":
        return texture(choice, scale)
    if kind == "spectrum":
        return spectrum(choice, scale)
    if kind == "rgb":
        return {"kind": kind, "value": colour(choice, scale)}
    if kind == "uniform":
        return {"kind": kind, "value": round(scale * number(choice, 0.1, 1), 6)}
    return {"kind": kind, "scale": scale}


# ------------------------------------------------------------------------------------- shapes

AFFINE = ("rectangle", "cube", "disk", "mesh")
"""Shapes that may be sheared, mirrored and scaled by other numbers along each axis."""
SHAPES = (*AFFINE, "sphere", "cylinder")


def turned(direction, degrees, axis):
    """Steps that turn the z axis into a direction, after a turn by some degrees about an axis."""
    x, y, z = (float(value) for value in direction)
    about, angle = [-y, x, 0.0], float(np.degrees(np.arccos(np.clip(z, -1, 1))))
    if np.hypot(x, y) < 1e-6:
        about = [1.0, 0.0, 0.0]
    facing = ["rotate", [float(f"{value:.4g}") for value in about], float(f"{angle:.5g}")]
    return [facing, ["rotate", axis, degrees]]


def deformation(choice, kind, size):
    """Scale, mirror and shear, as far as the shape has them; nothing gets larger than `size`."""
    if kind == "sphere":
        return [["scale", 3 * [float(f"{size * number(choice, 0.4, 1):.4g}")]]]
    if kind == "cylinder":
        across, along = numbers(choice, 2, 0.3, 0.7)
        return [["scale", [float(f"{size * value:.4g}") for value in (across, across, along)]]]
    steps = []
    if often(choice, 4):
        steps.append(["shear", numbers(choice, 3, -0.5, 0.5)])
    factors = numbers(choice, 3, 0.2, 0.5)
    if often(choice, 3):
        factors = 3 * factors[:1]
    if often(choice, 3):
        factors[choice.integer(0, 2)] *= -1
    return [*steps, ["scale", [float(f"{size * value:.4g}") for value in factors]]]


def mesh(choice):
    """Triangles in the cube from -1 to 1: with normals, texture coordinates, colours."""
    return {
        "triangles": choice.integer(1, 6),
        "seed": choice.integer(0, 99),
        "uv": one_of(choice, True, False),
        "normals": often(choice, 3),
    }


def area_light(choice, kind, place, scale, spectral):
    """A shape that emits. `place` are the steps that put it somewhere."""
    light = {"kind": kind, "flip": often(choice, 2)}
    attributes = ()
    if kind == "mesh":
        light |= mesh(choice)
        attributes = ("vertex_color", "face_color")
    light["radiance"] = radiance(choice, scale, spectral, attributes)
    if kind == "mesh" and not light["uv"] and "to_uv" in light["radiance"]:
        light["uv"] = True
    return light | {"steps": place}


# -------------------------------------------------------------------- a patch that is lit


def lit_patch(choice, kind=None, fog=None):
    """A small diffuse patch under one to four lights, none of which hides another one.

    Each has a sector of directions, and what is in it of the fog is in one box, so that the light
    at the patch is a sum of integrals over single lights. Colours only.

    Args:
        kind: that of the first light. Default: any.
        fog: where a box of an absorbing medium is, one of `FOGS`. Default: none.
    """
    count = choice.integer(1, 4)
    lights = [patch_light(choice, index, count, kind) for index in range(count)]
    scene = {"albedo": colour(choice), "lights": lights}
    if fog:
        scene["fog"] = patch_fog(choice, fog, lights)
    scene["integrator"] = patch_integrator(choice, volpath=bool(fog))
    scene["power"] = one_of(choice, *POWERS)
    # Not smaller: the ends of rays keep an absolute distance of 1e-4 from surfaces
    scene["unit"] = one_of(choice, 1.0, 30.0, 1e3)
    return scene


POINTS = ("point", "spot", "directional")


def patch_light(choice, index, count, kind):
    """A light in sector `index` of `count`, of the given kind if it is the first one."""
    kind = kind if kind and not index else one_of(choice, *SHAPES, *POINTS)
    azimuth = 2 * np.pi * index / count + number(choice, -0.2, 0.2)
    elevation, distance = np.radians(number(choice, 20, 60)), number(choice, 1, 3)
    towards = np.array([np.cos(azimuth), np.sin(azimuth)]) * np.cos(elevation)
    direction = np.array([*towards, np.sin(elevation)])
    position = [float(f"{value:.4g}") for value in distance * direction]
    if kind == "directional":
        return {"kind": kind, "direction": (-direction).round(4).tolist(), "value": colour(choice)}
    if kind == "point":
        return {"kind": kind, "position": position, "value": colour(choice, distance**2)}
    place = [["translate", position]]
    tilt, axis = number(choice, -50, 50), numbers(choice, 3, -1, 1)[:2]
    axis = [axis[0], axis[1] or 1.0, 0.0]
    place += turned(-direction, tilt, axis)
    if kind == "spot":
        spot = {"kind": kind, "steps": [place[0], place[1]], "value": colour(choice, distance**2)}
        cutoff = number(choice, 10, 60)
        spot |= {"cutoff": cutoff, "beam": round(cutoff * number(choice, 0.2, 0.9), 4)}
        return spot | {"texture": texture(choice, 1.0) if often(choice, 5) else None}
    share = one_of(choice, 0.24, 0.1, 0.03)
    place += deformation(choice, kind, share * distance)
    light = area_light(choice, kind, place, round(0.2 / share**2, 3), spectral=False)
    if kind in ("sphere", "cube") and light["flip"]:
        # Emits inwards: black from outside, and there is nothing to compare
        light["flip"] = False
    return light | {"share": share}


def patch_integrator(choice, volpath=False, all_sampled=True):
    """Either plugin with any method, for paths of one bounce: all have the same mean."""
    volpath = volpath or often(choice, 3)
    result = {"type": "manylights_volpath" if volpath else "manylights_direct"}
    method = one_of(choice, METHODS[0], *METHODS)
    if method != METHODS[0]:
        result["method"] = method
    if volpath:
        return result | {"max_depth": 2}
    return result | {"bsdf_samples": choice.integer(0 if all_sampled else 1, 2)}


FOGS = ("patch", "light", "all", "slab")
"""Around patch and camera, around the first light, around everything, across the way."""


def patch_fog(choice, place, lights):
    """A box of fog and what is in it."""
    kind = one_of(choice, "homogeneous", "equal", "smaller", "larger")
    center, half = [0.0, 0.0, 0.0], 3 * [8.0 if place == "all" else 0.7]
    if place == "slab":
        center, half = [0.0, 0.0, 0.2], [8.0, 8.0, 0.08]
    light = lights[0]
    if place == "light" and light["kind"] != "directional":
        center = light.get("position") or light["steps"][0][1]
        distance = float(np.linalg.norm(center))
        # About a point it is dense: what shadow rays leave out before their end would show
        half = 3 * [float(f"{1.6 * light.get('share', 0.01) * distance:.4g}")]
    depth = number(choice, 0.1, 1)
    extinction = [float(f"{depth * value / min(*half, 2.0):.4g}") for value in colour(choice)]
    return {"kind": kind, "center": center, "half": half, "extinction": extinction}


SMOOTH = ("diffuse", "twosided", "roughconductor", "plastic", "normalmap")
"""Materials whose light from lamps is found by sampling these, too, in part of the samples."""
OTHERS = ("principled", "roughdielectric", "mask")
ALL_SAMPLED = ("diffuse", "twosided", "roughconductor", "normalmap")


def wide_lamps(choice):
    """A patch of any material under large area lights and an environment.

    Rays from the patch find these often enough. Lights may hide each other, but not from the
    camera.
    """
    material = one_of(choice, *SMOOTH, *OTHERS)
    scene = {"material": material, "lights": [], "environment": None}
    count = choice.integer(1, 3)
    for index in range(count):
        kind = one_of(choice, *SHAPES)
        azimuth = 2 * np.pi * index / count + number(choice, -0.2, 0.2)
        elevation = np.radians(number(choice, 10, 40))
        below = -1 if material in OTHERS and often(choice, 3) else 1
        direction = np.array([np.cos(azimuth), np.sin(azimuth), below * np.tan(elevation)])
        direction /= np.linalg.norm(direction)
        place = [["translate", [float(f"{value:.4g}") for value in 1.5 * direction]]]
        place += turned(-direction, number(choice, -40, 40), [1.0, 0.5, 0.0])
        place += deformation(choice, kind, 0.9)
        light = area_light(choice, kind, place, 1.0, spectral=False)
        # Closed ones would emit inwards only
        light["flip"] &= kind not in ("sphere", "cube")
        scene["lights"].append(light)
    # Without one, rare rays are all the light of lamps that are off a lobe
    if often(choice, 8 if material in (*OTHERS, "roughconductor", "plastic") else 3):
        scene["environment"] = {
            "kind": "envmap",
            "seed": choice.integer(0, 99),
            "steps": [["rotate", [1.0, 0.0, 0.0], number(choice, -180, 180)]],
        }
    all_sampled = material in ALL_SAMPLED
    return scene | {"integrator": patch_integrator(choice, all_sampled=all_sampled)}


# --------------------------------------------------------------------------- any scene at all

RECEIVERS = (
    *("diffuse", "roughconductor", "roughdielectric", "dielectric", "principled", "null"),
    *("mask", "twosided", "normalmap", "plastic"),
)
LAMP_SURFACES = ("none", "diffuse", "null", "mask", "twosided")
CURVES = ("linearcurve", "bsplinecurve")
POSITIONED = ("point", "spot", "projector", "directional")


def any_scene(choice, spectral=False, jit=False, sun=True):
    """A scene of everything: up to six lights above a floor with a ball, fog, instances."""
    scene = {
        "floor": one_of(choice, *RECEIVERS),
        "ball": one_of(choice, *RECEIVERS),
        "lights": [any_light(choice, spectral) for _ in range(choice.integer(0, 6))],
        "environment": any_environment(choice, spectral, sun),
        "medium": any_medium(choice),
        "instances": one_of(choice, None, *RECEIVERS[:5]),
        "camera": any_camera(choice),
        "power": one_of(choice, *POWERS),
    }
    if jit:
        scene["lights"] = without_curves_among_projectors(scene["lights"])
    return scene | {"integrator": any_integrator(choice, scene["medium"])}


def without_curves_among_projectors(lights):
    """The lights without curves, if others have to be sampled by Mitsuba's plugins.

    In JIT variants that call is recorded for all emitters, and that of curves throws.
    """
    if any(light["kind"] == "projector" or light.get("texture") for light in lights):
        return [light for light in lights if light["kind"] not in CURVES]
    return lights


def any_light(choice, spectral):
    """A light above the floor, in it or below it, that looks anywhere."""
    kind = one_of(choice, *POSITIONED, *SHAPES, *CURVES)
    position = [*numbers(choice, 2, -1.5, 1.5), number(choice, -0.5, 2.5)]
    place = [["translate", position]]
    axis = [*numbers(choice, 2, -1, 1), 1.0]
    place.append(["rotate", axis, number(choice, -180, 180)])
    if kind in ("point", "directional"):
        direction = [*numbers(choice, 2, -1, 1), -0.5]
        light = {"kind": kind, "position": position, "direction": direction}
        emitted = radiance(choice, 1.0, spectral)
        plain = "to_uv" not in emitted
        return light | {"radiance": emitted if plain else {"kind": "uniform", "value": 1.0}}
    if kind in ("spot", "projector"):
        light = {"kind": kind, "steps": place, "value": colour(choice)}
        cutoff = number(choice, 2, 80)
        light |= {"cutoff": cutoff, "beam": round(cutoff * number(choice, 0.2, 1), 4)}
        return light | {"texture": texture(choice, 1.0) if often(choice, 5) else None}
    if kind in CURVES:
        light = {"kind": kind, "flip": False, "steps": place}
        light |= {"seed": choice.integer(0, 99), "radiance": radiance(choice, 5.0, spectral)}
    else:
        size = one_of(choice, 0.3, 0.05, 1e-3, 2.0)
        place += deformation(choice, kind, size)
        light = area_light(choice, kind, place, min(1 / size**2, 1e4), spectral)
    return light | {"surface": one_of(choice, *LAMP_SURFACES)}


def any_environment(choice, spectral, sun):
    """None, or one of them."""
    kind = one_of(choice, None, None, "constant", "envmap", *(["sunsky"] if sun else []))
    if kind == "constant":
        emitted = radiance(choice, 0.2, spectral)
        return {"kind": kind, "radiance": emitted if "to_uv" not in emitted else None}
    if kind == "envmap":
        rotation = [["rotate", [1.0, 0.0, 0.0], number(choice, -180, 180)]]
        return {"kind": kind, "seed": choice.integer(0, 99), "steps": rotation}
    return kind and {"kind": kind, "hour": number(choice, 7, 19)}


def any_medium(choice):
    """None, or fog in a box; grids may be smaller or larger than it."""
    kind = one_of(choice, None, None, "homogeneous", "equal", "smaller", "larger")
    if kind is None:
        return None
    place = one_of(choice, *PLACES)
    depth = one_of(choice, 1.0, 0.1, 10.0, 100.0)
    medium = {"kind": kind, "place": place, "border": one_of(choice, "cube", "sphere")}
    medium |= {"extinction": [float(f"{depth * c:.4g}") for c in any_coefficients(choice)]}
    medium |= {"albedo": any_coefficients(choice), "g": one_of(choice, 0.0, 0.6, -0.4)}
    if kind != "homogeneous":
        medium |= {"seed": choice.integer(0, 99), "spectral": one_of(choice, True, False)}
        medium["constant"] = often(choice, 3)
    return medium


def any_coefficients(choice):
    """Three numbers in [0, 1]: grey, one for each channel, some of them zero."""
    kind = one_of(choice, "grey", "chromatic", "zeros", "none")
    if kind == "grey":
        return 3 * [number(choice, 0.1, 1)]
    values = numbers(choice, 3, 0.05, 1)
    if kind == "zeros":
        values[choice.integer(0, 2)] = 0.0
    return values if kind != "none" else 3 * [0.0]


def any_camera(choice):
    """Sensor and sampler of eight by eight pixels."""
    return {
        "kind": one_of(choice, "perspective", "thinlens", "orthographic"),
        "crop": often(choice, 2),
        "sampler": one_of(
            choice, "independent", "stratified", "multijitter", "orthogonal", "ldsampler"
        ),
        "spp": one_of(choice, 4, 1, 16, 9),
    }


def any_integrator(choice, medium):
    """One of the two and its parameters; those that a method does not have are refused with it."""
    volpath = medium is not None or often(choice, 5)
    result = {"type": "manylights_volpath" if volpath else "manylights_direct"}
    method = one_of(choice, *METHODS)
    drawn = {"hide_emitters": often(choice, 3), "counts": often(choice, 1)}
    if method in ("resampled_tree", "talk"):
        shadow_rays = choice.integer(1, 6)
        drawn |= {"shadow_rays": shadow_rays, "reservoirs": choice.integer(shadow_rays, 16)}
    if method in ("resampled_tree", "talk", "adaptive_splitting"):
        drawn["splitting_rate"] = one_of(choice, 1.0, 0.0, 0.3, 4.0, "inf")
    if method == "resampled_tree":
        drawn["learn_visibility"] = one_of(choice, True, False, "keep")
    if method == "talk":
        drawn["split_function"] = one_of(choice, "near", "far")
    if volpath:
        drawn |= {"max_depth": one_of(choice, 2, 1, 3, 6, -1), "rr_depth": choice.integer(1, 5)}
    else:
        drawn["bsdf_samples"] = choice.integer(0, 2)
    kept = {key: value for key, value in drawn.items() if often(choice, 6)}
    if "reservoirs" not in kept and kept.get("shadow_rays", 0) > 1:
        del kept["shadow_rays"]
    return result | {"method": method} | kept
