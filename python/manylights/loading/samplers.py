"""Chooses the samplers of a parsed scene: replaces Mitsuba's by ours, which stratifies."""

from __future__ import annotations

import mitsuba as mi

from manylights.errors import typed

#: Ours: any number of samples, in any order, are those of one sequence for each pixel.
SOBOL = "manylights_sobol"

#: What becomes of Mitsuba's samplers if nobody says otherwise. All others stay.
REPLACED = ("independent",)

#: Parameters that all samplers share; those of Mitsuba's own have others.
SHARED = ("sample_count", "seed")


def choose(state, wanted: str | None) -> list[str]:
    """Choose the samplers of a parsed scene, in place, and return lines for the log.

    Args:
        state: the scene as ``mi.parser.parse_file`` returns it, before any transformation.
        wanted: ``None`` replaces those in ``REPLACED``, and those of sensors that name none, which
            would be ``independent``; ``"keep"`` replaces nothing; any other text is the plugin to
            use.
    """
    if wanted == "keep":
        return []
    new, replaced = wanted or SOBOL, []
    # By number: nodes move when others are appended
    for index in range(len(state.nodes)):
        node = state.nodes[index]
        if node.type == mi.ObjectType.Sampler:
            old = node.props.plugin_name()
            if old != new and (wanted or old in REPLACED):
                _replace(node.props, new)
                replaced.append(old)
        elif node.type == mi.ObjectType.Sensor and not _has_sampler(node, state):
            _add(state, index, new)
            replaced.append("independent")
    names = ", ".join(dict.fromkeys(replaced))
    keep = typed("an mi.Scene keeps its own", "--sampler keep undoes it")
    undo = f" ({keep})" if wanted is None else ""
    return [f"sampler: {names} replaced by {new}{undo}"] if replaced else []


def _replace(props, new: str) -> None:
    # What those in REPLACED do not have either is a mistake, which Mitsuba names
    names = [] if props.plugin_name() in REPLACED else list(props.keys())
    for name in names:
        if name not in SHARED:
            del props[name]
    props.set_plugin_name(new)


def _add(state, sensor: int, new: str) -> None:
    node = mi.parser.SceneNode()
    node.type = mi.ObjectType.Sampler
    node.props = mi.Properties(new)
    state.nodes.append(node)
    sampler = mi.Properties.ResolvedReference(len(state.nodes) - 1)
    state.nodes[sensor].props["_arg_sampler"] = sampler


def _has_sampler(node, state) -> bool:
    """Does a sensor name a sampler, or a sensor that it is made of?"""
    for _, value in node.props.items():
        if isinstance(value, mi.Properties.ResolvedReference):
            child = state.nodes[value.index()]
        elif isinstance(value, mi.Properties.Reference):
            # What an id that is not there means, Mitsuba says itself.
            index = state.id_to_index.get(value.id())
            child = node if index is None else state.nodes[index]
        else:
            continue
        if child.type in (mi.ObjectType.Sampler, mi.ObjectType.Sensor):
            return True
    return False
