"""Exact pixel values of a diffuse plane under point and spot lights, by quadrature in numpy.

Nothing here calls Mitsuba: the camera, the lights' emission and the reflection are written down
again, so that a mistake in reading the scene shows as well as one in the sampling.
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


def reflected_radiance(points, lights, albedo):
    """Radiance that the diffuse plane z = 0 reflects at `points`: exact sum over the lights."""
    total = np.zeros((*points.shape[:-1], 3))
    for light in lights:
        offset = np.array(light.position) - points
        distance2 = (offset**2).sum(axis=-1)
        towards = normalized(offset)
        cosine = np.maximum(towards[..., 2], 0)
        irradiance = light.falloff(-towards) * cosine / distance2
        total += irradiance[..., np.newaxis] * np.array(light.intensity)
    return np.array(albedo) / np.pi * total


def plane_image(camera, lights, albedo, order=32):
    """Expected image: the radiance averaged over each pixel with a midpoint rule of order^2.

    The midpoint rule and not Gauss's: the borders of spot lights are kinks.
    """
    nodes = (np.arange(order) + 0.5) / order
    x = np.arange(camera.width)[:, np.newaxis] + nodes
    y = np.arange(camera.height)[:, np.newaxis] + nodes
    grid_y, grid_x = np.meshgrid(y.ravel(), x.ravel(), indexing="ij")
    radiance = reflected_radiance(plane_points(camera, grid_x, grid_y), lights, albedo)
    return radiance.reshape(camera.height, order, camera.width, order, 3).mean(axis=(1, 3))


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
