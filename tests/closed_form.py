"""Exact pixel values of a diffuse plane and of fog under point and spot lights, by quadrature.

Nothing here calls Mitsuba, only numpy: the camera, the lights' emission, reflection and scattering
are written down again, so that a mistake in reading the scene shows as well as one in the sampling.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Camera:
    """Perspective camera whose field of view refers to the width, with a box filter of a pixel."""

    origin: tuple
    target: tuple
    up: tuple
    fov_degrees: float
    width: int
    height: int

    def directions(self, x, y):
        """Unit directions in world space through the film positions x, y (in pixels)."""
        forward = normalized(np.subtract(self.target, self.origin))
        left = normalized(np.cross(self.up, forward))
        up = np.cross(forward, left)
        extent = np.tan(np.radians(self.fov_degrees) / 2)
        left_part = extent * (1 - 2 * x / self.width)
        up_part = extent * (self.height - 2 * y) / self.width
        parts = left_part[..., np.newaxis] * left + up_part[..., np.newaxis] * up
        return normalized(forward + parts)


@dataclass(frozen=True)
class Light:
    """A point light, or with `cutoff_degrees` a spot light that points along `axis`."""

    position: tuple
    intensity: tuple
    axis: tuple = (0, 0, -1)
    cutoff_degrees: float = None
    beam_degrees: float = None

    def falloff(self, direction):
        """Share of the intensity that leaves the light along unit vectors `direction`."""
        if self.cutoff_degrees is None:
            return np.ones(direction.shape[:-1])
        cosine = np.clip(direction @ normalized(np.array(self.axis, dtype=float)), -1, 1)
        angle = np.degrees(np.arccos(cosine))
        return np.clip(
            (self.cutoff_degrees - angle) / (self.cutoff_degrees - self.beam_degrees), 0, 1
        )


def normalized(vectors):
    """The vectors divided by their lengths."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def plane_points(camera, x, y):
    """Points of the plane z = 0 seen through the film positions."""
    directions = camera.directions(x, y)
    distances = -camera.origin[2] / directions[..., 2]
    if not (distances > 0).all():
        raise ValueError("the camera has to see nothing but the plane")
    return np.array(camera.origin) + distances[..., np.newaxis] * directions


def reflected_radiance(points, lights, albedo, extinction=0.0):
    """Radiance that the diffuse plane z = 0 reflects at `points`: exact sum over the lights.

    With `extinction`, a number or one for each channel, the light crosses an absorbing medium.
    """
    total = np.zeros((*points.shape[:-1], 3))
    for light in lights:
        offset = np.array(light.position) - points
        distance2 = (offset**2).sum(axis=-1)
        towards = normalized(offset)
        cosine = np.maximum(towards[..., 2], 0)
        irradiance = light.falloff(-towards) * cosine / distance2
        irradiance = irradiance[..., np.newaxis] * transmittance(np.sqrt(distance2), extinction)
        total += irradiance * np.array(light.intensity)
    return np.array(albedo) / np.pi * total


def transmittance(distances, extinction):
    """Share of the light that is left, with a last axis for the channels."""
    return np.exp(-np.asarray(distances)[..., np.newaxis] * np.broadcast_to(extinction, 3))


def film_grid(camera, order):
    """Film positions at the nodes of a midpoint rule of order^2 in each pixel.

    The midpoint rule and not Gauss's: the borders of spot lights are kinks.
    """
    nodes = (np.arange(order) + 0.5) / order
    x = np.arange(camera.width)[:, np.newaxis] + nodes
    y = np.arange(camera.height)[:, np.newaxis] + nodes
    grid_y, grid_x = np.meshgrid(y.ravel(), x.ravel(), indexing="ij")
    return grid_x, grid_y


def pixel_means(camera, radiance, order):
    """Average of the radiance at the nodes of `film_grid` over each pixel."""
    return radiance.reshape(camera.height, order, camera.width, order, 3).mean(axis=(1, 3))


