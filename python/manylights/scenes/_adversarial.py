"""Scenes that are hard for a light tree: where its bounds say little or its numbers get extreme."""

from __future__ import annotations

import numpy as np

from manylights.errors import is_real
from manylights.scenes import _build as build


def coincident(
    n_lights: int = 1000, *, width: int = 96, height: int = 64, spp: int = 16, **options
) -> dict:
    """All point lights at the same place: no plane separates them, no bound is smaller.

    Args:
        n_lights: number of point lights, 1 to 1,000,000; the total intensity is 20 W sr^-1.
        width, height: of the image in pixels.
        spp: samples per pixel.
        options: ``integrator`` and ``seed``, as for every generator.
    """
    n_lights = build.check_count(n_lights)
    rng = build.random(options.pop("seed", 0))
    weight = build.log_uniform(rng, n_lights, 1.0, 2.0)
    lights = [
        build.point([0.5, 0.3, 2.0], value)
        for value in (20.0 * weight / weight.sum())[:, None] * np.array(build.WARM)
    ]
    return _stage(lights, width, height, spp, **options)


def bright_far(
    n_lights: int = 1000, *, width: int = 96, height: int = 64, spp: int = 16, **options
) -> dict:
    """One bright light far away among weak ones near the objects.

    The far light gives about half of the light in the picture, with more than 99.9 % of the power.

    Args:
        n_lights: number of point lights, 2 to 1,000,000, the last one is the far one.
        width, height: of the image in pixels.
        spp: samples per pixel.
        options: ``integrator`` and ``seed``, as for every generator.
    """
    n_lights = build.check_count(n_lights, least=2)
    rng = build.random(options.pop("seed", 0))
    near = n_lights - 1
    position = rng.uniform([-4.0, -3.0, 0.8], [4.0, 4.0, 2.5], (near, 3))
    lights = [build.point(place, 12.0 / near * np.array(build.WARM)) for place in position]
    lights.append(build.point([300.0, -200.0, 400.0], 4e5 * np.array(build.COOL)))
    return _stage(lights, width, height, spp, **options)


