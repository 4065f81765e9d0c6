"""Scenes in fog: light is scattered between lamps and surfaces, and most of what is seen is air.

The fog is a homogeneous medium in a box without a surface of its own (BSDF ``null``). The camera
and all lights are inside. Mitsuba's own ``volpath`` renders these scenes, too, as long as their
emission is not stored in a face attribute (see ``texture``).
"""

from __future__ import annotations

import numpy as np

from manylights.errors import is_real
from manylights.scenes import _build as build
from manylights.scenes._build import Quads
from manylights.scenes._city import city
from manylights.scenes._gallery import rooms

#: Of the light that meets a droplet, this share goes on in another direction.
ALBEDO = 0.95

#: Metres: where the rows of lamps of the open field are, how long they are.
ROWS, DEPTH = (-18.0, -12.0, -6.0, 6.0, 12.0, 18.0), 60.0


def fog_open(
    n_lights: int = 1000,
    *,
    kind: str = "points",
    mean_free_path: float = 30.0,
    g: float = 0.0,
    seed: int = 0,
    width: int = 256,
    height: int = 144,
    spp: int = 16,
    integrator="manylights_volpath",
    texture: bool = False,
) -> dict:
    """Rows of lamps, each of its colour, among standing stones in the open air, in a layer of fog.

    Args:
        n_lights: number of lights, 1 to 1,000,000; total power and area stay the same.
        kind: ``points``, or ``mesh``: triangles of one mesh that shine down, in pairs. The air
            close to a point is bright without bound: Mitsuba's ``volpath`` gets bright pixels
            there, and comparisons of means need ``mesh``.
        mean_free_path: of light in the fog, in metres, above 0.
        g: mean cosine of the angle by which droplets scatter, above -1, below 1; 0 is isotropic.
        seed: of the random numbers.
        width, height: of the image in pixels.
        spp: samples per pixel.
        integrator: name of a plugin, or its dictionary.
        texture: store the radiance of ``mesh`` in a texture instead of a face attribute: Mitsuba's
            own emitter sampling handles that one only. Default: False.
    """
    n_lights = build.check_count(n_lights)
    if kind not in ("points", "mesh"):
        raise ValueError(f"kind={kind!r}: choose from points, mesh")
    build.require_variant()
    rng = build.random(seed)
    count = n_lights if kind == "points" else (n_lights + 1) // 2
    row = rng.integers(len(ROWS), size=count)
    position = rng.uniform([-0.5, 0.0, 0.4], [0.5, DEPTH, 2.2], (count, 3))
    position[:, 0] += np.array(ROWS)[row]
    weight = build.log_uniform(rng, count, 1.0, 1.0)
    colors = np.array([build.WARM, *build.NEON])[row % 6]
    intensity = (700.0 * weight / weight.sum())[:, None] * colors
    if kind == "points":
        lamps = build.numbered("lamp", [build.point(*item) for item in zip(position, intensity)])
    else:
        quads = _shining_down(position, intensity)
        lamps = {"lamps": build.glowing_mesh(quads, n_lights, name="lamps", texture=texture)}
    parts = {
        "ground": build.rectangle(
            [-100, -40, 0], [200, 0, 0], [0, 140, 0], bsdf=build.diffuse((0.3, 0.32, 0.25))
        ),
        "stones": _stones(rng),
        **lamps,
    }
    sensor = build.camera(
        [0.0, -9.0, 3.4], [0.0, 20.0, 1.2], width=width, height=height, spp=spp, fov=60.0
    )
    low, high = [-60.0, -20.0, -1.0], [60.0, DEPTH + 30.0, 12.0]
    return _in_fog(build.scene(integrator, sensor, parts), low, high, mean_free_path, g)


