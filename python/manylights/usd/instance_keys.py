"""What tells native instances of one prototype apart, so that only equal ones become copies."""

from __future__ import annotations

from pxr import Sdf, Usd, UsdGeom, UsdLux, UsdShade

from manylights.usd.context import Context
from manylights.usd.stage import targets_of

#: Where materials are looked for, see ``Materials.bound``.
PURPOSES = (UsdShade.Tokens.full, UsdShade.Tokens.preview, UsdShade.Tokens.allPurpose)


class InstanceKeys:
    """Tells which instances look the same.

    Attributes:
        targets: paths of geometry that a ``GeometryLight`` found so far points to, and of all that
            is above it.
    """

    def __init__(self, context: Context) -> None:
        self.context = context
        self.targets: set[Sdf.Path] = set()
        self._inherited: dict[Sdf.Path, tuple[Sdf.Path, ...]] = {}
        self._queries: dict[Sdf.Path, tuple] = {}
        self._parts: dict[Sdf.Path, list[Sdf.Path]] = {}

    def of(self, prim: Usd.Prim) -> tuple:
        """Return a key that equal instances of one prototype share."""
        above = self._inheritance(prim)
        return above, self._memberships(prim, above), self._light_groups(prim)

    def point_to(self, light: Usd.Prim) -> None:
        """Remember what a ``GeometryLight`` shines from."""
        for target in targets_of(light, "geometry"):
            self.targets.update(target.GetPrefixes())

    def apart(self, instances: list[tuple]) -> list[list[tuple]]:
        """Split equal instances: each that a ``GeometryLight`` points into is by itself.

        Args:
            instances: tuples that begin with a prim.
        """
        if not self.targets:
            return [instances]
        parts, rest = [], []
        for instance in instances:
            if instance[0].GetPath() in self.targets:
                parts.append([instance])
            else:
                rest.append(instance)
        return [*parts, rest] if rest else parts

    def _inheritance(self, prim: Usd.Prim) -> tuple[Sdf.Path, ...]:
        """Return the ancestors whose material or primvars an instance inherits, itself included."""
        chain, path = [], prim.GetPath()
        while path not in self._inherited and not prim.IsPseudoRoot():
            chain.append(prim)
            prim, path = prim.GetParent(), path.GetParentPath()
        above = self._inherited.get(path, ())
        for prim in reversed(chain):
            path, names = prim.GetPath(), prim.GetAuthoredPropertyNames()
            if any(name.startswith(("material:binding", "primvars:")) for name in names):
                above = (*above, path)
                if any(name.startswith("material:binding:collection") for name in names):
                    self._queries[path] = _queries(prim)
            self._inherited[path] = above
        return above

    def _memberships(self, prim: Usd.Prim, above: tuple[Sdf.Path, ...]) -> tuple[bool, ...]:
        """Return which parts of an instance the collections that bind from above include."""
        queries = [query for path in above for query in self._queries.get(path, ())]
        if not queries:
            return ()
        paths = [prim.GetPath().AppendPath(part) for part in self._parts_of(prim)]
        return tuple(query.IsPathIncluded(path) for query in queries for path in paths)

    def _light_groups(self, prim: Usd.Prim) -> tuple:
        """Return which entries of the light groups what is below an instance belongs to."""
        groups = self.context.light_groups
        if not groups:
            return ()
        paths = [prim.GetPath().AppendPath(part) for part in self._parts_of(prim)]
        return tuple(groups.entry_of(str(path)) for path in paths)

    def _parts_of(self, prim: Usd.Prim) -> list[Sdf.Path]:
        """Return the paths of all that has a look in an instance, from there."""
        root = prim.GetPrototype().GetPath()
        if root not in self._parts:
            # The prototypes of an instancer may be abstract
            predicate = Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded)
            parts = Usd.PrimRange(prim.GetPrototype(), predicate)
            self._parts[root] = [
                part.GetPath().MakeRelativePath(root) for part in parts if _has_look(part)
            ]
        return self._parts[root]


def _has_look(prim: Usd.Prim) -> bool:
    """Is a prim a light, or does it have a material?"""
    if prim.IsA(UsdGeom.Boundable) or prim.IsA(UsdGeom.Subset):
        return True
    return prim.HasAPI(UsdLux.LightAPI)


def _queries(prim: Usd.Prim) -> tuple:
    """Return the members of the collections that a prim binds materials to."""
    binding = UsdShade.MaterialBindingAPI(prim)
    found = {}
    for purpose in PURPOSES:
        for bound in binding.GetCollectionBindings(purpose):
            collection = bound.GetCollection()
            found.setdefault(collection.GetCollectionPath(), collection)
    return tuple(collection.ComputeMembershipQuery() for collection in found.values())
