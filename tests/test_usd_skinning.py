"""Skinned meshes of USD stages: points at a time, against the motion of the one joint."""

from __future__ import annotations

import pytest

pytest.importorskip("pxr")

from manylights.usd.geometry import surfaces_of
from manylights.usd.skinning import bake

from tests.usd_surfaces import context_of, stage_of

CHARACTER = """def Xform "character" {
    def SkelRoot "r" {
        def Skeleton "s" (
            prepend apiSchemas = ["SkelBindingAPI"]
        ) {
            uniform token[] joints = ["j"]
            uniform matrix4d[] bindTransforms = [((1,0,0,0), (0,1,0,0), (0,0,1,0), (0,0,0,1))]
            uniform matrix4d[] restTransforms = [((1,0,0,0), (0,1,0,0), (0,0,1,0), (0,0,0,1))]
            rel skel:animationSource = </character/r/s/a>
            def SkelAnimation "a" {
                uniform token[] joints = ["j"]
                float3[] translations.timeSamples = { 1: [(2, 0, 0)], 11: [(12, 0, 0)] }
                quatf[] rotations = [(1, 0, 0, 0)]
                half3[] scales = [(1, 1, 1)]
            }
        }
        def Mesh "m" (
            prepend apiSchemas = ["SkelBindingAPI"]
        ) {
            int[] faceVertexCounts = [3]
            int[] faceVertexIndices = [0, 1, 2]
            point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
            int[] primvars:skel:jointIndices = [0, 0, 0] (
                interpolation = "vertex"
                elementSize = 1
            )
            float[] primvars:skel:jointWeights = [1, 1, 1] (
                interpolation = "vertex"
                elementSize = 1
            )
            rel skel:skeleton = </character/r/s>
        }
    }
}
"""


@pytest.mark.parametrize(("time", "x"), [(1, 2), (4.5, 5.5), (11, 12), (None, 2)])
def test_points_follow_the_joint(time, x):
    context = context_of(stage_of(CHARACTER), time)
    bake(context)
    surface = surfaces_of(context.stage.GetPrimAtPath("/character/r/m"), context)[0]
    assert surface.positions.min(axis=0) == pytest.approx([x, 0, 0])
    assert not context.notes


def test_characters_in_instances_move_too():
    text = CHARACTER + "".join(
        f'def Xform "i{i}" (\ninstanceable = true\nprepend references = </character>\n) {{\n}}\n'
        for i in range(2)
    )
    context = context_of(stage_of(text), 11)
    bake(context)
    for name in ("character", "i0", "i1"):
        surface = surfaces_of(context.stage.GetPrimAtPath(f"/{name}/r/m"), context)[0]
        assert surface.positions.min(axis=0) == pytest.approx([12, 0, 0])
    assert not context.notes


def test_stages_without_skeletons_are_not_written_to():
    context = context_of(stage_of('def Cube "a" {}'))
    bake(context)
    assert context.stage.GetSessionLayer().empty


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("jointWeights = [1, 1, 1]", "jointWeights = [1, 1]"),
        ("jointIndices = [0, 0, 0]", "jointIndices = [0, 7, 0]"),
        ("Transforms = [((1,0,0,0), (0,1,0,0), (0,0,1,0), (0,0,0,1))]", "Transforms = []"),
    ],
)
def test_characters_that_cannot_be_skinned_are_noted(old, new):
    """USD only warns of them; their points are those at rest."""
    assert old in CHARACTER
    context = context_of(stage_of(CHARACTER.replace(old, new)), 11)
    bake(context)
    assert [note.kind for note in context.notes] == ["skinning"]
    assert "/character/r" in context.notes[0].text and "rest pose" in context.notes[0].text
