"""Skinned meshes: their points at the time that is read."""

from __future__ import annotations

from pxr import Gf, Tf, Usd, UsdSkel, UsdUtils

ANIMATED = ("translations", "rotations", "scales", "blendShapeWeights")
"""Attributes of an animation that move points."""


def bake(context) -> None:
    """Write the points of skinned meshes into the stage's session layer.

    Does nothing on stages without skeletons. Instances with skinned meshes become separate prims;
    characters that cannot be skinned are noted and stay in their rest pose.
    """
    stage, time = context.stage, context.time
    roots = _skinned(stage)
    if not roots:
        return
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        for _ in range(len(roots)):
            inside = [prim for prim in roots if prim.IsInstanceProxy()]
            if not inside:
                break
            _instance_of(inside[0]).SetInstanceable(False)
            roots = _skinned(stage)
        _hold_still(context)
        moment = Gf.Interval() if time.IsDefault() else Gf.Interval(time.GetValue())
        for prim in roots:
            if not prim.IsA(UsdSkel.Root):
                continue  # baked with the prim that it refers to
            reason = _bake(UsdSkel.Root(prim), moment)
            if reason:
                text = f"a skinned character stays, at least in part, in its rest pose: {reason}"
                context.notes.add("skinning", text, prim)


def _bake(root: UsdSkel.Root, moment: Gf.Interval) -> str:
    """Bake the skinning of one character; return what went wrong, empty if nothing did."""
    # Broken weights and joints are warnings only
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        whole = UsdSkel.BakeSkinning(root, moment)
    except Tf.ErrorException as error:
        return " ".join(str(error).split())[:200]
    finally:
        warnings = [each.commentary for each in delegate.TakeUncoalescedDiagnostics()]
    if warnings:
        return warnings[-1]
    return "" if whole else "its skinning is not whole"


def _skinned(stage) -> list:
    """Return the roots of skinned meshes, those in instances too."""
    prims = stage.Traverse(Usd.TraverseInstanceProxies())
    return [prim for prim in prims if prim.IsA(UsdSkel.Root)]


def _instance_of(prim):
    """Return the outermost instance that a prim is in."""
    found = prim
    while prim.GetParent():
        prim = prim.GetParent()
        found = prim if prim.IsInstance() and not prim.IsInstanceProxy() else found
    return found


def _hold_still(context) -> None:
    """Give animations the pose of one time: baking knows only times that have a sample."""
    for prim in context.stage.Traverse():
        if prim.IsA(UsdSkel.Animation):
            for name in ANIMATED:
                attribute = prim.GetAttribute(name)
                value = context.value(attribute)
                if value is not None:
                    attribute.Set(value)