def plane_image(camera, lights, albedo, order=32, extinction=0.0):
    """Expected image of the plane: the radiance averaged over each pixel."""
    points = plane_points(camera, *film_grid(camera, order))
    radiance = reflected_radiance(points, lights, albedo, extinction)
    distances = np.linalg.norm(points - np.array(camera.origin), axis=-1)
    return pixel_means(camera, radiance * transmittance(distances, extinction), order)


def slab_image(camera, thickness, extinction, radiance, order=16):
    """Expected image of a constant sky, seen through fog with faces across the line of sight."""
    directions = camera.directions(*film_grid(camera, order))
    axis = normalized(np.subtract(camera.target, camera.origin).astype(float))
    seen = transmittance(thickness / (directions @ axis), extinction)
    return pixel_means(camera, seen * np.array(radiance), order)


def isotropic(cosine):
    """Phase function that scatters alike in all directions."""
    return np.full_like(cosine, 1 / (4 * np.pi))


def henyey_greenstein(g):
    """Phase function of the cosine of the deflection: 1 is straight on."""
    return lambda cosine: (1 - g**2) / (4 * np.pi * (1 + g**2 - 2 * g * cosine) ** 1.5)


def rayleigh(cosine):
    """Phase function of small particles."""
    return 3 / (16 * np.pi) * (1 + cosine**2)


def tabulated(values):
    """Phase function that is linear between values at equidistant cosines from -1 to 1."""
    cosines = np.linspace(-1, 1, len(values))
    integral = 2 * np.pi * np.trapezoid(values, cosines)
    return lambda cosine: np.interp(cosine, cosines, values) / integral


def blend(weight, first, second):
    """Mixture of two phase functions; `weight` is that of the second one."""
    return lambda cosine: (1 - weight) * first(cosine) + weight * second(cosine)


class Phase:
    """Scattering that depends on the deflection only."""

    def __init__(self, function):
        self.function = function

    def value(self, along, leaving):
        """Density of scattering from one direction of travel into another one."""
        return self.function((along * leaving).sum(axis=-1))

    def area(self, direction):
        """Factor of the extinction for light that travels along a direction."""
        return np.ones(direction.shape[:-1])


class Flakes:
    """Mirrors whose normals are those of an ellipsoid: the SGGX model of Heitz et al. (2015)."""

    def __init__(self, xx, yy, zz, xy, xz, yz):
        self.matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=float)

    def area(self, direction):
        """Area of the flakes, seen along a direction."""
        return np.sqrt(np.einsum("...i,ij,...j", direction, self.matrix, direction))

    def value(self, along, leaving):
        """Density of scattering: that of the flakes half-way, seen along the light."""
        half = normalized(leaving - along)
        inverse = np.linalg.inv(self.matrix)
        form = np.einsum("...i,ij,...j", half, inverse, half)
        density = 1 / (np.pi * np.sqrt(np.linalg.det(self.matrix)) * form**2)
        return density / (4 * self.area(along))


NEAR_CLIP = 0.01
"""Mitsuba's default distance of the near plane."""


def single_scatter_image(camera, lights, extinction, albedo, phase, order=4, nodes=64):
    """Expected image of light that is scattered once, in fog without bounds or surfaces.

    The lights have to be out of the camera's view: near them Gauss's rule would fail. Rays of
    Mitsuba's cameras start on their near plane, and so does the fog.
    """
    directions = camera.directions(*film_grid(camera, order))
    dense = np.array(extinction) * phase.area(directions)[..., np.newaxis]
    share, weights = np.polynomial.legendre.leggauss(nodes)
    # Denser near the camera; cut off at e^-20
    farthest = 20 / float(np.min(dense))
    distances = farthest * ((share + 1) / 2) ** 2
    weights = weights * farthest * (share + 1) / 2
    forward = normalized(np.subtract(camera.target, camera.origin))
    start = NEAR_CLIP / (directions @ forward)[..., np.newaxis]
    total = np.zeros((*directions.shape[:-1], 3))
    for distance, weight in zip(distances, weights):
        points = np.array(camera.origin) + (start + distance) * directions
        scattered = weight * np.exp(-distance * dense) * dense * np.array(albedo)
        total += scattered * in_scattered(points, directions, lights, extinction, phase)
    return pixel_means(camera, total, order)