def behind_wall(
    n_lights: int = 1000, *, width: int = 96, height: int = 64, spp: int = 16, **options
) -> dict:
    """All lights but one in a hundred, and at least one, are behind a wall.

    The hidden ones are brighter and as near as the others: importance without visibility prefers
    them everywhere.

    Args:
        n_lights: number of point lights, 1 to 1,000,000.
        width, height: of the image in pixels.
        spp: samples per pixel.
        options: ``integrator`` and ``seed``, as for every generator.
    """
    n_lights = build.check_count(n_lights)
    rng = build.random(options.pop("seed", 0))
    seen = max(n_lights // 100, 1)
    front = rng.uniform([-3.0, -2.0, 1.5], [3.0, 2.0, 3.0], (seen, 3))
    back = rng.uniform([-4.0, 3.3, 0.3], [4.0, 5.0, 3.5], (n_lights - seen, 3))
    lights = [build.point(place, 14.0 / seen * np.array(build.WARM)) for place in front]
    lights += [build.point(place, np.array(build.COOL)) for place in back]
    build.require_variant()
    wall = build.boxes("wall", [[-14.0, 3.0, 0.0]], [[14.0, 3.15, 14.0]], [[0.6, 0.6, 0.6]])
    return _stage(lights, width, height, spp, extra={"wall": wall}, **options)


def narrow_spots(
    n_lights: int = 1000,
    *,
    cutoff: float = 5.0,
    width: int = 96,
    height: int = 64,
    spp: int = 16,
    **options,
) -> dict:
    """Spot lights with narrow cones that look down: few of many reach a point.

    Args:
        n_lights: number of spot lights, 1 to 1,000,000.
        cutoff: half angle of the cones in degrees, above 0, below 90.
        width, height: of the image in pixels.
        spp: samples per pixel.
        options: ``integrator`` and ``seed``, as for every generator.
    """
    n_lights = build.check_count(n_lights)
    allowed = is_real(cutoff) and 0.0 < cutoff < 90.0
    build.check("cutoff", cutoff, allowed, "above 0 and below 90")
    rng = build.random(options.pop("seed", 0))
    position = rng.uniform([-5.0, -4.0, 3.5], [5.0, 6.0, 4.5], (n_lights, 3))
    direction = rng.normal(0.0, 0.15, (n_lights, 3)) - np.array([0.0, 0.0, 1.0])
    covered = n_lights * (np.tan(np.radians(cutoff)) * 4.0) ** 2 * np.pi / 100.0
    intensity = 40.0 / max(covered, 1.0) * build.pick(rng, (build.WHITE, *build.NEON), n_lights)
    lights = [build.spot(*item, cutoff=cutoff) for item in zip(position, direction, intensity)]
    return _stage(lights, width, height, spp, **options)


def on_emitter(*, width: int = 96, height: int = 64, spp: int = 16, **options) -> dict:
    """Two lamps that light themselves: their shading points lie on the emitters.

    The upright lamp and the flat one share an edge, both reflect, and a third lies in the plane of
    the flat one: distances and angles of zero occur. Six emissive triangles.

    Args:
        width, height: of the image in pixels.
        spp: samples per pixel.
        options: ``integrator`` and ``seed``, as for every generator.
    """
    options.pop("seed", None)
    build.require_variant()
    white = build.diffuse(0.6)
    frames = (
        ((-2.0, 0.0, 0.02), (2.0, 0.0, 0.0), (0.0, 1.5, 0.0), (2.4, 1.5, 0.9)),
        ((-2.0, 1.5, 0.02), (2.0, 0.0, 0.0), (0.0, 0.0, 1.2), (0.7, 1.1, 2.0)),
        ((0.6, 0.0, 0.02), (1.0, 0.0, 0.0), (0.0, 1.5, 0.0), (1.4, 0.3, 1.1)),
    )
    lights = [
        build.rectangle(corner, u, v, bsdf=white, radiance=radiance)
        for corner, u, v, radiance in frames
    ]
    return _stage(lights, width, height, spp, **options)


def twelve_decades(
    n_lights: int = 1000, *, width: int = 96, height: int = 64, spp: int = 16, **options
) -> dict:
    """Point lights whose intensities span twelve decades: sums in single precision lose some.

    Args:
        n_lights: number of point lights, 1 to 1,000,000.
        width, height: of the image in pixels.
        spp: samples per pixel.
        options: ``integrator`` and ``seed``, as for every generator.
    """
    n_lights = build.check_count(n_lights)
    rng = build.random(options.pop("seed", 0))
    position = rng.uniform([-4.0, -3.0, 0.4], [4.0, 4.0, 3.0], (n_lights, 3))
    decade = -12.0 * (np.arange(n_lights) / max(n_lights - 1, 1))
    intensity = 10.0 ** rng.permutation(decade)[:, None] * np.array(build.WHITE)
    lights = [build.point(*item) for item in zip(position, 25.0 * intensity / intensity.sum(0))]
    return _stage(lights, width, height, spp, **options)


def cut_boundary(
    n_lights: int = 300,
    *,
    seed: int = 0,
    width: int = 160,
    height: int = 90,
    spp: int = 16,
    integrator="manylights_direct",
) -> dict:
    """A floor under three clusters of points in a row, where neighbouring pixels see other trees.

    A traversal that splits clusters by a rule, without random numbers, considers other lights on
    one side of a line than on the other, and the noise changes there at once. The picture shows a
    strip of the floor from above, 16 m long and so narrow that nothing changes along the columns
    but the noise: the standard deviation along a column shows such lines as steps.

    Args:
        n_lights: number of point lights, 1 to 1,000,000; the total intensity is 30 W sr^-1.
        seed: of the random numbers.
        width, height: of the image in pixels.
        spp: samples per pixel.
        integrator: name of a plugin, or its dictionary.
    """
    n_lights = build.check_count(n_lights)
    rng = build.random(seed)
    cluster = np.arange(n_lights) % 3
    position = rng.uniform([-0.8, -0.8, 0.8], [0.8, 0.8, 1.6], (n_lights, 3))
    position[:, 0] += np.array([-5.0, 0.0, 5.0])[cluster]
    weight = build.log_uniform(rng, n_lights, 1.0, 1.0)
    colors = np.array([build.WARM, build.WHITE, build.COOL])[cluster]
    intensity = (30.0 * weight / weight.sum())[:, None] * colors
    lights = [build.point(*item) for item in zip(position, intensity)]
    sensor = build.camera([0, 0, 4], [0, 0, 0], width=width, height=height, spp=spp, up=(0, 1, 0))
    del sensor["fov"]
    # The height scales, too: half a millimetre of floor from the first row to the last.
    narrow = build.mi.ScalarTransform4f().scale([8.0, 2.5e-4 * width / height, 1.0])
    sensor.update(type="orthographic", to_world=sensor["to_world"] @ narrow)
    floor = build.rectangle([-15, -15, 0], [30, 0, 0], [0, 30, 0], bsdf=build.diffuse(0.5))
    return build.scene(integrator, sensor, {"floor": floor, **build.numbered("light", lights)})


def _stage(
    lights: list, width: int, height: int, spp: int, *, integrator="manylights_direct", extra=None
) -> dict:
    """Return a floor, a cube and a sphere with the given lights."""
    floor = build.rectangle([-15, -15, 0], [30, 0, 0], [0, 30, 0], bsdf=build.diffuse(0.5))
    to_world = build.mi.ScalarTransform4f().translate([-1.6, 0.6, 0.7]).rotate([0, 0, 1], 30)
    parts = {
        "floor": floor,
        "cube": {
            "type": "cube",
            "to_world": to_world.scale(0.7),
            "bsdf": build.diffuse((0.6, 0.3, 0.2)),
        },
        "sphere": {
            "type": "sphere",
            "center": [1.4, 0.4, 0.8],
            "radius": 0.8,
            "bsdf": {"type": "roughconductor", "material": "Al", "alpha": 0.25},
        },
        **(extra or {}),
        **build.numbered("light", lights),
    }
    sensor = build.camera(
        [0.0, -7.5, 3.2], [0.0, 0.4, 0.6], width=width, height=height, spp=spp, fov=48.0
    )
    return build.scene(integrator, sensor, parts)
