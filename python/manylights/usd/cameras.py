"""Cameras of a stage as sensors of Mitsuba, and one that frames the scene where there is none."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom

from manylights.errors import argument
from manylights.usd.context import Context
from manylights.usd.settings import RenderSettings
from manylights.usd.stage import StageError
from manylights.usd.traversal import local_matrix

#: Pixels in a row where no render settings say it.
WIDTH = 960

#: Samples per pixel where no render settings say it.
SAMPLES = 64

#: Where a camera that frames the scene looks from, by the axis that points up; its field of view.
VIEWS = {"Y": (0.45, 0.35, 1.0), "Z": (0.45, -1.0, 0.35)}
FIELD_OF_VIEW = 45.0


def choose_camera(
    context: Context, wanted: str | None, settings: RenderSettings
) -> Usd.Prim | None:
    """Return the camera to use, None if the stage has none.

    Raises:
        StageError: ``wanted`` is no camera of the stage.
    """
    cameras = _cameras(context.stage)
    if wanted is not None:
        return _named(context.stage, wanted, cameras)
    path = settings.camera()
    if path is not None:
        prim = context.stage.GetPrimAtPath(path)
        if prim and prim.IsA(UsdGeom.Camera):
            return prim
        text = f"the camera {path} of the render settings does not exist"
        context.notes.add("settings camera", text, settings.prim)
    if len(cameras) > 1:
        others = ", ".join(str(prim.GetPath()) for prim in cameras[1:4])
        text = f"the stage has {len(cameras)} cameras, used was the first one, others are {others}"
        context.notes.add("cameras", text, cameras[0])
    return cameras[0] if cameras else None


def _cameras(stage: Usd.Stage) -> list[Usd.Prim]:
    predicate = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)
    return [prim for prim in stage.Traverse(predicate) if prim.IsA(UsdGeom.Camera)]


def _named(stage: Usd.Stage, path: str, cameras: list[Usd.Prim]) -> Usd.Prim:
    known = ", ".join(str(prim.GetPath()) for prim in cameras[:10]) or "none"
    name = argument("camera")
    if not Sdf.Path.IsValidPathString(str(path)):
        raise StageError(f"{name} {path}: not a path; the stage has {known}")
    path = Sdf.Path(str(path)).MakeAbsolutePath(Sdf.Path.absoluteRootPath)
    prim = stage.GetPrimAtPath(path)
    if not prim:
        raise StageError(f"{name} {path}: no such prim; the stage has {known}")
    if not prim.IsA(UsdGeom.Camera):
        kind = prim.GetTypeName() or "without type"
        raise StageError(f"{name} {path}: a prim {kind}, no Camera; the stage has {known}")
    return prim


def sensor_of(prim: Usd.Prim, context: Context, settings: RenderSettings) -> tuple[dict, float]:
    """Return a camera as a sensor and the factor of its exposure."""
    camera = UsdGeom.Camera(prim)
    values = _Values(camera, context)
    if len(context.value(camera.GetClippingPlanesAttr(), ())):
        text = "the clippingPlanes of a camera were ignored, it sees what they cut away"
        context.notes.add("clippingPlanes", text, prim)
    width, height = _resolution(settings, values.aspect())
    horizontal, vertical = settings.conform(values.horizontal, values.vertical, width / height)
    frame, position = _frame(prim, context)
    right, up, back = frame
    offset_x, offset_y = values.offsets
    sensor: dict = {"near_clip": values.near, "far_clip": values.far}
    if values.orthographic:
        # Apertures are tenths of a unit
        half = horizontal / 20
        position = position + (right * offset_x + up * offset_y) / 10
        sensor["type"] = "orthographic"
        sensor["to_world"] = _to_world(right * half, up * half, back, position)
    else:
        sensor["type"] = "perspective"
        sensor["to_world"] = _to_world(right, up, back, position)
        sensor["fov"] = math.degrees(2 * math.atan(horizontal / (2 * values.focal_length)))
        sensor["fov_axis"] = "x"
        if offset_x or offset_y:
            sensor["principal_point_offset_x"] = offset_x / horizontal
            sensor["principal_point_offset_y"] = -offset_y / vertical
        if settings.has_lens():
            values.add_lens(sensor)
    sensor.update(_film_and_sampler(width, height, settings))
    settings.apply_to_sensor(prim, sensor)
    return sensor, values.exposure()


def framing_sensor(context: Context, points: np.ndarray, settings: RenderSettings) -> dict:
    """Return a sensor that shows all points, ``(n, 3)``, and note that it was made up."""
    points = points[np.isfinite(points).all(axis=1)]
    low, high = (
        (points.min(axis=0), points.max(axis=0)) if len(points) else (-np.ones(3), np.ones(3))
    )
    centre, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)
    up_axis = context.up_axis()
    width, height = _resolution(settings, 4 / 3)
    back = np.array(VIEWS[up_axis]) / np.linalg.norm(VIEWS[up_axis])
    right = np.cross(np.eye(3)["XYZ".index(up_axis)], back)
    right /= np.linalg.norm(right)
    narrow = math.tan(math.radians(FIELD_OF_VIEW / 2)) * min(1.0, height / width)
    distance = radius / math.sin(math.atan(narrow))
    text = "the stage has no camera, one was made that frames the scene"
    context.notes.add("no camera", text, "/")
    return {
        "type": "perspective",
        "fov": FIELD_OF_VIEW,
        "fov_axis": "x",
        "near_clip": distance * 1e-4,
        "far_clip": distance * 1e4,
        "to_world": _to_world(right, np.cross(back, right), back, centre + distance * back),
        **_film_and_sampler(width, height, settings),
    }


class _Values:
    """What a camera says, at one time; broken values are noted and replaced."""

    def __init__(self, camera: UsdGeom.Camera, context: Context) -> None:
        self.camera, self.context = camera, context
        self.horizontal = self._positive(camera.GetHorizontalApertureAttr(), 20.955)
        self.vertical = self._positive(camera.GetVerticalApertureAttr(), 15.2908)
        self.focal_length = self._positive(camera.GetFocalLengthAttr(), 50.0)
        horizontal = context.value(camera.GetHorizontalApertureOffsetAttr(), 0.0)
        vertical = context.value(camera.GetVerticalApertureOffsetAttr(), 0.0)
        self.offsets = float(horizontal), float(vertical)
        self.orthographic = context.value(camera.GetProjectionAttr()) == "orthographic"
        self.near, self.far = self._clipping()

    def _positive(self, attribute, fallback: float) -> float:
        value = float(self.context.value(attribute, fallback))
        if math.isfinite(value) and value > 0:
            return value
        text = f"{attribute.GetName()} of a camera is {value:g}, used was {fallback:g}"
        self.context.notes.add(f"camera {attribute.GetName()}", text, self.camera.GetPrim())
        return fallback

    def _clipping(self) -> tuple[float, float]:
        attribute = self.camera.GetClippingRangeAttr()
        if not attribute.HasAuthoredValue():
            # The fallback of 1 would cut away what is near in a scene in metres
            return 1e-3, 1e7
        near, far = self.context.value(attribute, (1e-3, 1e7))
        if not 0 < near < far or not math.isfinite(near):
            text = f"clippingRange ({near:g}, {far:g}) of a camera was ignored"
            self.context.notes.add("clippingRange", text, self.camera.GetPrim())
            return 1e-3, 1e7
        return float(near), float(min(far, 1e12))

    def aspect(self) -> float:
        return self.horizontal / self.vertical

    def add_lens(self, sensor: dict) -> None:
        """Make a pinhole a lens if the camera has an f-number."""
        stop = float(self.context.value(self.camera.GetFStopAttr(), 0.0))
        if not stop > 0:
            return
        distance = float(self.context.value(self.camera.GetFocusDistanceAttr(), 0.0))
        if not (math.isfinite(distance) and distance > 0):
            text = "a camera has an fStop but no focusDistance: all is in focus"
            self.context.notes.add("focusDistance", text, self.camera.GetPrim())
            return
        sensor["type"] = "thinlens"
        # A focal length is in tenths of a unit
        sensor["aperture_radius"] = self.focal_length / 10 / (2 * stop)
        sensor["focus_distance"] = distance
        if "principal_point_offset_x" in sensor:
            text = "a camera with depth of field lost the offset of its aperture"
            self.context.notes.add("offset", text, self.camera.GetPrim())
            del sensor["principal_point_offset_x"], sensor["principal_point_offset_y"]

    def exposure(self) -> float:
        try:
            factor = float(self.camera.ComputeLinearExposureScale(self.context.time))
        except Tf.ErrorException:
            return 1.0
        if math.isfinite(factor) and factor >= 0:
            return factor
        text = f"the exposure of a camera, a factor of {factor}, was ignored"
        self.context.notes.add("exposure", text, self.camera.GetPrim())
        return 1.0


def _frame(prim: Usd.Prim, context: Context) -> tuple[np.ndarray, np.ndarray]:
    """Return a camera's axes, right, up and back, without scale, and its position."""
    matrix, path = np.eye(4), prim.GetPath()
    while prim and not prim.IsPseudoRoot():
        xformable = UsdGeom.Xformable(prim)
        if xformable:
            try:
                matrix = matrix @ local_matrix(xformable, context.time)
            except ValueError as error:
                raise StageError(f"camera {path}: {error}") from None
            if xformable.GetResetXformStack():
                break
        prim = prim.GetParent()
    up, back = matrix[1, :3], matrix[2, :3]
    right = np.cross(up, back)
    lengths = np.linalg.norm(right), np.linalg.norm(back)
    if min(lengths) < 1e-12:
        raise StageError(f"camera {path}: its transform is singular")
    right, back = right / lengths[0], back / lengths[1]
    return np.stack([right, np.cross(back, right), back]), matrix[3, :3]


def _to_world(right, up, back, position):
    """Return a transform for a sensor: Mitsuba's look along +Z, with X to the left."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([-right, up, -back], axis=1)
    matrix[:3, 3] = position
    return mi.ScalarTransform4f(matrix)


def _resolution(settings: RenderSettings, aspect: float) -> tuple[int, int]:
    authored = settings.resolution()
    if authored:
        return authored
    return WIDTH, max(1, min(round(WIDTH / aspect), 16 * WIDTH))


def _film_and_sampler(width: int, height: int, settings: RenderSettings) -> dict:
    film = {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "pixel_format": "rgb",
        "component_format": "float32",
        # Sums of a wider filter depend on the order of threads
        "rfilter": {"type": "box"},
    }
    count = settings.sample_count() or SAMPLES
    return {"film": film, "sampler": {"type": "independent", "sample_count": count}}
