"""Puts the parts of a stage together: lights, geometry, camera and settings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from manylights.errors import check, integer, one_line, typed
from manylights.files import path_of
from manylights.loading.integrators import REPLACEMENTS
from manylights.loading.light_groups import PARAMETER, as_text
from manylights.loading.ours import PARAMETERS, VOLPATH
from manylights.loading.parsing import MOST_SUBDIVISION, UsdOptions
from manylights.threads import require_variant
from manylights.usd import cameras, skinning
from manylights.usd.context import Context, Notes
from manylights.usd.description import instantiate
from manylights.usd.drawing import Scenery
from manylights.usd.light_groups import LightGroups
from manylights.usd.lights import Lights
from manylights.usd.settings import RenderSettings
from manylights.usd.stage import StageError, guarded, layer_files, open_stage, time_of
from manylights.usd.traversal import collect

#: What prims of a stage may be for.
PURPOSES = ("default", "render", "proxy", "guide")


class SceneDict(dict):
    """A dictionary for ``mi.load_dict``.

    Attributes:
        notes: what was not carried over, or not as it is; one entry a kind with ``text``, the
            sentence, ``count``, how often, and ``prim``, the path of the first prim.
        exposure: the factor by which the camera's exposure brightens the image. It is not in the
            scene: multiply the image by it.
        camera: path of the camera, None if one was made up.
        metadata: ``metersPerUnit``, ``upAxis`` and ``time`` (None for the default time).
        files: the layers that the stage is composed of, that of ``path`` first.
    """

    notes: Notes
    exposure: float
    camera: str | None
    metadata: dict
    files: list[str]


def load(
    path,
    *,
    time=None,
    camera=None,
    purposes=("default", "render"),
    subdivision=None,
    default_light=False,
    legacy_lights=False,
    blender_light_units=False,
    light_groups="",
) -> SceneDict:
    """Read a USD stage as a dictionary for ``mi.load_dict``.

    Lengths stay in units of the stage and axes as they are; radiance is in nits. Lamps that are
    many and equal become few meshes. Where one mesh has more than a few radiances they are in its
    attribute ``face_color``, in which only the integrators of this package find light, so the
    scene has ``manylights_volpath`` unless the stage's render settings ask for another.

    Args:
        path: of a ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file.
        time: at which attributes are read. Default: the stage's start time if it has one, else the
            default values, and the earliest samples of attributes that have none.
        camera: path of the camera. Default: that of the render settings, else the first one, else
            one that frames the scene.
        purposes: of the prims that are read.
        subdivision: levels by which meshes without an authored scheme are refined. Default: their
            cages are used.
        default_light: shine from everywhere, with radiance 1, if the stage has no light?
        legacy_lights: read the inputs of lights from before USD 21.05, without ``inputs:``?
        blender_light_units: are lights as Blender (5.0) exports them: suns with a quarter of their
            irradiance and half of their angle, and all with a color temperature, 6500 for white?
        light_groups: groups of lights, as for the integrators: ``"key=/World/Lamps/*"``. Only lamps
            of one group become one mesh, and lights are called by the paths of their prims.
            Default: what the integrator of the render settings says.

    Returns:
        A dictionary with objects of the current variant of Mitsuba, and the attribute ``notes``.

    Raises:
        StageError: (a ``ValueError``) there is no such file or camera, or the file cannot be read;
            the text names file and prim.
    """
    description = describe(
        path,
        time=time,
        camera=camera,
        purposes=purposes,
        subdivision=subdivision,
        default_light=default_light,
        legacy_lights=legacy_lights,
        blender_light_units=blender_light_units,
        light_groups=light_groups,
    )
    result = SceneDict(instantiate(description))
    result.__dict__.update(description.__dict__)
    return result


def describe(path, **choices) -> SceneDict:
    """Read a stage as :func:`load` does, but each mesh is a ``MeshShape``, not an object yet.

    Args:
        path: of the stage.
        choices: the other arguments of :func:`load`.
    """
    require_variant()
    path_of("path", path)
    options = UsdOptions(**choices)
    levels = options.subdivision
    if levels is not None:
        levels = integer("subdivision", levels, 0, MOST_SUBDIVISION)
    notes, purposes = Notes(), _purposes(options.purposes)
    with guarded(path):
        stage = open_stage(path, notes)
        context = Context(
            stage=stage,
            time=time_of(stage, options.time),
            notes=notes,
            purposes=purposes,
            subdivision=levels,
            legacy_lights=options.legacy_lights,
            blender_light_units=options.blender_light_units,
        )
        asked = options.light_groups or _groups_of_settings(context)
        context.light_groups = LightGroups(as_text(asked))
        skinning.bake(context)
        return _read(context, options.camera, options.default_light)


def _purposes(purposes) -> tuple[str, ...]:
    purposes = (purposes,) if isinstance(purposes, str) else purposes
    listed = isinstance(purposes, (list, tuple, set, frozenset))
    check("purposes", purposes, listed, f"a list of {', '.join(PURPOSES)}")
    for purpose in purposes:
        if purpose not in PURPOSES:
            raise StageError(f"purpose {purpose!r}: it has to be one of {', '.join(PURPOSES)}")
    return tuple(purposes)


def _read(context: Context, camera, default_light: bool) -> SceneDict:
    batches = collect(context)
    lights = Lights(context)
    drawing = Scenery(context, lights, batches)
    for batch in batches:
        for item in batch.items:
            if item.role == "light":
                lights.add(item.prim, batch.worlds(item), batch.instancers)
        drawing.add(batch)
    return _scene(context, lights, drawing, camera, default_light)


def _scene(context: Context, lights: Lights, drawing: Scenery, camera, default_light) -> SceneDict:
    geometry = drawing.points()
    points = np.concatenate([geometry, lights.points()])
    points = points[np.isfinite(points).all(axis=1)]
    context.light_groups.check()
    lights.finish(float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0)
    settings = RenderSettings(context)
    scene = SceneDict(type="scene")
    _add_sensor(scene, context, settings, camera, geometry if len(geometry) else points)
    scene.update(lights.entries)
    for index, mesh in enumerate(lights.lamps.meshes()):
        scene[lights.named(mesh.light) if mesh.light else f"lamps_{index}"] = mesh
    scene.update(drawing.entries)
    scene["integrator"] = _integrator(context, settings, lights.lamps.uses_attribute)
    if not lights.count:
        _without_light(context, scene, default_light)
    if not len(geometry):
        purposes = ", ".join(context.purposes)
        text = f"nothing that could be seen is in the stage (of the purposes {purposes})"
        context.notes.add("no geometry", text, "/")
    scene.notes = context.notes
    scene.metadata = _metadata(context)
    scene.files = layer_files(context.stage)
    return scene


def _groups_of_settings(context: Context) -> str:
    """Return the groups of lights that the integrator of a stage has."""
    quiet = replace(context, notes=Notes())
    asked = RenderSettings(quiet).integrator() or {}
    return str(asked.get(PARAMETER, ""))


def _add_sensor(
    scene: SceneDict, context: Context, settings: RenderSettings, camera, points
) -> None:
    prim = cameras.choose_camera(context, camera, settings)
    scene.exposure, scene.camera = 1.0, None if prim is None else str(prim.GetPath())
    try:
        if prim is None:
            scene["sensor"] = cameras.framing_sensor(context, points, settings)
        else:
            scene["sensor"], scene.exposure = cameras.sensor_of(prim, context, settings)
    except StageError:
        raise
    except (IndexError, OverflowError, TypeError, ValueError) as error:
        places = [str(part.GetPath()) for part in (prim, settings.prim) if part]
        text = f"{' or '.join(places)}: an attribute of the wrong type: {one_line(error)}"
        raise StageError(text) from None


def _integrator(context: Context, settings: RenderSettings, uses_attribute: bool) -> dict:
    """Return the integrator that the stage asks for, one of ours where only ours see the lamps."""
    asked = settings.integrator()
    if asked is None:
        return {"type": VOLPATH}
    kind = asked.get("type")
    if uses_attribute and kind in REPLACEMENTS:
        ours = REPLACEMENTS[kind]
        kept = {key: value for key, value in asked.items() if key in PARAMETERS[ours]}
        text = f"the integrator {kind} finds no light on merged lamps, used was {ours}"
        context.notes.add("integrator", text, settings.prim)
        return {**kept, "type": ours}
    return asked


def _without_light(context: Context, scene: SceneDict, default_light: bool) -> None:
    if default_light:
        text = "the stage has no light, a constant environment of radiance 1 was added"
        radiance = {"type": "rgb", "value": [1.0, 1.0, 1.0]}
        scene["environment"] = {"type": "constant", "radiance": radiance}
    else:
        option = typed("default_light=True", "--default-light")
        text = f"the stage has no light: the image is black without {option}"
    context.notes.add("no light", text, "/")


def _metadata(context: Context) -> dict:
    from pxr import UsdGeom

    time = context.time
    return {
        "metersPerUnit": float(UsdGeom.GetStageMetersPerUnit(context.stage)),
        "upAxis": context.up_axis(),
        "time": None if time.IsDefault() else float(time.GetValue()),
    }
