"""Chooses the integrator of a parsed scene: replaces Mitsuba's by ours, sets parameters.

The work happens on Mitsuba's parsed form of a scene (``mi.parser.ParserState``), before any object
exists. The text of the XML file is not touched, and integrators nested in others, as in ``aov``,
are found like any other.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from manylights.errors import UsageError, argument, typed
from manylights.loading import light_groups
from manylights.loading.ours import (
    BASE_PARAMETERS,
    DIRECT,
    PARAMETERS,
    SAMPLING_PARAMETERS,
    VOLPATH,
    Wish,
    called,
    check_type,
    with_wish,
)

#: Integrators that render an image in blocks, and Mitsuba's own size of them, in pixels.
USING_BLOCKS = (
    *(DIRECT, VOLPATH),
    *("aov", "depth", "direct", "moment", "path", "stokes", "volpath", "volpathmis"),
)
BLOCK_SIZE = 32

#: What becomes of Mitsuba's integrators if nobody says otherwise. All others stay.
REPLACEMENTS = {"direct": DIRECT, "path": VOLPATH, "volpath": VOLPATH}

#: Parameters, and the integrators in which they mean the same.
SHARED_PARAMETERS = (
    (("max_depth", "rr_depth"), ("path", "volpath", "volpathmis", VOLPATH)),
    ((*SAMPLING_PARAMETERS, "aovs"), (DIRECT, VOLPATH)),
    (("bsdf_samples",), ("direct", DIRECT)),
    (BASE_PARAMETERS, USING_BLOCKS),
)

#: BSDFs that let light pass straight on, at least in part.
PASSED_STRAIGHT_ON = ("mask", "null", "thindielectric")

#: Why an integrator stays that one of ours could replace.
STAYS = {"volpathmis": f" stays: {VOLPATH} has no spectral MIS"}


def choose(state, wanted: str | None, settings: dict[str, Any]) -> list[str]:
    """Choose the integrator of a parsed scene and set its parameters, in place.

    Args:
        state: the scene as ``mi.parser.parse_file`` returns it, before any transformation.
        wanted: ``None`` replaces as ``REPLACEMENTS`` says, a scene without an integrator as one
            with ``path``; ``"keep"`` replaces nothing; any other text is the plugin to use for
            every integrator that nests no other.
        settings: parameters to set on each of those integrators.

    Returns:
        Lines for the log, each a statement of what was replaced, dropped or kept.

    Raises:
        UsageError: ``settings`` has a name that our plugin does not know, or there is no integrator
            to set it on.
    """
    leaves = leaf_integrators(state)
    notes = []
    if not leaves:
        leaves, notes = _without_integrator(state, wanted)
    elif wanted != "keep":
        for node in leaves:
            notes.extend(_replace(state, node.props, wanted))
    if settings and not leaves:
        name = next(iter(settings))
        raise UsageError(f"{called(name)}: the scene has no integrator, name one{by_name()}")
    for node in leaves:
        _apply(node.props, settings)
        if node.props.get("max_depth") == 0:
            notes.append("integrator: with max_depth=0 nothing is seen, its image is black")
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


def ours_in(state) -> tuple[str, dict[str, Any]]:
    """Return the first plugin of ours in a parsed scene and the parameters that concern its tree.

    A scene without any has ``manylights_direct`` with default parameters.
    """
    for node in leaf_integrators(state):
        name = node.props.plugin_name()
        if name in PARAMETERS:
            items = node.props.items()
            return name, {key: value for key, value in items if key in SAMPLING_PARAMETERS}
    return DIRECT, {}


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
    """Handle a scene that names no integrator as one that names ``path``."""
    if wanted == "keep":
        return [], []
    chosen = wanted or REPLACEMENTS["path"]
    node = mi.parser.SceneNode()
    node.type = mi.ObjectType.Integrator
    node.props = mi.Properties(chosen)
    state.nodes.append(node)
    index = len(state.nodes) - 1
    state.root.props["_arg_integrator"] = mi.Properties.ResolvedReference(index)
    other = "" if wanted else by_name("NAME", " takes another")
    note = f"integrator: the scene names none, using {chosen}{other}"
    return [state.nodes[index]], [note, *_about_media(state, "path", chosen)]


def _replace(state, props, wanted: str | None) -> list[str]:
    """Turn an integrator into ``wanted``, ``None`` for what ``REPLACEMENTS`` says.

    Parameters that mean the same in both are kept, the others are dropped and named.
    """
    old = props.plugin_name()
    new = wanted or REPLACEMENTS.get(old, old)
    if old == new:
        stays = (
            f"{STAYS[old]}{by_name(VOLPATH, ' uses it')}" if wanted is None and old in STAYS else ""
        )
        return [f"integrator: {old}{_listed(props)}{stays}"]
    notes = []
    if (old, new) == ("direct", DIRECT):
        if props.get("emitter_samples", props.get("shading_samples", 1)) == 0:
            return ["integrator: direct stays, emitter_samples=0 asks for BSDF sampling alone"]
        notes = _translate_samples(props)
    dropped = [key for key, _ in props.items() if not _means_the_same(key, old, new)]
    for key in dropped:
        del props[key]
    props.set_plugin_name(new)
    lost = f", dropped {', '.join(dropped)}" if dropped else ""
    note = f"integrator: {old} replaced by {new}{_listed(props)}{lost}{_undo(wanted)}"
    return [note, *notes, *_about_media(state, old, new)]


def _undo(wanted: str | None) -> str:
    return by_name("keep", " undoes it") if wanted is None else ""


def by_name(name: str = "NAME", does: str = "") -> str:
    """Return how the user chooses an integrator, and what that does, in brackets."""
    how = typed(f'integrator="{name}"', f"--integrator {name}")
    return f" ({how}{does})"


def _means_the_same(parameter: str, old: str, new: str) -> bool:
    if parameter == "hide_emitters":
        return True
    shared = (plugins for names, plugins in SHARED_PARAMETERS if parameter in names)
    return any(old in plugins and new in plugins for plugins in shared)


def _translate_samples(props) -> list[str]:
    """Turn the numbers of samples of Mitsuba's ``direct`` into those of ours."""
    shading = props.get("shading_samples", 1)
    emitter_samples = props.get("emitter_samples", shading)
    bsdf_samples = props.get("bsdf_samples", shading)
    for key in ("shading_samples", "emitter_samples", "bsdf_samples"):
        if key in props:
            del props[key]
    if bsdf_samples != 1:
        props["bsdf_samples"] = bsdf_samples
    if emitter_samples == 1:
        return []
    return [
        f"integrator: emitter_samples={emitter_samples} has no counterpart, "
        f"set shadow_rays and reservoirs{typed('', ' with --set')} instead"
    ]


