"""Finds what a stage draws, and each place where it is drawn.

A :class:`Batch` is a number of equal copies: the whole stage is one with a single copy, and so are
the instances of a prototype, of a ``PointInstancer`` or native ones. Instancers inside of
prototypes give batches with one copy for each combination, so a batch never nests another.

Matrices are those of USD: a point is a row vector, ``p @ M``.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdLux

from manylights.errors import one_line
from manylights.usd.context import Context
from manylights.usd.instance_keys import InstanceKeys
from manylights.usd.primvars import Sizes, display_color, integers

#: More copies than this of one prototype do not fit into memory.
LARGEST_BATCH = 20_000_000

#: Instancers that instance each other reach this soon, others never.
MOST_BATCHES = 100_000

#: What is drawn by itself, also in native instances.
PROXIES = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)

#: Instancers with more colors than this would become too many groups of instances.
MOST_COLORS = 256

#: Types that only hold others, and types that others look up.
CONTAINERS = ("Xform", "Scope", "SkelRoot", "Camera", "Skeleton", "LightFilter")
LOOKED_UP = ("Material", "Shader", "NodeGraph", "GeomSubset")


@dataclass
class Item:
    """A light or a geometry that is drawn.

    Attributes:
        prim: the prim, an instance proxy in native instances.
        local: ``(4, 4)`` to the space of its batch.
        role: ``"light"`` or ``"geometry"``; meshes that are lights are geometry.
    """

    prim: Usd.Prim
    local: np.ndarray
    role: str


@dataclass
class Batch:
    """Items, and the transforms with which all of them are drawn.

    Attributes:
        transforms: ``(n, 4, 4)`` to the world.
        items: in the order of the stage.
        instancers: paths of the point instancers that they are in.
        outer: ``(k, 4, 4)`` of native instances: where ``!resetXformStack!`` leads to, to which
            every k copies return. ``None``: to the batch.
        color: that an instancer gives these instances, ``(3,)`` or ``None``.
    """

    transforms: np.ndarray
    items: list[Item] = field(default_factory=list)
    instancers: tuple[Sdf.Path, ...] = ()
    outer: np.ndarray | None = None
    color: np.ndarray | None = None

    def worlds(self, item: Item) -> np.ndarray:
        """Return the transforms of an item to the world, ``(n, 4, 4)``."""
        return item.local @ self.transforms


@dataclass
class _State:
    """What prims inherit: transform, purpose, and the instancers that they are in.

    And which purposes are hidden (``VisibilityAPI``). Whether a prim's own transform is that to the
    world is not inherited.
    """

    matrix: np.ndarray
    purpose: str | None = None
    chain: tuple[Sdf.Path, ...] = ()
    resets: bool = False
    hidden: frozenset[str] = frozenset()

    def inside(self, *chain: Sdf.Path) -> _State:
        """Return what a prototype inherits, or what begins anew, in further instancers."""
        return _State(np.eye(4), self.purpose, (*self.chain, *chain), hidden=self.hidden)

    def is_drawn(self, purposes: tuple[str, ...]) -> bool:
        """Is it of one of these purposes, which is not hidden?"""
        purpose = self.purpose or UsdGeom.Tokens.default_
        return purpose in purposes and purpose not in self.hidden


def collect(context: Context) -> list[Batch]:
    """Return all that a stage draws with the context's time and purposes.

    Left out is what is invisible or inactive, and prototypes by themselves. Notes say which prims
    have broken transforms, which instancers lack prototypes, and which types are unknown.
    """
    return _Traversal(context).run()


def local_matrix(xformable: UsdGeom.Xformable, time: Usd.TimeCode) -> np.ndarray:
    """Return a prim's own transform; samples count at the default time where there is no default.

    Raises:
        ValueError: it is not finite.
    """
    if time.IsDefault() and xformable.TransformMightBeTimeVarying():
        matrix = np.eye(4)
        for op in xformable.GetOrderedXformOps():
            sampled = op.GetAttr().Get() is None and op.GetNumTimeSamples()
            at = Usd.TimeCode.EarliestTime() if sampled else time
            matrix = np.array(op.GetOpTransform(at)) @ matrix
    else:
        matrix = np.array(xformable.GetLocalTransformation(time))
    if not np.isfinite(matrix).all():
        raise ValueError("its transform is not finite")
    return matrix


class _Traversal:
    """Walks a stage; prototypes wait until all their instances of one batch are known."""

    def __init__(self, context: Context) -> None:
        self.context = context
        self.batches: list[Batch] = []
        self._waiting: list[tuple] = []
        self._native: dict[tuple, list[tuple[Usd.Prim, _State]]] = {}
        self._roles: dict[tuple, str] = {}
        self._keys = InstanceKeys(context)

    def run(self) -> list[Batch]:
        """Return the batches, see :func:`collect`."""
        batch = Batch(np.eye(4)[None])
        root = self.context.stage.GetPseudoRoot()
        self._walk(root, _State(np.eye(4)), batch, PROXIES)
        while self._waiting:
            self._walk(*self._waiting.pop())
        return [batch for batch in self.batches if batch.items]

    def _walk(self, root: Usd.Prim, state: _State, batch: Batch, predicate) -> None:
        """Add what is drawn at and below a prim, the transform of which is in the batch's."""
        self.batches.append(batch)
        stack = [(root, state)]
        while stack:
            prim, state = stack.pop()
            try:
                below = self._visit(prim, state, batch, prim == root)
            except (TypeError, ValueError, Tf.ErrorException) as error:
                text = f"a prim and all below it was left out: {one_line(error)}"
                self.context.notes.add("prim", text, prim)
                continue
            if below is not None:
                children = prim.GetFilteredChildren(predicate)
                stack.extend((child, below) for child in reversed(children))
        self._flush_native(batch)

    def _visit(self, prim: Usd.Prim, state: _State, batch: Batch, is_root: bool) -> _State | None:
        """Add a prim; return what its children inherit, None if they are not drawn."""
        if prim.IsPseudoRoot():
            return state
        role = self._role(prim)
        if role == "foreign":
            text = f"prims of the foreign type {prim.GetTypeName()} are left out"
            self.context.notes.add(f"type {prim.GetTypeName()}", text, prim)
        if role in ("untyped", "foreign", "looked up"):
            return None if role == "looked up" else state
        imageable = UsdGeom.Imageable(prim)
        if self.context.value(imageable.GetVisibilityAttr()) == UsdGeom.Tokens.invisible:
            return None
        state = self._enter(prim, imageable, state, is_root)
        if state.resets and batch.outer is not None:
            self._wait_outside(prim, state, batch)
            return None
        if prim.IsInstance() and not is_root:
            inherited = (state.purpose, state.hidden)
            key = (prim.GetPrototype().GetPath(), *inherited, *self._keys.of(prim))
            self._native.setdefault(key, []).append((prim, state))
            return None
        if state.is_drawn(self.context.purposes):
            if role == "instancer":
                self._expand(UsdGeom.PointInstancer(prim), state, batch)
            elif role in ("light", "geometry"):
                batch.items.append(Item(prim, state.matrix, role))
                if prim.GetTypeName() == "GeometryLight":
                    self._keys.point_to(prim)
            elif role == "unknown":
                text = f"prims of type {prim.GetTypeName()} are left out"
                self.context.notes.add(f"type {prim.GetTypeName()}", text, prim)
        return None if role == "instancer" else state

    def _role(self, prim: Usd.Prim) -> str:
        kind = (prim.GetTypeName(), tuple(prim.GetAppliedSchemas()))
        if kind not in self._roles:
            self._roles[kind] = _role_of(prim)
        return self._roles[kind]

    def _enter(self, prim, imageable, state: _State, is_root: bool) -> _State:
        """Return the state with a prim's own purpose and transform."""
        purpose, matrix, resets = state.purpose, state.matrix, False
        authored = imageable.GetPurposeAttr()
        if authored and authored.HasAuthoredValue():
            purpose = authored.Get()
        xformable = UsdGeom.Xformable(prim)
        if xformable and not is_root and prim.HasProperty("xformOpOrder"):
            own = local_matrix(xformable, self.context.time)
            resets = xformable.GetResetXformStack()
            matrix = own if resets else own @ matrix
        return _State(matrix, purpose, state.chain, resets, _hidden(prim, state.hidden))

    def _flush_native(self, batch: Batch) -> None:
        """Make one batch of all native instances of a prototype that look the same."""
        groups, self._native = self._native, {}
        outer = batch.transforms if batch.outer is None else batch.outer
        for members in itertools.chain(*map(self._keys.apart, groups.values())):
            prim, state = members[0]
            matrices = np.stack([member.matrix for _, member in members])
            self._wait(prim, state.inside(), matrices, batch, PROXIES, outer=outer)

    def _wait_outside(self, prim: Usd.Prim, state: _State, batch: Batch) -> None:
        """Make a batch of a prim that does not move with the native instances that it is in."""
        outside = Batch(batch.outer, color=batch.color)
        times = len(batch.transforms) // len(batch.outer)
        matrices = np.tile(state.matrix, (times, 1, 1))
        self._wait(prim, state.inside(), matrices, outside, PROXIES, outer=batch.outer)

    def _expand(self, instancer: UsdGeom.PointInstancer, state: _State, batch: Batch) -> None:
        """Make one batch of all instances of each prototype and color."""
        prim, notes = instancer.GetPrim(), self.context.notes
        if prim.GetPath() in state.chain:
            notes.add("cycle", "a PointInstancer that instances itself was left out there", prim)
            return
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        indices, matrices, numbers = self._instances(instancer, len(targets))
        colors, color_of = self._colors(instancer, numbers)
        inside = state.inside(prim.GetPath())
        groups = indices * len(colors) + color_of
        for group in np.unique(groups):
            index, color = divmod(int(group), len(colors))
            root, chosen = self.context.stage.GetPrimAtPath(targets[index]), groups == group
            if not root:
                text = f"a PointInstancer has no prototype {targets[index]}"
                notes.add("prototype", text, prim, int(chosen.sum()))
                continue
            predicate = Usd.PrimIsActive & Usd.PrimIsLoaded
            if root.IsDefined():
                predicate = predicate & Usd.PrimIsDefined
            if not root.IsAbstract():
                predicate = predicate & ~Usd.PrimIsAbstract
            predicate = Usd.TraverseInstanceProxies(predicate)
            if root.IsActive():
                places = matrices[chosen] @ state.matrix
                self._wait(root, inside, places, batch, predicate, color=colors[color])

    def _colors(self, instancer: UsdGeom.PointInstancer, numbers: np.ndarray):
        """Return the colors of an instancer's instances, and which of them each instance has.

        Args:
            instancer: with displayColor for each instance, or without.
            numbers: ``(n,)``, which ones are wanted.
        """
        prim, notes = instancer.GetPrim(), self.context.notes
        primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("displayColor")
        if not len(numbers) or not primvar or primvar.GetInterpolation() == "constant":
            return [None], 0
        count = len(self.context.value(instancer.GetProtoIndicesAttr()))
        values = display_color(prim, Sizes(count, count, count), self.context)[0]
        if values is None:
            return [None], 0
        rows = np.broadcast_to(values.array, (count, 3))[numbers]
        colors, color_of = np.unique(rows, axis=0, return_inverse=True)
        if len(colors) > MOST_COLORS:
            text = f"the {len(colors)} colors of an instancer are more than {MOST_COLORS}: not used"
            notes.add("instance colors", text, prim)
            return [None], 0
        return colors, np.ravel(color_of)

    def _instances(self, instancer: UsdGeom.PointInstancer, prototypes: int):
        """Return prototype, matrix and number of each visible instance.

        They have the shapes ``(n,)``, ``(n, 4, 4)`` and ``(n,)``.
        """
        prim, notes, time = instancer.GetPrim(), self.context.notes, self.context.time
        empty = np.zeros(0, dtype=np.int64)
        none = empty, np.zeros((0, 4, 4)), empty
        indices = self.context.value(instancer.GetProtoIndicesAttr())
        if indices is None or not len(indices):
            return none
        indices = integers(indices)
        if time.IsDefault() and instancer.GetPositionsAttr().Get() is None:
            time = Usd.TimeCode.EarliestTime()
        # With a mask applied the matrices would be fewer than the indices. Prototypes that are
        # missing or out of range are an error for the function that includes their transforms.
        matrices = instancer.ComputeInstanceTransformsAtTime(
            time, time, UsdGeom.PointInstancer.ExcludeProtoXform, UsdGeom.PointInstancer.IgnoreMask
        )
        matrices = np.array(matrices, dtype=np.float64).reshape(-1, 4, 4)
        mask = np.array(instancer.ComputeMaskAtTime(time), dtype=bool)
        if len(matrices) != len(indices) or len(mask) not in (0, len(indices)):
            text = f"a PointInstancer with {len(indices)} protoIndices has arrays of other sizes"
            notes.add("instancer", f"{text}: left out", prim)
            return none
        for attribute in (instancer.GetScalesAttr(), instancer.GetOrientationsAttr()):
            values = self.context.value(attribute)
            if values is not None and len(values) not in (0, len(indices)):
                text = f"a PointInstancer with {len(indices)} protoIndices has {len(values)}"
                notes.add("instancer", f"{text} {attribute.GetName()}, which were ignored", prim)
        keep = mask if len(mask) else np.ones(len(indices), dtype=bool)
        bad = (indices < 0) | (indices >= prototypes) | ~np.isfinite(matrices).all(axis=(1, 2))
        if (bad & keep).any():
            text = "an instance with an index out of range or a transform that is not finite"
            notes.add("instance", f"{text} was left out", prim, int((bad & keep).sum()))
        keep = keep & ~bad
        matrices = self._with_prototypes(instancer, indices[keep], matrices[keep])
        return indices[keep], matrices, np.flatnonzero(keep)

    def _with_prototypes(self, instancer, indices, matrices) -> np.ndarray:
        """Return instances' matrices with the transform of each prototype's root before."""
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        for index in np.unique(indices):
            xformable = UsdGeom.Xformable(self.context.stage.GetPrimAtPath(targets[index]))
            if not xformable:
                continue
            try:
                own = local_matrix(xformable, self.context.time)
            except ValueError as error:
                own = np.zeros((4, 4))
                self.context.notes.add("transform", f"a prototype: {error}", xformable.GetPrim())
            chosen = indices == index
            matrices[chosen] = own @ matrices[chosen]
        return matrices

    def _wait(self, root, state: _State, matrices, batch: Batch, predicate, **look) -> None:
        """Remember a prototype to walk through once for all its copies.

        Args:
            root: of the prototype.
            state: that it inherits.
            matrices: ``(n, 4, 4)`` of the copies.
            batch: that they are in.
            predicate: of the prims to walk through.
            look: ``outer`` and ``color`` of the new batch. Default: none, that of ``batch``.
        """
        count = len(matrices) * len(batch.transforms)
        if count > LARGEST_BATCH or len(self.batches) > MOST_BATCHES:
            text = (
                f"instances were left out, there are more than {LARGEST_BATCH} or nested too often"
            )
            self.context.notes.add("instances", text, root, count)
            return
        transforms = (matrices[:, None] @ batch.transforms[None]).reshape(-1, 4, 4)
        if look.get("color") is None:
            look["color"] = batch.color
        batch = Batch(transforms, instancers=state.chain, **look)
        self._waiting.append((root, state, batch, predicate))


