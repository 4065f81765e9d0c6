"""Joins emissive meshes that have a constant radiance: many shapes become one, the image stays.

Mitsuba makes a function of its own in the kernel for each shape, so the first render of 10,000
separate lamps takes a minute, and each later one seconds. As one mesh they take a second::

    scene = mi.load_dict(manylights.merge_emitters(description))

The radiance of each lamp is kept in the mesh attribute ``face_color``. Mitsuba's own emitter
sampling finds no light there: scenes with merged emitters are for ``manylights_direct`` and
``manylights_volpath``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from manylights.errors import UsageError, argument, check, near, shown
from manylights.loading import light_groups, parsing
from manylights.loading.integrators import leaf_integrators
from manylights.loading.ours import PARAMETERS
from manylights.output import channels
from manylights.threads import require_variant

#: Parameters of shapes that say what the mesh is. Shapes with any other stay as they are.
GEOMETRY = {
    "rectangle": (),
    "cube": (),
    "obj": ("filename", "flip_tex_coords"),
    "ply": ("filename", "flip_tex_coords"),
    "serialized": ("filename", "shape_index"),
}
SHARED_GEOMETRY = ("to_world", "flip_normals", "face_normals")

#: What a ``mi.Mesh`` may have; all else, as an attribute, would be lost.
MESH_PARAMETERS = (
    *("faces", "to_world", "silhouette_sampling_weight"),
    *("vertex_positions", "vertex_normals", "vertex_texcoords"),
)
MESH_CHILDREN = ("bsdf.", "emitter.", "interior_medium.", "exterior_medium.")

Reference = mi.Properties.ResolvedReference
INTEGRATOR, SHAPE = mi.ObjectType.Integrator, mi.ObjectType.Shape


class MergedScene(dict):
    """A dictionary for ``mi.load_dict``.

    Attributes:
        merged: the ids of the shapes in each merged mesh, by the name of that mesh.
    """

    merged: dict[str, list[str]]


@dataclass
class Lamp:
    """An emissive mesh of constant radiance.

    Attributes:
        key: name of the shape among the scene's properties.
        id: what users call it.
        mesh: the shape, or the properties to make it of, without BSDF and emitter.
        radiance: three channels.
        names: those that light groups may know it by: of the emitter, and of the shape.
        materials: BSDF, media and textures by the names that a mesh expects.
        uses: indices of the nodes that became ``materials``.
    """

    key: str
    id: str
    mesh: Any
    radiance: np.ndarray
    materials: dict[str, object]
    uses: set[int]
    names: tuple[str, str]

    def kind(self) -> tuple:
        """Return what lamps of one mesh have in common.

        Not ``face_normals``: after loading these meshes just have no vertex normals.
        """
        mesh = self.mesh
        return (
            self.look(),
            mesh.has_vertex_normals(),
            mesh.has_vertex_texcoords(),
            mesh.has_flipped_normals(),
        )

    def look(self) -> tuple:
        """Return the materials as something to compare."""
        return tuple(sorted((name, id(value)) for name, value in self.materials.items()))


def merge_emitters(scene: dict, keep=()) -> MergedScene:
    """Return a scene in which emissive meshes that differ in place and colour only are one mesh.

    They are ``rectangle``, ``cube``, ``obj``, ``ply``, ``serialized`` and ``mi.Mesh`` with an
    ``area`` emitter of constant radiance, and have the same BSDF, media and flags. Equal BSDFs are
    the same. All others stay as they are: textured ones, and those that another part of the
    scene refers to, or to a part of which. In spectral variants all stay, since an attribute has
    another spectrum there than a light. Where the integrator has light groups, a mesh has lamps of
    one of their entries, and the key and the ids of the first lamp.

    The image is the same, up to noise. ``mi.traverse`` shows the mesh, not its lamps. The result
    has objects of the current variant; ``scene`` is not changed.

    Args:
        scene: a dictionary for ``mi.load_dict``.
        keep: ids of shapes that stay as they are, as for ``mi.traverse``.

    Returns:
        A dictionary, with the ids of the shapes of each mesh in its attribute ``merged``. The id
        of a mesh says how many they are: ``merged_3_emitters``.

    Raises:
        ValueError: the scene's integrator is one of Mitsuba's: it would lose light. Or the scene is
            not a dictionary, ``keep`` not a list, or a shape in it not in the scene.
    """
    require_variant()
    check("scene", scene, isinstance(scene, dict), "a dictionary for mi.load_dict")
    listed = isinstance(keep, Iterable) and not isinstance(keep, str)
    check("keep", keep, listed, "a list of ids")
    config = mi.parser.ParserConfig(mi.variant())
    state = mi.parser.parse_dict(config, scene)
    _check_integrators(state)
    keep = list(keep)
    _check_shapes(state, keep)
    indices = state.id_to_index
    keep = {*keep, *_referred_shapes(state, indices)}
    definitions = {key: _index(state.root.props, key) for key, _ in state.root.props.items()}
    _prepare(config, state)
    merging = _Merging(state, keep)
    result = MergedScene(scene)
    result.merged = {name: [lamp.id for lamp in lamps] for name, lamps in merging.groups.items()}
    for lamps in merging.groups.values():
        for lamp in lamps:
            del result[lamp.key]
    shared = _shared_objects(merging, result, definitions)
    by_name = {name: shared[index] for name, index in indices.items() if index in shared}
    for key, value in list(result.items()):
        result[key] = _with_objects(value, by_name)
    for key, index in definitions.items():
        if key in result and index in shared:
            # Mitsuba names an object after the last key that it finds it under
            del result[key]
            result[key] = shared[index]
    result.update(merging.meshes)
    return result


def merge_parsed(config, state) -> dict[str, list[str]]:
    """Merge the emissive meshes of a parsed scene, in place.

    Nothing is done unless all integrators are ours and none shows which shape a pixel has.

    Returns:
        As ``MergedScene.merged``.
    """
    if not _all_ours(state) or shows_indices(state):
        return {}
    _prepare(config, state)
    merging = _Merging(state, ())
    for lamps in merging.groups.values():
        for lamp in lamps:
            del state.root.props[lamp.key]
    for node in state.nodes if merging.used else ():
        for key, value in list(node.props.items()):
            if isinstance(value, Reference) and value.index() in merging.used:
                node.props[key] = merging.objects[value.index()]
    for name, mesh in merging.meshes.items():
        state.root.props[name] = mesh
    return {name: [lamp.id for lamp in lamps] for name, lamps in merging.groups.items()}


def shows_indices(state) -> bool:
    """Does an integrator of a parsed scene show the numbers of shapes or of their parts?"""
    lists = (node.props.get("aovs", "") for node in state.nodes if node.type == INTEGRATOR)
    return any(kind in channels.INDEX_TYPES for text in lists for kind in channels.aov_types(text))


def _prepare(config, state) -> None:
    """Make references to equal parts equal."""
    mi.parser.transform_resolve(config, state)
    mi.parser.transform_merge_equivalent(config, state)


def _all_ours(state) -> bool:
    leaves = leaf_integrators(state)
    return bool(leaves) and all(node.props.plugin_name() in PARAMETERS for node in leaves)


def _check_integrators(state) -> None:
    names = [node.props.plugin_name() for node in leaf_integrators(state)]
    objects = [value for _, value in state.root.props.items() if isinstance(value, mi.Integrator)]
    names += [value.class_name() for value in objects]
    ours = {*PARAMETERS, "ManyLightsDirect", "ManyLightsVolpath"}
    for name in names:
        if name not in ours:
            raise ValueError(
                f"merge_emitters: the integrator {name} finds no light on merged emitters, "
                f"use {' or '.join(PARAMETERS)}"
            )


def _check_shapes(state, ids: list) -> None:
    """Refuse ids to keep that no shape of the scene has, as its key or as its own."""
    keys = sorted((index, name) for name, index in state.id_to_index.items())
    known = [name for index, name in keys if state.nodes[index].type == SHAPE]
    known += [node.props.id() for node in state.nodes if node.type == SHAPE]
    items = state.root.props.items()
    known += [key for key, value in items if isinstance(value, mi.Shape)]
    known = dict.fromkeys(filter(None, known))
    for name in ids:
        if not isinstance(name, str) or name not in known:
            what = f"{argument('keep')} {shown(name)}: the scene has no shape of this id"
            raise UsageError(f"{what}, {near(name, known)}")


def _index(props, key: str) -> int | None:
    value = props[key]
    return value.index() if isinstance(value, Reference) else None


def _referred_shapes(state, indices: dict[str, int]) -> set[str]:
    """Return the keys of all entries of a dictionary that are, or hold, what others refer to."""
    references = mi.Properties.Reference
    values = (value for node in state.nodes for _, value in node.props.items())
    names = {value.id() for value in values if isinstance(value, references)}
    paths = (state.node_paths[indices[name]] for name in names if name in indices)
    return {path.split(".")[0] for path in paths}


def _shared_objects(merging: _Merging, rest: dict, definitions: dict) -> dict[int, object]:
    """Return the objects in merged meshes that entries of the scene define, by node."""
    shared = {}
    for key, index in definitions.items():
        if key in rest and index is not None:
            canonical = _index(merging.state.root.props, key)
            if canonical in merging.used:
                shared[index] = merging.objects[canonical]
    return shared


def _with_objects(value, by_name: dict[str, object]):
    """Return a part of a scene with objects in place of the references to them."""
    if not isinstance(value, dict):
        return value
    if value.get("type") == "ref":
        return by_name.get(value.get("id"), value)
    return {key: _with_objects(part, by_name) for key, part in value.items()}


class _Merging:
    """Finds the lamps of a parsed scene and makes a mesh of each kind.

    Attributes:
        groups: lamps by the name of their mesh.
        meshes: those meshes.
        objects: what was made of nodes, by index.
        used: indices of those that are parts of ``meshes``.
    """

    def __init__(self, state, keep) -> None:
        # Threads take longer to start than the small parts to make
        self.config = mi.parser.ParserConfig(mi.variant())
        self.config.parallel = False
        self.state, self.objects = state, {}
        self.groups, self.meshes, self.used = {}, {}, set()
        nodes = leaf_integrators(state)
        asked = {node.props.get(light_groups.PARAMETER, "") for node in nodes}
        objects = [
            value for _, value in state.root.props.items() if isinstance(value, mi.Integrator)
        ]
        asked |= {light_groups.of_integrator(each) for each in objects}
        self.light_groups = sorted(asked - {""})
        if "spectral" in mi.variant():
            return
        items = [item for item in state.root.props.items() if item[0] not in keep]
        lamps = [_try(self._lamp, *item) for item in items]
        lamps = [lamp for lamp in lamps if lamp is not None and lamp.id not in keep]
        # A file is not read for nothing if its lamp is the only one
        lamps = [lamp for group in _groups(lamps, Lamp.look) for lamp in group]
        lamps = [lamp for lamp in lamps if _try(self._load, lamp)]
        for group in _groups(lamps, lambda lamp: (lamp.kind(), self._light_groups(lamp))):
            self._merge(group)

    def _light_groups(self, lamp: Lamp) -> tuple:
        """Return which entry of the light groups of each integrator a lamp belongs to."""
        return tuple(light_groups.entry_of(text, *lamp.names) for text in self.light_groups)

    def _merge(self, lamps: list[Lamp]) -> None:
        key = name = f"merged_{len(lamps)}_emitters"
        while name in self.groups or name in self.state.root.props:
            key = name = f"{name}_more"
        if self.light_groups:
            key, name = lamps[0].key, lamps[0].id
        mesh = _join(name, lamps)
        if self.light_groups:
            # By these it belongs to the groups of its lamps.
            mesh.set_id(lamps[0].names[1])
        self.groups[name], self.meshes[key] = lamps, mesh
        for lamp in lamps:
            self._use(lamp.uses)
        mi.Log(mi.LogLevel.Info, f"{name}: {', '.join(lamp.id for lamp in lamps)}")

    def _use(self, indices: set[int]) -> None:
        """Note that a merged mesh has these nodes, and those inside of them."""
        new = indices - self.used
        self.used |= new
        for index in new:
            values = (value for _, value in self.state.nodes[index].props.items())
            self._use({value.index() for value in values if isinstance(value, Reference)})

    def _lamp(self, key: str, value) -> Lamp | None:
        """Return an entry of the scene as a lamp, None if it is none or cannot be merged."""
        if isinstance(value, mi.Mesh):
            return self._lamp_of_object(key, value)
        if isinstance(value, Reference):
            return self._lamp_of_node(key, self.state.nodes[value.index()].props)
        return None

    def _lamp_of_node(self, key: str, props) -> Lamp | None:
        plugin = props.plugin_name()
        emitters = [value for _, value in props.items() if self._is(value, "Emitter")]
        if plugin not in GEOMETRY or len(emitters) != 1:
            return None
        radiance = self._radiance(emitters[0])
        geometry, materials, uses = mi.Properties(plugin), {}, set()
        for name, value in props.items():
            if name in (*SHARED_GEOMETRY, *GEOMETRY[plugin]):
                geometry[name] = value
            elif self._is(value, "BSDF") or self._is(value, "Medium"):
                materials["bsdf" if self._is(value, "BSDF") else name] = self._object(value)
                uses |= {value.index()} if isinstance(value, Reference) else set()
            elif not self._is(value, "Emitter"):
                return None
        if radiance is None:
            return None
        names = (self._id(emitters[0]), props.id())
        return Lamp(key, props.id() or key, geometry, radiance, materials, uses, names)

    def _load(self, lamp: Lamp) -> bool:
        """Make the mesh of a lamp; return whether all that it has can be merged."""
        if isinstance(lamp.mesh, mi.Properties):
            lamp.mesh = self._make(lamp.mesh)
        return not lamp.mesh.has_mesh_attributes()

    def _lamp_of_object(self, key: str, mesh) -> Lamp | None:
        emitter = mesh.emitter()
        names = mi.traverse(mesh).keys()
        known = (name in MESH_PARAMETERS or name.startswith(MESH_CHILDREN) for name in names)
        if emitter is None or not all(known):
            return None
        radiance = _constant_radiance(emitter)
        if radiance is None or mesh.parameters_grad_enabled():
            return None
        materials = {"interior": mesh.interior_medium(), "exterior": mesh.exterior_medium()}
        materials["bsdf"] = None if _is_black(mesh.bsdf()) else mesh.bsdf()
        materials = {name: part for name, part in materials.items() if part is not None}
        # An object is called by its key.
        return Lamp(key, key, mesh, radiance, materials, set(), (emitter.id(), key))

    def _is(self, value, kind: str) -> bool:
        """Is this part of a shape, a node or an object, an "Emitter", a "BSDF" or a "Medium"?"""
        if isinstance(value, Reference):
            return self.state.nodes[value.index()].type == getattr(mi.ObjectType, kind)
        return isinstance(value, getattr(mi, kind))

    def _id(self, value) -> str:
        """Return the id of a node or an object."""
        if isinstance(value, Reference):
            return self.state.nodes[value.index()].props.id()
        return value.id()

    def _radiance(self, value) -> np.ndarray | None:
        """Return the three channels that an emitter emits everywhere, None if it varies."""
        if isinstance(value, Reference):
            props = self.state.nodes[value.index()].props
            color = props.get("radiance", None)
            plain = (props.plugin_name(), list(props.keys())) == ("area", ["radiance"])
            if plain and isinstance(color, mi.ScalarColor3d):
                # The common case, ten times as fast as to make an emitter
                return np.array(color, dtype=np.float32)
        return _constant_radiance(self._object(value))

    def _object(self, value):
        """Return what Mitsuba makes of a node, the same object each time."""
        if not isinstance(value, Reference):
            return value
        index = value.index()
        if index not in self.objects:
            node = self.state.nodes[index].props
            props = mi.Properties(node)
            for name, part in node.items():
                if isinstance(part, Reference):
                    props[name] = self._object(part)
            self.objects[index] = self._make(props)
        return self.objects[index]

    def _make(self, props):
        node = mi.parser.SceneNode()
        node.type = mi.PluginManager.instance().plugin_type(props.plugin_name())
        node.props = props
        state = mi.parser.ParserState()
        state.nodes.append(node)
        return parsing.make_objects(self.config, state)


def _try(function, *arguments):
    """Return what a function does, None where Mitsuba cannot; it says so when it loads."""
    try:
        return function(*arguments)
    except RuntimeError:
        return None


def _groups(lamps: list[Lamp], key) -> list[list[Lamp]]:
    """Return the lamps that have something in common with others."""
    found: dict[tuple, list[Lamp]] = {}
    for lamp in lamps:
        found.setdefault(key(lamp), []).append(lamp)
    return [group for group in found.values() if len(group) > 1]


def _constant_radiance(emitter) -> np.ndarray | None:
    """Return the three channels of what an area emitter emits everywhere, None if it varies."""
    if emitter.class_name() != "AreaLight":
        return None
    parameters = mi.traverse(emitter)
    if set(parameters.keys()) != {"sampling_weight", "radiance.value"}:
        return None
    value = parameters["radiance.value"]
    if parameters["sampling_weight"] != 1.0 or dr.grad_enabled(value):
        return None
    channels = np.ravel(np.array(value, dtype=np.float32))
    return np.broadcast_to(channels, 3) if channels.size in (1, 3) else None


def _is_black(bsdf) -> bool:
    """Is this what Mitsuba gives an emissive shape without a BSDF?"""
    parameters = mi.traverse(bsdf)
    if bsdf.class_name() != "SmoothDiffuse" or list(parameters.keys()) != ["reflectance.value"]:
        return False
    return not np.any(np.array(parameters["reflectance.value"]))


def _join(name: str, lamps: list[Lamp]):
    """Make one mesh of lamps of one kind."""
    first = lamps[0].mesh
    props = mi.Properties()
    for key, value in lamps[0].materials.items():
        props[key] = value
    props["flip_normals"] = first.has_flipped_normals()
    radiance = {"type": "mesh_attribute", "name": "face_color"}
    props["emitter"] = mi.load_dict({"type": "area", "radiance": radiance})
    counts = [lamp.mesh.face_count() for lamp in lamps]
    sizes = [lamp.mesh.vertex_count() for lamp in lamps]
    mesh = mi.Mesh(
        name,
        sum(sizes),
        sum(counts),
        props=props,
        has_vertex_normals=first.has_vertex_normals(),
        has_vertex_texcoords=first.has_vertex_texcoords(),
    )
    colors = np.repeat([lamp.radiance for lamp in lamps], counts, axis=0)
    mesh.add_attribute("face_color", 3, np.ravel(colors))
    begins = np.repeat(np.cumsum([0, *sizes[:-1]]), 3 * np.array(counts))
    parameters = mi.traverse(mesh)
    parameters["faces"] = (_all(lamps, "faces") + begins).astype(np.uint32)
    for part in ("vertex_positions", "vertex_normals", "vertex_texcoords"):
        if len(parameters[part]):
            parameters[part] = _all(lamps, part)
    parameters.update()
    mesh.set_id(name)
    mesh.emitter().set_id(lamps[0].names[0])
    return mesh


def _all(lamps: list[Lamp], part: str) -> np.ndarray:
    """Return a buffer of all lamps, one after the other."""
    return np.concatenate([np.array(getattr(lamp.mesh, f"{part}_buffer")()) for lamp in lamps])
