"""A city at night: blocks of buildings, streets, and lights of which most are hidden from most
places."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from manylights.scenes import _build as build
from manylights.scenes._build import Quads
from manylights.scenes._city_lights import (
    BLOCK,
    PITCH,
    Layout,
    along_streets,
    layout_for,
    lights,
    place_cars,
    side_of,
)

KINDS = ("mesh", "points", "spots", "quads", "mixed")


def city(
    n_lights: int = 20000,
    *,
    kind: str = "mesh",
    seed: int = 0,
    width: int = 640,
    height: int = 360,
    spp: int = 64,
    integrator: str | Mapping = "manylights_direct",
    texture: bool = False,
) -> dict:
    """A street in a city at night, seen from above the roadway.

    Windows, street lamps, signs and car lights shine with powers over three decades. Streets are
    separated by buildings, so most lights do not reach most points.

    Args:
        n_lights: number of lights, 1 to 1,000,000. Beyond about 100,000 the windows get smaller.
            It counts the triangles for ``mesh``, where each is a light of its own; emitters for
            the other kinds. A ``quads`` emitter is a rectangle and has two triangles.
        kind: ``mesh``: one emissive mesh with a radiance for each face; ``points``, ``spots`` and
            ``quads``: separate emitters of that kind; ``mixed``: street lamps as spots, car
            lights as points, windows, shops and signs as one mesh.
        seed: of the random numbers; the same seed gives the same city.
        width, height: of the image in pixels.
        spp: samples per pixel.
        integrator: name of a plugin, or its dictionary.
        texture: store the radiance of ``mesh`` in a texture instead of a face attribute: Mitsuba's
            own emitter sampling handles that one only. Default: False.

    Raises:
        ValueError: ``n_lights`` or ``kind`` out of range.
        RuntimeError: no variant is set.
    """
    build.require_variant()
    n_lights = build.check_count(n_lights)
    if kind not in KINDS:
        raise ValueError(f"kind={kind!r}: choose from {', '.join(KINDS)}")
    rng = build.random(seed)
    wanted = _quads_for(n_lights, kind)
    layout = layout_for(rng, wanted)
    groups, dark = lights(rng, layout, wanted)
    parts = _surroundings(rng, layout, dark)
    if kind == "mixed":
        parts.update(_mixed(groups, n_lights))
    else:
        joined = Quads.join(list(groups.values()))
        parts.update(_as_kind(joined, kind, n_lights, texture))
    sensor = build.camera(
        origin=[2.2, -layout.half - 4.0, 4.6],
        target=[-0.6, -layout.half + 60.0, 8.2],
        fov=64.0,
        width=width,
        height=height,
        spp=spp,
    )
    return build.scene(integrator, sensor, parts)


def _surroundings(rng: np.random.Generator, layout: Layout, dark: Quads) -> dict:
    """Return buildings, pavements, the wet street, poles, cars and the dark windows."""
    count = len(layout.low)
    tints = build.pick(rng, ((0.50, 0.42, 0.36), (0.42, 0.42, 0.45), (0.36, 0.30, 0.27)), count)
    tints = tints * rng.uniform(0.75, 1.15, (count, 1))
    blocks = (np.arange(layout.blocks) - 0.5 * layout.blocks + 0.5) * PITCH
    x, y = (array.ravel() for array in np.meshgrid(blocks, blocks, indexing="ij"))
    middle = np.stack([x, y, np.zeros_like(x)], axis=1)
    edge = np.array([0.5 * BLOCK, 0.5 * BLOCK, 0.16])
    reach = layout.half + 150.0
    parts = {
        "buildings": build.boxes("buildings", layout.low, layout.high, tints),
        "pavements": build.boxes(
            "pavements", middle - edge, middle + edge, np.full((len(x), 3), 0.22)
        ),
        "furniture": _furniture(layout),
        "street": build.rectangle(
            [-reach, -reach, 0], [2 * reach, 0, 0], [0, 2 * reach, 0], bsdf=_wet_asphalt()
        ),
    }
    if len(dark):
        vertices, faces = build.quad_arrays(dark)
        parts["dark_windows"] = build.mesh("dark_windows", vertices, faces, bsdf=_dark_glass())
    return parts


def _furniture(layout: Layout):
    """Make one mesh of the poles of the street lamps and the bodies and cabins of the cars."""
    position, forward = place_cars(layout)
    reach = 2.1 * np.abs(forward) + 0.85 * np.abs(side_of(forward))
    bottom, top = np.array([0.0, 0.0, 0.3]), np.array([0.0, 0.0, 0.95])
    roof = np.array([0.0, 0.0, 1.45])
    middle, direction = along_streets(layout, 17.0)
    poles = np.concatenate([middle + side * 5.1 * side_of(direction) for side in (-1.0, 1.0)])
    thick = np.array([0.07, 0.07, 0.0])
    low = [position - reach + bottom, position - 0.6 * reach + top, poles - thick]
    high = [position + reach + top, position + 0.6 * reach + roof, poles + thick + [0, 0, 6.6]]
    colors = np.concatenate([np.full((2 * len(position), 3), 0.12), np.full((len(poles), 3), 0.2)])
    return build.boxes("furniture", np.concatenate(low), np.concatenate(high), colors)


def _wet_asphalt() -> dict:
    return {
        "type": "roughplastic",
        "diffuse_reflectance": build.rgb((0.055, 0.055, 0.06)),
        "distribution": "ggx",
        "int_ior": 1.5,
        "alpha": 0.13,
    }


def _dark_glass() -> dict:
    return {
        "type": "roughplastic",
        "diffuse_reflectance": build.rgb((0.015, 0.017, 0.02)),
        "distribution": "ggx",
        "alpha": 0.1,
    }


def _quads_for(n_lights: int, kind: str) -> int:
    """Return how many quads of all sorts make at least ``n_lights`` lights."""
    if kind == "mesh":
        return (n_lights + 1) // 2
    if kind == "mixed":
        # At most 8/60 of the quads are lamps and cars, one light each; the others are two.
        return -(-n_lights * 10 // 18) + 2
    return n_lights


def _mixed(groups: dict[str, Quads], n_lights: int) -> dict:
    """Lamps as spots, car lights as points, the rest as a mesh: ``n_lights`` in all."""
    lamps = groups["lamps"].first(n_lights)
    cars = groups["cars"].first(n_lights - len(lamps))
    parts = {**_as_kind(lamps, "spots"), **_as_kind(cars, "points")}
    rest = Quads.join([groups[name] for name in ("signs", "shops", "windows")])
    triangles = n_lights - len(lamps) - len(cars)
    if triangles:
        parts["windows"] = build.glowing_mesh(rest, triangles, name="windows")
    return parts


def _as_kind(lights: Quads, kind: str, triangles: int = 0, texture: bool = False) -> dict:
    """Return the lights as emitters of one kind, of the same radiant flux as the quads."""
    if kind == "mesh":
        return {"lights": build.glowing_mesh(lights, triangles, texture=texture)}
    normal, center = lights.scaled_normal(), lights.center()
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    position = center + 0.15 * normal / area
    if kind == "points":
        # A diffuse quad sends out pi L A, a point light 4 pi I.
        intensity = 0.25 * lights.radiance * area
        items = [build.point(*item) for item in zip(position, intensity)]
    elif kind == "spots":
        # About the flux of the quad in a cone of 60 degrees, of solid angle pi.
        items = [build.spot(*item) for item in zip(position, normal, lights.radiance * area)]
    else:
        black = build.diffuse(0.0)
        items = [
            build.rectangle(corner, u, v, bsdf=black, radiance=radiance)
            for corner, u, v, radiance in zip(lights.corner, lights.u, lights.v, lights.radiance)
        ]
    return build.numbered(kind, items)