def _hidden(prim: Usd.Prim, above: frozenset[str]) -> frozenset[str]:
    """Return which purposes are hidden at a prim: the nearest opinion above it counts.

    As ``ComputeEffectiveVisibility``, but that knows neither instancers nor who asks for guides.
    """
    if not prim.HasAPI(UsdGeom.VisibilityAPI):
        return above
    api, hidden = UsdGeom.VisibilityAPI(prim), set(above)
    for purpose in (UsdGeom.Tokens.render, UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide):
        attribute = api.GetPurposeVisibilityAttr(purpose)
        if attribute.HasAuthoredValue():
            hidden.discard(purpose)
            hidden |= {purpose} if attribute.Get() == UsdGeom.Tokens.invisible else set()
    return frozenset(hidden)


def _role_of(prim: Usd.Prim) -> str:
    name = str(prim.GetTypeName())
    if name in LOOKED_UP:
        return "looked up"
    if prim.IsA(UsdGeom.PointInstancer):
        return "instancer"
    if prim.IsA(UsdGeom.Gprim):
        return "geometry"
    if prim.HasAPI(UsdLux.LightAPI):
        return "light"
    if not prim.IsA(UsdGeom.Imageable):
        known = not name or Usd.SchemaRegistry.IsConcrete(name)
        return "untyped" if known else "foreign"
    return "container" if name in CONTAINERS else "unknown"