def fog_street(
    n_lights: int = 20000,
    *,
    mean_free_path: float = 50.0,
    g: float = 0.0,
    integrator="manylights_volpath",
    **options,
) -> dict:
    """The street of ``city`` in fog.

    Args:
        n_lights: number of lights, as for ``city``.
        mean_free_path: of light in the fog, in metres, above 0.
        g: mean cosine of the angle by which droplets scatter, above -1, below 1; 0 is isotropic.
        integrator: name of a plugin, or its dictionary.
        options: all others of ``city``. With ``kind="mesh"``, Mitsuba's integrators need
            ``texture=True``.
    """
    description = city(n_lights, integrator=integrator, **options)
    box = description["buildings"].bbox()
    around = np.array([40.0, 40.0, 10.0])
    return _in_fog(description, box.min - around, box.max + around, mean_free_path, g)


def fog_rooms(
    n_lights: int = 1000,
    *,
    mean_free_path: float = 10.0,
    g: float = 0.0,
    integrator="manylights_volpath",
    **options,
) -> dict:
    """The rooms of ``rooms`` full of fog, which light enters through the doors.

    Args:
        n_lights: number of emissive triangles, as for ``rooms``.
        mean_free_path: of light in the fog, in metres, above 0.
        g: mean cosine of the angle by which droplets scatter, above -1, below 1; 0 is isotropic.
        integrator: name of a plugin, or its dictionary.
        options: all others of ``rooms``. Mitsuba's integrators need ``texture=True``.
    """
    description = rooms(n_lights, integrator=integrator, **options)
    box = description["walls"].bbox()
    return _in_fog(description, box.min - 1.0, box.max + 1.0, mean_free_path, g)


def _in_fog(description: dict, low, high, mean_free_path: float, g: float) -> dict:
    """Return the scene with a box of fog, given by two corners, around the camera."""
    allowed = is_real(mean_free_path) and mean_free_path > 0.0
    build.check("mean_free_path", mean_free_path, allowed, "above 0")
    build.check("g", g, is_real(g) and -1.0 < g < 1.0, "above -1 and below 1")
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    center, half = 0.5 * (low + high), 0.5 * (high - low)
    fog = {"type": "ref", "id": "fog"}
    return {
        **description,
        "fog": {
            "type": "homogeneous",
            "sigma_t": 1.0 / mean_free_path,
            "albedo": ALBEDO,
            "phase": {"type": "hg", "g": g} if g else {"type": "isotropic"},
            # Grey fog: one free flight serves all colours.
            "has_spectral_extinction": False,
        },
        "sensor": {**description["sensor"], "medium": fog},
        "fog_box": {
            "type": "cube",
            "to_world": build.mi.ScalarTransform4f().translate(center).scale(half),
            "bsdf": {"type": "null"},
            "interior": fog,
        },
    }


def _shining_down(position: np.ndarray, intensity: np.ndarray) -> Quads:
    """Return squares with the flux of point lights; the area of all of them is 5 square metres."""
    shape = position.shape
    edge = np.sqrt(5.0 / len(position))
    u = np.broadcast_to([0.0, edge, 0.0], shape)
    v = np.broadcast_to([edge, 0.0, 0.0], shape)
    # A diffuse square sends out pi L A, a point light 4 pi I.
    return Quads(position - 0.5 * (u + v), u, v, 4.0 * intensity / edge**2)


def _stones(rng: np.random.Generator):
    """Make one mesh of upright slabs on a loose grid, narrow enough to see past them."""
    x, y = np.meshgrid(np.arange(-20.0, 21.0, 8.0), np.arange(6.0, 60.0, 9.0))
    place = np.stack([x, y], axis=-1).reshape(-1, 2)
    place += rng.uniform(-2.5, 2.5, place.shape)
    half = rng.uniform(0.3, 0.8, place.shape)
    tall = rng.uniform(1.5, 4.5, (len(place), 1))
    low = np.concatenate([place - half, np.zeros_like(tall)], axis=1)
    high = np.concatenate([place + half, tall], axis=1)
    return build.boxes("stones", low, high, np.full((len(place), 3), 0.5))
