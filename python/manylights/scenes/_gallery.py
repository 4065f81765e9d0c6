"""Plain scenes with many lights: strings of bulbs, an open plane, rooms, metal."""

from __future__ import annotations

import numpy as np

from manylights.errors import is_real
from manylights.scenes import _build as build
from manylights.scenes._build import Quads

#: Metres: the side of a room, its height, half the width of a door and its height.
ROOM, CEILING, DOOR_HALF, DOOR_HEIGHT = 5.0, 3.0, 0.7, 2.2


def bulbs(
    n_lights: int = 1000,
    *,
    kind: str = "points",
    seed: int = 0,
    width: int = 256,
    height: int = 144,
    spp: int = 16,
    integrator="manylights_direct",
) -> dict:
    """Strings of coloured bulbs that sag over a square with stalls and pillars.

    The total power does not depend on the number of bulbs; single powers span two decades.

    Args:
        n_lights: number of bulbs, 1 to 1,000,000.
        kind: ``points``, or ``spheres`` of 3 cm radius with area lights.
        seed: of the random numbers.
        width, height: of the image in pixels.
        spp: samples per pixel.
        integrator: name of a plugin, or its dictionary.
    """
    n_lights = build.check_count(n_lights)
    if kind not in ("points", "spheres"):
        raise ValueError(f"kind={kind!r}: choose from points, spheres")
    build.require_variant()
    rng = build.random(seed)
    position = _strings(rng, n_lights)
    weight = build.log_uniform(rng, n_lights, 1.0, 2.0)
    colors = build.pick(rng, (build.WARM, build.WARM, build.WHITE, *build.NEON), n_lights)
    intensity = (220.0 * weight / weight.sum())[:, None] * colors
    if kind == "points":
        lights = [build.point(*item) for item in zip(position, intensity)]
    else:
        lights = [_glowing_sphere(*item) for item in zip(position, intensity)]
    low, high = _stalls(rng)
    tints = rng.uniform(0.15, 0.7, (len(low), 3))
    parts = {
        "ground": _ground(30.0, build.diffuse((0.32, 0.3, 0.28))),
        "stalls": build.boxes("stalls", low, high, tints),
        **build.numbered("bulb", lights),
    }
    sensor = build.camera(
        [0.0, -17.0, 6.0], [0.0, 1.0, 0.8], width=width, height=height, spp=spp, fov=58.0
    )
    return build.scene(integrator, sensor, parts)


def open_plane(
    n_lights: int = 1000,
    *,
    seed: int = 0,
    width: int = 256,
    height: int = 144,
    spp: int = 16,
    integrator="manylights_direct",
) -> dict:
    """Point lights close above an empty plane: nothing is hidden, distance alone decides.

    Args:
        n_lights: number of point lights, 1 to 1,000,000; total power and area stay the same.
        seed: of the random numbers.
        width, height: of the image in pixels.
        spp: samples per pixel.
        integrator: name of a plugin, or its dictionary.
    """
    n_lights = build.check_count(n_lights)
    rng = build.random(seed)
    position = np.concatenate(
        [rng.uniform(-20.0, 20.0, (n_lights, 2)), rng.uniform(0.3, 1.5, (n_lights, 1))], axis=1
    )
    weight = build.log_uniform(rng, n_lights, 1.0, 2.0)
    intensity = (900.0 * weight / weight.sum())[:, None]
    intensity = intensity * build.pick(rng, (build.WARM, build.COOL, *build.NEON), n_lights)
    lights = [build.point(*item) for item in zip(position, intensity)]
    parts = {"ground": _ground(40.0, build.diffuse(0.5)), **build.numbered("light", lights)}
    sensor = build.camera(
        [0.0, -24.0, 9.0], [0.0, -3.0, 0.0], width=width, height=height, spp=spp, fov=60.0
    )
    return build.scene(integrator, sensor, parts)


