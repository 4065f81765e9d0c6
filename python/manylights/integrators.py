"""Chooses the integrator of a parsed scene: replaces Mitsuba's ``direct`` by ours, sets parameters.

The work happens on Mitsuba's parsed form of a scene (``mi.parser.ParserState``), before any object
exists. The text of the XML file is not touched, and integrators nested in others, as in ``aov``,
are found like any other.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from manylights.errors import UsageError

OURS = "manylights_direct"

#: What the plugin accepts, for error messages and help. The plugin itself checks the values.
PARAMETERS = {
    "splitting_rate": "float >= 0 or inf, default 1",
    "reservoirs": "integer >= 1",
    "shadow_rays": "integer from 1 to the number of reservoirs",
    "bsdf_samples": "integer >= 0, default 1",
    "method": "resampled_tree or talk",
    "hide_emitters": "true or false, default false",
}

#: Parameters of Mitsuba's own base classes, accepted too.
BASE_PARAMETERS = ("block_size", "timeout")

#: Integrators that render an image in blocks, and Mitsuba's own size of them, in pixels.
USING_BLOCKS = (OURS, "aov", "depth", "direct", "moment", "path", "stokes", "volpath", "volpathmis")
BLOCK_SIZE = 32


def parse_value(text: str) -> bool | int | float | str:
    """Interpret the right-hand side of ``--set name=value``.

    ``true`` and ``false`` give booleans; then integers, floats (``inf`` included) and plain text
    are tried in this order.
    """
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def parse_assignments(items: list[str], option: str) -> dict[str, str]:
    """Turn ``["a=1", "b=2"]`` into a dictionary of texts.

    Raises:
        UsageError: an item has no ``=`` or no name before it; ``option`` is named in the text.
    """
    result = {}
    for item in items:
        name, separator, value = item.partition("=")
        if not separator or not name:
            raise UsageError(f"{option} {item}: write it as {option} name=value")
        result[name] = value
    return result


def choose(state, wanted: str | None, settings: dict[str, Any]) -> list[str]:
    """Choose the integrator of a parsed scene and set its parameters, in place.

    Args:
        state: the scene as ``mi.parser.parse_file`` returns it, before any transformation.
        wanted: ``None`` replaces ``direct`` by ``manylights_direct``; ``"keep"`` replaces nothing;
            any other text is the plugin to use for every integrator that nests no other.
        settings: parameters to set on each of those integrators.

    Returns:
        Lines for the log, each a statement of what was replaced, dropped or kept.

    Raises:
        UsageError: ``settings`` has a name that ``manylights_direct`` does not know, or there is no
            integrator to set it on.
    """
    leaves = leaf_integrators(state)
    notes = []
    if not leaves:
        leaves, notes = _without_integrator(state, wanted)
    for node in leaves:
        if wanted is None:
            notes.extend(_replace_direct(node.props))
        elif wanted != "keep":
            notes.extend(_replace(node.props, wanted))
    if settings and not leaves:
        raise UsageError("--set: the scene has no integrator, choose one with --integrator NAME")
    for node in leaves:
        _apply(node.props, settings)
    return notes


def fix_block_size(state) -> None:
    """Make the images of scalar variants independent of the number of threads, in place.

    They render blocks of pixels, each with random numbers of its own. Mitsuba makes the blocks
    smaller where an image has fewer than there are threads; a size that is set stays.
    """
    for node in state.nodes:
        if node.type == mi.ObjectType.Integrator and node.props.plugin_name() in USING_BLOCKS:
            node.props["block_size"] = node.props.get("block_size", BLOCK_SIZE)


def leaf_integrators(state) -> list:
    """Return the integrator nodes of a parsed scene that have no integrator inside."""
    nodes = state.nodes
    integrators = [node for node in nodes if node.type == mi.ObjectType.Integrator]
    return [node for node in integrators if not _nests_integrator(node, state)]


def parameters_of_ours(state) -> dict[str, Any]:
    """Return the parameters of the first ``manylights_direct`` of a parsed scene, {} if none."""
    for node in leaf_integrators(state):
        if node.props.plugin_name() == OURS:
            return {name: value for name, value in node.props.items() if name in PARAMETERS}
    return {}


def _nests_integrator(node, state) -> bool:
    for _, value in node.props.items():
        if isinstance(value, mi.Properties.ResolvedReference):
            child = state.nodes[value.index()]
        elif isinstance(value, mi.Properties.Reference):
            index = state.id_to_index.get(value.id())
            if index is None:
                continue
            child = state.nodes[index]
        else:
            continue
        if child.type == mi.ObjectType.Integrator:
            return True
    return False


def _without_integrator(state, wanted: str | None) -> tuple[list, list[str]]:
    """Handle a scene that names no integrator; Mitsuba would use ``path``."""
    if wanted in (None, "keep"):
        return [], ["integrator: the scene names none, Mitsuba uses path"]
    node = mi.parser.SceneNode()
    node.type = mi.ObjectType.Integrator
    node.props = mi.Properties(wanted)
    state.nodes.append(node)
    index = len(state.nodes) - 1
    state.root.props["_arg_integrator"] = mi.Properties.ResolvedReference(index)
    return [state.nodes[index]], [f"integrator: the scene names none, using {wanted}"]


def _replace_direct(props) -> list[str]:
    """Turn Mitsuba's ``direct`` into ours with the same meaning, any other stays as it is."""
    name = props.plugin_name()
    if name != "direct":
        return [f"integrator: {name}"]
    shading = props.get("shading_samples", 1)
    emitter_samples = props.get("emitter_samples", shading)
    bsdf_samples = props.get("bsdf_samples", shading)
    if emitter_samples == 0:
        return ["integrator: direct stays, emitter_samples=0 asks for BSDF sampling alone"]
    for key in ("shading_samples", "emitter_samples", "bsdf_samples"):
        if key in props:
            del props[key]
    if bsdf_samples != 1:
        props["bsdf_samples"] = bsdf_samples
    props.set_plugin_name(OURS)
    notes = [f"integrator: direct replaced by {OURS}{_listed(props)} (--integrator keep undoes it)"]
    if emitter_samples != 1:
        notes.append(
            f"integrator: emitter_samples={emitter_samples} has no counterpart, "
            "set shadow_rays and reservoirs with --set instead"
        )
    return notes


def _replace(props, wanted: str) -> list[str]:
    """Turn an integrator into ``wanted``; of its parameters only ``hide_emitters`` means the same
    everywhere, the others are dropped and named."""
    old = props.plugin_name()
    if old == wanted:
        return [f"integrator: {wanted}{_listed(props)}"]
    if (old, wanted) == ("direct", OURS):
        return _replace_direct(props)
    dropped = [key for key, _ in props.items() if key != "hide_emitters"]
    for key in dropped:
        del props[key]
    props.set_plugin_name(wanted)
    note = f"integrator: {old} replaced by {wanted}{_listed(props)}"
    return [note + (f", dropped {', '.join(dropped)}" if dropped else "")]


def _apply(props, settings: dict[str, Any]) -> None:
    allowed = (*PARAMETERS, *BASE_PARAMETERS)
    for name, value in settings.items():
        if props.plugin_name() == OURS and name not in allowed:
            known = "; ".join(f"{key} ({meaning})" for key, meaning in PARAMETERS.items())
            raise UsageError(f"--set {name}: {OURS} has no such parameter. It has: {known}")
        props[name] = value


def _listed(props) -> str:
    listed = ", ".join(f"{key}={value}" for key, value in props.items())
    return f" with {listed}" if listed else ""