def _about_media(state, old: str, new: str) -> list[str]:
    """Say so if the image changes since the old integrator ignores something of the scene."""
    if (old, new) != ("path", VOLPATH):
        return []
    if any(node.type == mi.ObjectType.Medium for node in state.nodes):
        return [f"integrator: the scene has media, which {old} ignores and {new} renders"]
    names = [node.props.plugin_name() for node in state.nodes if node.type == mi.ObjectType.BSDF]
    passed = next((name for name in names if name in PASSED_STRAIGHT_ON), None)
    if passed is None:
        return []
    return [f"integrator: shadow rays of {old} end on surfaces of {passed}, those of {new} do not"]


def check_settings(plugin: str, settings: dict[str, Any]) -> None:
    """Raise ``UsageError`` for parameters that an integrator cannot have, as far as we know it."""
    for name, value in settings.items():
        if name == "aovs" and plugin not in PARAMETERS and not isinstance(value, Wish):
            known = " or ".join(PARAMETERS)
            raise UsageError(
                f"{argument('aovs')}: {plugin} shows no surfaces, {known} do{by_name()}"
            )
        if plugin in PARAMETERS and name not in (*PARAMETERS[plugin], *BASE_PARAMETERS):
            known = "; ".join(f"{key} ({what})" for key, what in PARAMETERS[plugin].items())
            raise UsageError(f"{called(name)}: {plugin} has no such parameter. It has: {known}")
        if name == light_groups.PARAMETER and plugin not in PARAMETERS:
            known = " and ".join(PARAMETERS)
            raise UsageError(f"{argument(name)}: {plugin} has none, {known} have{by_name()}")
        if plugin in PARAMETERS and name in PARAMETERS[plugin]:
            check_type(name, value, PARAMETERS[plugin][name])


def _apply(props, settings: dict[str, Any]) -> None:
    plugin = props.plugin_name()
    check_settings(plugin, settings)
    for name, value in settings.items():
        # What is only wished for, other plugins do without.
        if plugin not in PARAMETERS and isinstance(value, Wish):
            continue
        props[name] = with_wish(props.get(name, ""), value)


def _listed(props) -> str:
    listed = ", ".join(f"{key}={value}" for key, value in props.items())
    return f" with {listed}" if listed else ""
