"""Reports on the light tree of a scene: how many lights of which kind, how large the tree is."""

from __future__ import annotations

from collections import Counter

import mitsuba as mi

from manylights import loading
from manylights.loading import integrators
from manylights.threads import threads_for_files

#: What the integrator publishes once the tree is built, in the order of the report.
KEYS = ("lights", "lights_in_tree", "nodes", "depth", "bytes", "build_ms")

#: Names of emitters by Mitsuba's class names; other classes are listed under the class name.
KINDS = {
    "PointLight": "point",
    "SpotLight": "spot",
    "Projector": "projector",
    "DirectionalEmitter": "directional",
    "DirectionalArea": "directionalarea",
    "ConstantBackgroundEmitter": "constant",
    "EnvironmentMapEmitter": "envmap",
    "SunskyEmitter": "sunsky",
    "TimedSunskyEmitter": "timed_sunsky",
}

#: Of emitters on surfaces, the one that is sampled triangle by triangle
AREA = "AreaLight"


def describe(
    path: str,
    defines: dict[str, str] | None = None,
    usd_options: loading.UsdOptions | None = None,
) -> dict:
    """Build the light tree of a scene and return what it is like.

    If the scene names an integrator of ours, it builds the tree, with those of its parameters that
    concern the tree; otherwise ``manylights_direct`` does, with default parameters.

    Args:
        path: an XML file or a USD stage.
        defines: values for the ``<default>`` parameters of XML. Default: none.
        usd_options: how a stage is read. Default: as ``loading.UsdOptions()`` has it.

    Returns:
        The numbers named in ``KEYS`` (``bytes`` of memory, ``build_ms`` milliseconds) and
        ``kinds``, a dictionary from the kind of light to its count.
    """
    with loading.search_beside(path), threads_for_files():
        parsed = loading.parse(path, defines, usd_options)
        plugin, parameters = integrators.ours_in(parsed.state)
        scene = loading.instantiate(parsed)
    integrator = mi.load_dict({"type": plugin, **parameters})
    integrator.render(scene, sensor=_tiny_sensor(), seed=0, spp=1)
    values = mi.traverse(integrator)
    return {
        **{key: (float if key == "build_ms" else int)(_scalar(values[key])) for key in KEYS},
        "kinds": dict(count_kinds(scene)),
    }


def count_kinds(scene) -> Counter:
    """Count the lights of a scene by kind; each triangle of a mesh with an area light is one."""
    counts: Counter = Counter()
    for emitter in scene.emitters():
        shape = emitter.get_shape()
        kind = KINDS.get(emitter.class_name(), emitter.class_name())
        if shape is None:
            counts[kind] += 1
        elif shape.is_mesh() and emitter.class_name() == AREA:
            counts[f"{_surface_kind(emitter)} triangle"] += shape.primitive_count()
        else:
            counts[f"{_surface_kind(emitter)} {shape.class_name().lower()}"] += 1
    return counts


def format_report(description: dict) -> str:
    """Return what ``describe`` found as text, a line for each number."""
    lines = [f"{count:>12,}  {kind}" for kind, count in sorted(description["kinds"].items())]
    lines.append(f"{description['lights']:>12,}  lights")
    outside = description["lights"] - description["lights_in_tree"]
    lines.append(f"{description['lights_in_tree']:>12,}  in the tree ({outside:,} outside)")
    lines.append(f"{description['nodes']:>12,}  nodes")
    lines.append(f"{description['depth']:>12,}  depth")
    lines.append(f"{description['bytes']:>12,}  bytes")
    lines.append(f"{description['build_ms']:>12,.1f}  ms to build")
    return "\n".join(lines)


def _surface_kind(emitter) -> str:
    return "directionalarea" if emitter.class_name() == "DirectionalArea" else "area"


def _tiny_sensor():
    """A camera of one pixel: rendering with it does little more than build the tree."""
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    return mi.load_dict({"type": "perspective", "film": film})


def _scalar(value):
    """Return a number as it is, of a one-element array of Dr.Jit the element."""
    return value if isinstance(value, (int, float)) else value[0]