def rooms(
    n_lights: int = 1000,
    *,
    per_room: int = 4,
    seed: int = 0,
    width: int = 256,
    height: int = 144,
    spp: int = 16,
    integrator="manylights_direct",
    texture: bool = False,
) -> dict:
    """Rooms in a square grid, each with doors to its neighbours and lamps on the ceiling.

    The lamps are triangles of one mesh. Only those of the room that the camera is in, and few more
    through the doors, are visible: bounds without visibility are all a light tree has.

    Args:
        n_lights: number of emissive triangles, 1 to 1,000,000; decides the number of rooms.
        per_room: lamps of a room, two triangles each, at least 1.
        seed: of the random numbers.
        width, height: of the image in pixels.
        spp: samples per pixel.
        integrator: name of a plugin, or its dictionary. For light that comes through the doors
            after several bounces: ``{"type": "manylights_volpath", "max_depth": 6}``.
        texture: store the radiance in a texture instead of a face attribute: Mitsuba's own emitter
            sampling handles that one only. Default: False.
    """
    n_lights = build.check_count(n_lights)
    build.check_integer("per_room", per_room, 1)
    build.require_variant()
    rng = build.random(seed)
    count = (n_lights + 1) // 2
    side = int(np.ceil(np.sqrt(-(-count // per_room))))
    low, high = _walls(side)
    parts = {
        "walls": build.boxes("walls", low, high, np.full((len(low), 3), 0.62)),
        "floor": build.rectangle(
            [0, 0, 0], [side * ROOM, 0, 0], [0, side * ROOM, 0], bsdf=build.diffuse(0.4)
        ),
        "ceiling": build.rectangle(
            [0, 0, CEILING], [0, side * ROOM, 0], [side * ROOM, 0, 0], bsdf=build.diffuse(0.7)
        ),
        "lights": build.glowing_mesh(
            _ceiling_lamps(rng, count, side, per_room), n_lights, texture=texture
        ),
    }
    # The first room is lit even if there is a single light.
    sensor = build.camera(
        [0.4, 0.4, 1.7],
        [0.5 * ROOM, 0.55 * ROOM, 1.35],
        width=width,
        height=height,
        spp=spp,
        fov=85.0,
    )
    return build.scene(integrator, sensor, parts)


def glossy(
    n_lights: int = 1000,
    *,
    roughness: float = 0.15,
    seed: int = 0,
    width: int = 256,
    height: int = 144,
    spp: int = 16,
    integrator="manylights_direct",
    texture: bool = False,
) -> dict:
    """Rough metal spheres and a rough metal floor under a canopy of small lamps.

    Args:
        n_lights: number of emissive triangles, 1 to 1,000,000; total power stays the same.
        roughness: GGX ``alpha`` of all metals, above 0; small values make sharp reflections.
        seed: of the random numbers.
        width, height: of the image in pixels.
        spp: samples per pixel.
        integrator: name of a plugin, or its dictionary.
        texture: store the radiance in a texture instead of a face attribute: Mitsuba's own emitter
            sampling handles that one only. Default: False.
    """
    n_lights = build.check_count(n_lights)
    allowed = is_real(roughness) and 0.0 < roughness <= 1.0
    build.check("roughness", roughness, allowed, "above 0 and at most 1")
    build.require_variant()
    rng = build.random(seed)
    count = (n_lights + 1) // 2
    center = rng.uniform([-9.0, -7.0, 5.0], [9.0, 12.0, 6.5], (count, 3))
    edge = np.sqrt(30.0 / count) * rng.uniform(0.15, 0.3, count)[:, None]
    u, v = edge * np.array([0.0, 1.0, 0.0]), edge * np.array([1.0, 0.0, 0.0])
    power = build.log_uniform(rng, count, 60.0, 2.0)[:, None]
    colors = build.pick(rng, (build.WARM, build.WHITE, *build.NEON), count)
    lamps = Quads(center - 0.5 * (u + v), u, v, power * colors)
    metals = ("Au", "Cu", "Al", "Cr", "W")
    spheres = [
        {
            "type": "sphere",
            "center": [3.0 * (index - 2), 1.2 * (index % 2), 1.3],
            "radius": 1.3,
            "bsdf": _metal(name, roughness),
        }
        for index, name in enumerate(metals)
    ]
    parts = {
        "floor": _ground(14.0, _metal("Al", roughness)),
        **build.numbered("sphere", spheres),
        "lights": build.glowing_mesh(lamps, n_lights, texture=texture),
    }
    sensor = build.camera(
        [0.0, -13.0, 3.4], [0.0, 0.0, 1.2], width=width, height=height, spp=spp, fov=55.0
    )
    return build.scene(integrator, sensor, parts)


def _ground(half: float, bsdf: dict) -> dict:
    """Return a square of side 2 ``half`` around the origin, facing up."""
    return build.rectangle([-half, -half, 0], [2 * half, 0, 0], [0, 2 * half, 0], bsdf=bsdf)


def _metal(name: str, roughness: float) -> dict:
    return {
        "type": "roughconductor",
        "material": name,
        "distribution": "ggx",
        "alpha": float(roughness),
    }


def _glowing_sphere(position, intensity) -> dict:
    """Return a sphere of 3 cm radius with the flux of a point light of that intensity."""
    radius = 0.03
    radiance = np.asarray(intensity) / (np.pi * radius**2)
    return {
        "type": "sphere",
        "center": [float(x) for x in position],
        "radius": radius,
        "bsdf": build.diffuse(0.0),
        "emitter": {"type": "area", "radiance": build.rgb(radiance)},
    }


def _strings(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return ``count`` places on sagging strings between two rows of masts, shape (count, 3)."""
    strings = int(np.clip(np.sqrt(count), 1, 40))
    string = np.arange(count) % strings
    share = (np.arange(count) // strings + rng.uniform(0.2, 0.8, count)) / -(-count // strings)
    y = -9.0 + 22.0 * (string + 0.5) / strings
    sag = 1.2 * (1.0 - (2.0 * share - 1.0) ** 2)
    z = 4.3 - sag + 0.3 * np.sin(1.7 * string)
    return np.stack([-11.0 + 22.0 * share, y, z], axis=1)


def _stalls(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of boxes and pillars on the square, each of shape (b, 3)."""
    place = np.stack(np.meshgrid([-8.5, -4.5, 4.5, 8.5], [-6.0, -1.0, 4.0, 9.0]), axis=-1)
    place = place.reshape(-1, 2) + rng.uniform(-0.6, 0.6, (16, 2))
    half = rng.uniform(0.6, 1.2, (16, 2))
    tall = rng.uniform(0.7, 2.0, (16, 1))
    pillars = np.array([[-2.0, 0.0], [2.0, 5.0], [-1.5, 9.0], [1.8, -5.0]])
    place = np.concatenate([place, pillars])
    half = np.concatenate([half, np.full((4, 2), 0.2)])
    tall = np.concatenate([tall, np.full((4, 1), 3.0)])
    low = np.concatenate([place - half, np.zeros_like(tall)], axis=1)
    return low, np.concatenate([place + half, tall], axis=1)


def _walls(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the boxes of all walls of ``side`` x ``side`` rooms; inner walls have a door."""
    half, end = 0.06, 0.5 * ROOM - DOOR_HALF
    pieces = [(0.0, end, 0.0), (ROOM - end, ROOM, 0.0), (end, ROOM - end, DOOR_HEIGHT)]
    line, cell = (a.ravel() for a in np.meshgrid(np.arange(side + 1), np.arange(side)))
    inner = (line > 0) & (line < side)
    lows, highs = [], []
    for axis in (0, 1):
        for start, stop, bottom in pieces:
            # The middle piece of an outer wall closes the door.
            base = np.where(inner, bottom, 0.0)
            across, along = line * ROOM, cell * ROOM
            low = np.stack([across - half, along + start, base], axis=1)
            high = np.stack([across + half, along + stop, np.full(len(line), CEILING)], axis=1)
            order = [0, 1, 2] if axis == 0 else [1, 0, 2]
            lows.append(low[:, order])
            highs.append(high[:, order])
    return np.concatenate(lows), np.concatenate(highs)


def _ceiling_lamps(rng: np.random.Generator, count: int, side: int, per_room: int) -> Quads:
    """Return ``count`` lamps of 0.3 m x 0.3 m just below the ceilings, room after room."""
    room = np.arange(count) // per_room
    place = np.stack([room % side, room // side], axis=1) * ROOM
    place = place + rng.uniform(0.6, ROOM - 0.6, (count, 2))
    center = np.concatenate([place, np.full((count, 1), CEILING - 0.02)], axis=1)
    u, v = np.array([0.0, 0.3, 0.0]), np.array([0.3, 0.0, 0.0])
    power = build.log_uniform(rng, count, 200.0 / per_room, 1.0)[:, None]
    colors = build.pick(rng, (build.WARM, build.WHITE, build.COOL), count)
    shape = (count, 3)
    corner = center - 0.5 * (u + v)
    return Quads(corner, np.broadcast_to(u, shape), np.broadcast_to(v, shape), power * colors)