def in_scattered(points, directions, lights, extinction, phase):
    """Radiance of the lights at `points` times the phase function towards the camera.

    The phase function is that of the reversed path, as a path from the camera samples it.
    """
    total = np.zeros((*points.shape[:-1], 3))
    for light in lights:
        offset = np.array(light.position) - points
        distance = np.linalg.norm(offset, axis=-1)
        towards = normalized(offset)
        arriving = light.falloff(-towards) * phase.value(directions, towards) / distance**2
        length = distance * phase.area(towards)
        total += arriving[..., np.newaxis] * transmittance(length, extinction) * light.intensity
    return total


def double_scatter_image(camera, lights, extinction, albedo, order=2, nodes=64):
    """Expected image of light of points that fog of an isotropic phase function scatters twice.

    Fog and camera are those of `single_scatter_image`. From a point at the distance D of the
    light, the light that is scattered once arrives, with r1 and r2 its ways and u their sum, by
    the integral over (r1 r2)^-2 in bipolar coordinates, 2 pi / D dr1 dr2 r1 r2.
    """
    directions = camera.directions(*film_grid(camera, order))
    forward = normalized(np.subtract(camera.target, camera.origin))
    start = NEAR_CLIP / (directions @ forward)
    share, weights = np.polynomial.legendre.leggauss(nodes)
    share, weights = (share + 1) / 2, weights / 2
    total = np.zeros((*directions.shape[:-1], 3))
    for channel, sigma in enumerate(np.broadcast_to(extinction, 3)):
        scattering = sigma * np.broadcast_to(albedo, 3)[channel]
        farthest = 20 / sigma
        for s, w in zip(share, weights):
            points = np.array(camera.origin) + (start + farthest * s**2)[..., None] * directions
            weight = w * 2 * s * farthest * scattering * np.exp(-sigma * farthest * s**2)
            for light in lights:
                distance = np.linalg.norm(np.array(light.position) - points, axis=-1)
                once = once_scattered(distance, sigma) * light.intensity[channel]
                total[..., channel] += weight * scattering / (4 * np.pi) ** 2 * once
    return pixel_means(camera, total, order)


def once_scattered(distance, sigma, nodes=96):
    """Integral of exp(-sigma (r1 + r2)) / (r1 r2)^2 over space, between two points.

    It is 4 pi / D times that of exp(-sigma u) / u log((u + D) / (u - D)) over u > D.
    """
    share, weights = np.polynomial.legendre.leggauss(nodes)
    share, weights = (share + 1) / 2, weights / 2
    # u = D + x; the logarithm's pole at 0 is flat in the fourth root of x
    x = (20 / sigma) * share**4
    dx = weights * (80 / sigma) * share**3
    u = distance[..., None] + x
    values = np.exp(-sigma * u) / u * np.log((u + distance[..., None]) / x)
    return 4 * np.pi / distance * (values @ dx)


def scene_dict(camera, lights, albedo):
    """The same plane, camera and lights as a dictionary for `mi.load_dict`."""
    import mitsuba as mi

    look_at = mi.ScalarTransform4f().look_at
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": camera.fov_degrees,
            "to_world": look_at(camera.origin, camera.target, camera.up),
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
        },
        "plane": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().scale(100),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(albedo)}},
        },
    }
    for index, light in enumerate(lights):
        scene[f"light_{index}"] = light_dict(light)
    return scene


def light_dict(light):
    """One light as a dictionary for `mi.load_dict`."""
    import mitsuba as mi

    intensity = {"type": "rgb", "value": list(light.intensity)}
    if light.cutoff_degrees is None:
        return {"type": "point", "position": list(light.position), "intensity": intensity}
    target = np.add(light.position, light.axis)
    up = (1, 0, 0) if abs(light.axis[0]) < 0.9 else (0, 1, 0)
    return {
        "type": "spot",
        "to_world": mi.ScalarTransform4f().look_at(list(light.position), list(target), up),
        "intensity": intensity,
        "cutoff_angle": light.cutoff_degrees,
        "beam_width": light.beam_degrees,
    }
