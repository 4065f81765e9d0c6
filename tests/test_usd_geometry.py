"""Geometry of USD stages against closed forms: areas, volumes, normals, values on corners."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pxr")

from hypothesis import given, settings
from hypothesis import strategies as st
from manylights.usd.triangulation import ear_clip, triangulate

from tests.usd_surfaces import (
    SQUARE,
    area,
    area_vectors,
    corners,
    kinds,
    mesh,
    only,
    read,
    volume,
)

TWO_SQUARES = """
    int[] faceVertexCounts = [4, 4]
    int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 5, 4]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (1, 1, 0), (2, 1, 0)]
"""
CUBE = """
    int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
    int[] faceVertexIndices = [0, 1, 3, 2, 2, 3, 5, 4,
        4, 5, 7, 6, 6, 7, 1, 0, 1, 7, 5, 3, 6, 0, 2, 4]
    point3f[] points = [(-1, -1, 1), (1, -1, 1), (-1, 1, 1), (1, 1, 1),
        (-1, 1, -1), (1, 1, -1), (-1, -1, -1), (1, -1, -1)]
"""


# --- faces ---


def test_square_has_its_area_and_faces_as_it_winds():
    surface = only(mesh(SQUARE))
    assert area_vectors(surface).sum(axis=0) == pytest.approx([0, 0, 4])
    assert surface.normals is None and not surface.double_sided


def test_left_handed_mesh_turns_the_winding_and_not_its_normals():
    body = SQUARE + 'uniform token orientation = "leftHanded"\n'
    body += 'normal3f[] normals = [(0, 0, 1)] (\ninterpolation = "constant"\n)'
    surface = only(mesh(body))
    assert area_vectors(surface).sum(axis=0) == pytest.approx([0, 0, -4])
    assert (surface.normals == [0, 0, 1]).all()


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ("(0,0,0), (2,0,0), (2,1,0), (1,1,0), (1,2,0), (0,2,0)", 3.0),  # L
        ("(0,0,0), (2,-1,0), (.5,0,0), (2,1,0)", 0.5),  # an arrow head, concave
        ("(2,1,0), (0,0,0), (2,-1,0), (.5,0,0)", 0.5),  # the same from another corner
        ("(0,0,0), (1,0,0), (1.3,.95,0), (.5,1.5,0), (-.3,.95,0)", 1.675),  # convex
    ],
)
@pytest.mark.parametrize("turn", range(3))
def test_polygons_of_any_shape_have_their_area(points, expected, turn):
    # Turned into all three planes; concave faces must not overlap themselves
    rolled = [
        np.roll([float(x) for x in p.strip(" ()").split(",")], turn) for p in points.split("),")
    ]
    body = f"""
        int[] faceVertexCounts = [{len(rolled)}]
        int[] faceVertexIndices = {list(range(len(rolled)))}
        point3f[] points = [{", ".join(str(tuple(map(float, p))) for p in rolled)}]"""
    surface = only(mesh(body))
    assert area(surface) == pytest.approx(expected, rel=1e-6)
    assert np.linalg.norm(area_vectors(surface).sum(axis=0)) == pytest.approx(expected, rel=1e-6)


@settings(deadline=None, derandomize=True, database=None, max_examples=60)
@given(
    st.lists(st.floats(0.1, 1), min_size=3, max_size=24),
    st.floats(-3, 3),
    st.floats(-1.2, 1.2),
)
def test_star_polygons_have_their_area(radii, turn, tilt):
    angle = 2 * np.pi * np.arange(len(radii)) / len(radii)
    flat = np.stack([radii * np.cos(angle), radii * np.sin(angle)], axis=1)
    x, y = flat.T
    expected = (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2
    points = np.stack([x * np.cos(tilt), y, x * np.sin(tilt)], axis=1)
    points[:, :2] = points[:, :2] @ [
        [np.cos(turn), np.sin(turn)],
        [-np.sin(turn), np.cos(turn)],
    ]
    triangles, faces = triangulate(points, np.array([len(radii)]), np.arange(len(radii)))
    p = points[triangles]
    areas = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1) / 2
    assert len(triangles) == len(radii) - 2 and not faces.any()
    assert areas.sum() == pytest.approx(expected, rel=1e-9)


def test_ears_end_for_polygons_that_cross_themselves():
    angle = 2 * np.pi * 2 * np.arange(5) / 5
    star = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert ear_clip(star).shape == (3, 3)
    assert ear_clip(np.zeros((6, 2))).shape == (4, 3)


def test_holes_and_degenerate_faces_have_no_triangles():
    body = TWO_SQUARES.replace("[4, 4]", "[4, 2, 4]").replace("3, 1, 2", "3, 0, 1, 1, 2")
    assert only(mesh(body)).face_of.tolist() == [0, 0, 2, 2]
    surface = only(mesh(TWO_SQUARES + "int[] holeIndices = [0]"))
    assert area(surface) == pytest.approx(1) and set(surface.face_of) == {1}


# --- values ---


def values_per_corner(surface, rows):
    return rows[surface.faces]


COUNTS = {"constant": 1, "uniform": 2, "vertex": 6, "varying": 6, "faceVarying": 8}
CORNERS = np.array([0, 1, 4, 3, 1, 2, 5, 4])


def expected_at_corners(values, interpolation):
    """Return what each of the eight corners of TWO_SQUARES has."""
    if interpolation == "constant":
        return np.repeat(values[:1], 8, axis=0)
    if interpolation == "uniform":
        return np.repeat(values, 4, axis=0)
    return values if interpolation == "faceVarying" else values[CORNERS]


def check_at_corners(surface, rows, expected, per="vertex"):
    """Compare values with those of the authored corners, which are found by place and face."""
    points = np.array([(x, y, 0) for y in (0, 1) for x in (0, 1, 2)])
    for triangle, face in enumerate(surface.face_of):
        for vertex in surface.faces[triangle]:
            place = np.flatnonzero((points == surface.positions[vertex]).all(axis=1))[0]
            corner = 4 * face + np.flatnonzero(CORNERS[4 * face : 4 * face + 4] == place)[0]
            row = rows[triangle if per == "face" else vertex]
            assert row == pytest.approx(expected[corner], abs=1e-6)


def usd_list(rows):
    return "[" + ", ".join(str(tuple(float(x) for x in row)) for row in rows) + "]"


@pytest.mark.parametrize("interpolation", COUNTS)
@pytest.mark.parametrize("indexed", [False, True])
@settings(deadline=None, derandomize=True, database=None, max_examples=12)
@given(data=st.data())
def test_primvars_of_every_interpolation_reach_their_corners(interpolation, indexed, data):
    count = COUNTS[interpolation]
    number = st.floats(0, 1, width=32)
    rows = data.draw(st.lists(st.tuples(number, number, number), min_size=count, max_size=count))
    rows = np.array(rows)
    indices, extra = "", ""
    values = rows
    if indexed:
        order = data.draw(st.lists(st.integers(0, count - 1), min_size=count, max_size=count))
        values = rows[order]
        indices = f"int[] primvars:displayColor:indices = {order}"
        extra = f"int[] primvars:st:indices = {order}"
    how = f'(\ninterpolation = "{interpolation}"\n)'
    body = f"""{TWO_SQUARES}
        color3f[] primvars:displayColor = {usd_list(rows)} {how}
        {indices}
        texCoord2f[] primvars:st = {usd_list(rows[:, :2])} {how}
        {extra}
        normal3f[] primvars:normals = {usd_list(rows)} {how}
        {extra.replace(":st:", ":normals:")}"""
    surface = only(mesh(body))
    expected = expected_at_corners(values, interpolation)
    check_at_corners(surface, surface.colors, expected, surface.colors_per)
    check_at_corners(surface, surface.uv, expected[:, :2])
    check_at_corners(surface, surface.normals, expected)


@pytest.mark.parametrize("kind", ["half3", "float3", "double3", "normal3f", "color3f", "vector3d"])
def test_normals_of_every_value_type(kind):
    body = SQUARE + f'{kind}[] primvars:normals = [(0, .5, 1)] (\ninterpolation = "uniform"\n)'
    assert only(mesh(body)).normals == pytest.approx(np.tile([0, 0.5, 1], (4, 1)))


@pytest.mark.parametrize("kind", ["half3", "float3", "double3", "point3d", "color3f"])
def test_points_of_every_value_type(kind):
    assert area(only(mesh(SQUARE.replace("point3f", kind)))) == pytest.approx(4)


def test_primvar_of_normals_beats_the_attribute():
    body = SQUARE + 'normal3f[] normals = [(1, 0, 0)] (\ninterpolation = "constant"\n)\n'
    body += 'normal3f[] primvars:normals = [(0, 1, 0)] (\ninterpolation = "constant"\n)'
    assert (only(mesh(body)).normals == [0, 1, 0]).all()


def test_blocked_indices_leave_values_as_they_are():
    body = SQUARE + "texCoord2f[] primvars:st = [(0,0), (1,0), (1,1), (0,1)] (\n"
    body += 'interpolation = "vertex"\n)\nint[] primvars:st:indices = None'
    assert only(mesh(body)).uv.tolist() == [[0, 0], [1, 0], [1, 1], [0, 1]]


def test_display_color_is_inherited_and_kept_for_faces():
    text = f"""def Xform "b" {{
        color3f[] primvars:displayColor = [(1, .5, 0)]
        def Mesh "a" {{ {SQUARE} }}
    }}"""
    surfaces, notes = read(text, "/b/a")
    assert not notes
    assert surfaces[0].colors_per == "face" and (surfaces[0].colors == [1, 0.5, 0]).all()


def test_several_texture_coordinates_are_kept_by_name():
    body = SQUARE + "texCoord2f[] primvars:map1 = [(5, 6)]\ntexCoord2f[] primvars:st = [(1, 2)]"
    surface = only(mesh(body))
    assert (surface.uv == [1, 2]).all() and (surface.uv_sets["map1"] == [5, 6]).all()


def test_time_samples_are_read_at_the_time_and_at_first_without_one():
    body = SQUARE.replace("point3f[] points =", "point3f[] points.timeSamples = { 0:")
    body = body.rstrip() + ",\n1: [(0,0,0), (1,0,0), (1,1,0), (0,1,0)] }\n"
    assert area(only(mesh(body), time=1)) == pytest.approx(1)
    assert area(only(mesh(body), time=0)) == pytest.approx(4)
    assert area(only(mesh(body))) == pytest.approx(4)


# --- subsets ---


def subset(name, faces):
    return f"""def GeomSubset "{name}" {{
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = {faces}
    }}\n"""


def test_subsets_and_the_rest_of_the_mesh_lose_nothing():
    surfaces, notes = read(mesh(TWO_SQUARES + subset("s", [1])))
    assert not notes
    assert [str(s.binding.GetPath()) for s in surfaces] == ["/a/s", "/a"]
    assert [s.face_of.tolist() for s in surfaces] == [[1, 1], [0, 0]]
    assert [area(s) for s in surfaces] == pytest.approx([1, 1])
    assert [len(s.positions) for s in surfaces] == [4, 4]


def test_overlapping_subsets_keep_the_first_and_say_so():
    surfaces, notes = read(mesh(TWO_SQUARES + subset("s", [0, 1]) + subset("t", [1, 7])))
    assert kinds(notes) == ["face indices", "subsets overlap"]
    assert sum(area(s) for s in surfaces) == pytest.approx(2)
    assert [s.face_of.tolist() for s in surfaces] == [[0, 0, 1, 1]]


def test_subsets_of_points_have_no_material_of_their_own():
    text = mesh(TWO_SQUARES + subset("s", [1]).replace('"face"', '"point"'))
    surfaces, notes = read(text)
    assert [str(s.binding.GetPath()) for s in surfaces] == ["/a"]
    assert "/a/s" in notes[0].text and "type point" in notes[0].text


@pytest.mark.parametrize("kind", ["texCoord3f", "texCoord3h", "texCoord3d"])
def test_texture_coordinates_of_three_numbers_lose_the_last(kind):
    values = f"{kind}[] primvars:uv = [(0, 1, 7), (1, 1, 7), (1, 0, 7), (0, 0, 7)] ("
    surface = only(mesh(SQUARE + values + '\ninterpolation = "vertex"\n)'))
    assert surface.uv_sets["uv"].tolist() == [[0, 1], [1, 1], [1, 0], [0, 0]]


def test_colors_of_four_numbers_lose_the_last_and_of_two_are_noted():
    surface = only(mesh(SQUARE + "color4f[] primvars:displayColor = [(1, 0, 0.5, 1)]"))
    assert (surface.colors == [1, 0, 0.5]).all()
    surfaces, notes = read(mesh(SQUARE + "float2[] primvars:displayColor = [(1, 0)]"))
    assert surfaces[0].colors is None
    assert "/a.primvars:displayColor" in notes[0].text and "3 numbers" in notes[0].text
    assert not read(mesh(SQUARE + "color4f[] primvars:displayColor = []"))[1]


# --- broken meshes ---


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[4]", "[5]", "add up to 5, faceVertexIndices has 4"),
        ("[4]", "[-4]", "has -4"),
        ("2, 3]", "2, 9]", "faceVertexIndices has 9, there are 4 points"),
        ("2, 3]", "2, -1]", "faceVertexIndices has -1"),
        ("[0, 1, 2, 3]", "[]", "faceVertexIndices has 0"),
        ("[4]", "[]", "no faces"),
        ("[4]", "[2, 2]", "fewer than three corners"),
        ("point3f[] points", "point3f[] other", "without points"),
    ],
)
def test_broken_meshes_are_left_out_with_a_note(old, new, message):
    surfaces, notes = read(mesh(SQUARE.replace(old, new)))
    assert not surfaces and len(notes) == 1
    assert message in notes[0].text and "/a" in notes[0].text


def test_faces_with_nan_are_left_out_and_the_others_stay():
    surfaces, notes = read(mesh(TWO_SQUARES.replace("(2, 0, 0)", "(nan, 0, 0)")))
    assert kinds(notes) == ["points not finite"]
    assert area(surfaces[0]) == pytest.approx(1) and np.isfinite(surfaces[0].positions).all()


def test_primvars_that_do_not_fit_are_left_out_with_a_note():
    body = SQUARE + 'texCoord2f[] primvars:st = [(0,0), (1,0)] (\ninterpolation = "vertex"\n)'
    surfaces, notes = read(mesh(body))
    assert surfaces[0].uv is None and "2 values do not fit" in notes[0].text
    body = SQUARE + 'texCoord2f[] primvars:st = [(3, 4)] (\ninterpolation = "vertex"\n)\n'
    surfaces, notes = read(mesh(body + "int[] primvars:st:indices = [0, 0, 7, -2]"))
    assert kinds(notes) == ["primvar indices"] and (surfaces[0].uv == [3, 4]).all()


# --- subdivision ---


def test_the_cage_stays_unless_a_scheme_is_authored_or_asked_for():
    assert volume(only(mesh(CUBE))) == pytest.approx(8)
    assert volume(only(mesh(CUBE + 'uniform token subdivisionScheme = "none"'))) == pytest.approx(8)
    assert volume(only(mesh(CUBE), subdivision=1)) < 8
    authored = CUBE + 'uniform token subdivisionScheme = "catmullClark"'
    assert volume(only(mesh(authored))) < 8
    assert volume(only(mesh(authored), subdivision=0)) == pytest.approx(8)
    none = CUBE + 'uniform token subdivisionScheme = "none"'
    assert volume(only(mesh(none), subdivision=2)) == pytest.approx(8)


def test_catmull_clark_of_a_cube_by_hand():
    surface = only(mesh(CUBE + "int mitsuba:subdivision_level = 1"))
    found = {tuple(np.abs(p).astype(float).round(6)) for p in surface.positions}
    assert found == {(0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 0.75, 0.75), (0.75, 0, 0.75)} | {
        (0.75, 0.75, 0),
        (0.555556, 0.555556, 0.555556),
    }
    assert len(surface.faces) == 48
    outside = np.einsum("mi,mki->mk", area_vectors(surface), surface.normals[surface.faces])
    assert (outside > 0).all()


def test_creases_keep_edges_and_corners_points():
    edges = "0,1, 1,3, 3,2, 2,0, 4,5, 5,7, 7,6, 6,4, 0,6, 1,7, 2,4, 3,5"
    body = (
        CUBE
        + f"""
        int[] creaseIndices = [{edges}]
        int[] creaseLengths = [2,2,2,2,2,2,2,2,2,2,2,2]
        float[] creaseSharpnesses = [10,10,10,10,10,10,10,10,10,10,10,10]"""
    )
    surface = only(mesh(body), subdivision=2)
    assert volume(surface) == pytest.approx(8) and area(surface) == pytest.approx(24)
    # Normals break at the creases
    flat = (
        area_vectors(surface)[:, None]
        * 2
        / (2 * np.linalg.norm(area_vectors(surface), axis=1))[:, None, None]
    )
    flat = area_vectors(surface) / np.linalg.norm(area_vectors(surface), axis=1)[:, None]
    assert surface.normals[surface.faces] == pytest.approx(np.repeat(flat[:, None], 3, 1), abs=1e-5)
    corner = CUBE + "int[] cornerIndices = [3]\nfloat[] cornerSharpnesses = [10]"
    assert (
        np.abs(only(mesh(corner), subdivision=2).positions - [1, 1, 1]).sum(axis=1) < 1e-6
    ).any()


def test_boundaries_keep_corners_and_texture_coordinates_stay_linear():
    body = SQUARE + "texCoord2f[] primvars:st = [(0,0), (1,0), (1,1), (0,1)] (\n"
    body += 'interpolation = "faceVarying"\n)'
    surface = only(mesh(body), subdivision=3)
    assert area(surface) == pytest.approx(4)
    assert surface.uv == pytest.approx((surface.positions[:, :2] + 1) / 2, abs=1e-6)
    round_one = only(mesh(SQUARE + 'uniform token interpolateBoundary = "edgeOnly"'), subdivision=3)
    assert area(round_one) < 3.5


def test_loop_refines_triangles_and_leaves_others():
    tetrahedron = """
        uniform token subdivisionScheme = "loop"
        int[] faceVertexCounts = [3, 3, 3, 3]
        int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 1, 2, 3, 2, 0, 3]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]"""
    surface = only(mesh(tetrahedron), subdivision=1)
    assert len(surface.faces) == 16
    # 3/8 of both ends and 1/8 of both opposite points; 7/16 of itself and 9/16 of its neighbours
    for place in ([0.375, 0.125, 0.125], [0.1875, 0.1875, 0.1875]):
        assert (np.abs(surface.positions - place).max(axis=1) < 1e-6).any()
    surfaces, notes = read(mesh(SQUARE + 'uniform token subdivisionScheme = "loop"'))
    assert kinds(notes) == ["loop"] and area(surfaces[0]) == pytest.approx(4)


def test_subsets_holes_and_colors_follow_refined_faces():
    colors = "color3f[] primvars:displayColor = [(1,0,0), (0,1,0)] (\n"
    colors += 'interpolation = "uniform"\n)\n'
    surfaces, _ = read(mesh(TWO_SQUARES + colors + subset("s", [1])), subdivision=2)
    assert [len(s.faces) for s in surfaces] == [32, 32]
    assert (surfaces[0].colors == [0, 1, 0]).all() and (surfaces[1].colors == [1, 0, 0]).all()
    with_hole = only(mesh(TWO_SQUARES + "int[] holeIndices = [1]"), subdivision=1)
    assert len(with_hole.faces) == 8


def test_authored_normals_do_not_survive_refinement():
    body = SQUARE + 'normal3f[] normals = [(1, 0, 0)] (\ninterpolation = "constant"\n)'
    assert only(mesh(body), subdivision=1).normals == pytest.approx(
        np.tile([0, 0, 1], (9, 1)), abs=1e-6
    )


# --- other prims ---

SHAPES = {
    "Cube": ("double size = 3", 54, 27),
    "Sphere": ("double radius = 2", 16 * np.pi, 32 / 3 * np.pi),
    "Cylinder": ("double radius = 2\ndouble height = 3", 20 * np.pi, 12 * np.pi),
    "Cone": ("double radius = 3\ndouble height = 4", 24 * np.pi, 12 * np.pi),
    "Capsule": ("double radius = 1\ndouble height = 2", 8 * np.pi, 10 / 3 * np.pi),
}


@pytest.mark.parametrize("axis", "XYZ")
@pytest.mark.parametrize("kind", SHAPES)
def test_gprims_have_their_area_and_volume(kind, axis):
    attributes, expected_area, expected_volume = SHAPES[kind]
    turn = f'uniform token axis = "{axis}"' if kind not in ("Cube", "Sphere") else ""
    surface = only(f'def {kind} "a" {{\n{attributes}\n{turn}\n}}')
    assert area(surface) == pytest.approx(expected_area, rel=3e-3)
    assert volume(surface) == pytest.approx(expected_volume, rel=5e-3)
    if surface.normals is not None:
        outside = np.einsum("mi,mki->mk", area_vectors(surface), surface.normals[surface.faces])
        assert (outside > 0).all()
    size = np.ptp(surface.positions, axis=0)
    if kind in ("Cylinder", "Cone"):
        assert size["XYZ".index(axis)] == pytest.approx(3 if kind == "Cylinder" else 4)


def test_gprims_without_attributes_have_those_of_the_schema():
    expected = {
        "Cube": 24,
        "Sphere": 4 * np.pi,
        "Cylinder": 6 * np.pi,
        "Capsule": 2 * np.pi,
        "Plane": 4,
    }
    for kind, value in expected.items():
        assert area(only(f'def {kind} "a" {{}}')) == pytest.approx(value, rel=3e-3)


def test_cone_points_along_its_axis():
    surface = only('def Cone "a" {\nuniform token axis = "X"\n}')
    tip = surface.positions[surface.positions[:, 0].argmax()]
    assert tip == pytest.approx([1, 0, 0])


@pytest.mark.parametrize(
    ("axis", "size", "normal"),
    [("Z", (4, 1, 0), (0, 0, 4)), ("X", (0, 1, 4), (4, 0, 0)), ("Y", (4, 0, 1), (0, 4, 0))],
)
def test_planes_lie_as_the_schema_says(axis, size, normal):
    text = (
        f'def Plane "a" {{\ndouble width = 4\ndouble length = 1\nuniform token axis = "{axis}"\n}}'
    )
    surface = only(text)
    assert np.ptp(surface.positions, axis=0) == pytest.approx(size)
    assert area_vectors(surface).sum(axis=0) == pytest.approx(normal)


def test_gprims_without_size_are_noted():
    surfaces, notes = read('def Sphere "a" {\ndouble radius = 0\n}')
    assert not surfaces and "radius 0" in notes[0].text


def test_points_are_spheres_with_their_widths_and_colors():
    surface = only("""def Points "a" {
        point3f[] points = [(0, 0, 0), (5, 0, 0)]
        float[] widths = [2, 4] (
            interpolation = "vertex"
        )
        color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)] (
            interpolation = "vertex"
        )
    }""")
    sizes = np.linalg.norm(area_vectors(surface), axis=1)
    assert sizes[surface.face_of == 0].sum() == pytest.approx(4 * np.pi, rel=1e-5)
    assert sizes[surface.face_of == 1].sum() == pytest.approx(16 * np.pi, rel=1e-5)
    assert (surface.colors[surface.face_of == 1] == [0, 1, 0]).all()


@pytest.mark.parametrize(
    ("how", "points", "length"),
    [
        ('type = "linear"', [0, 1, 2, 3, 4], 4),
        ('type = "cubic"\nuniform token basis = "bezier"', [0, 1, 2, 3, 4, 5, 6], 6),
        ('type = "cubic"\nuniform token basis = "bspline"', [0, 1, 2, 3, 4], 2),
        ('type = "cubic"\nuniform token basis = "catmullRom"', [0, 1, 2, 3, 4], 2),
        ('basis = "bspline"\nuniform token wrap = "pinned"', [0, 1, 2, 3, 4], 4),
        ('basis = "catmullRom"\nuniform token wrap = "pinned"', [0, 1, 2, 3, 4], 4),
    ],
)
def test_straight_curves_have_the_area_of_a_tube(how, points, length):
    places = ", ".join(f"(0, {z}, 0)" for z in points)
    surface = only(f"""def BasisCurves "a" {{
        uniform token {how}
        int[] curveVertexCounts = [{len(points)}]
        point3f[] points = [{places}]
        float[] widths = [.2] (
            interpolation = "constant"
        )
    }}""")
    assert area(surface) == pytest.approx(2 * np.pi * 0.1 * length, rel=1e-5)


def test_periodic_curve_is_a_ring():
    angle = 2 * np.pi * np.arange(24) / 24
    places = ", ".join(f"({np.cos(a)}, {np.sin(a)}, 0)" for a in angle)
    surface = only(f"""def BasisCurves "a" {{
        uniform token basis = "catmullRom"
        uniform token wrap = "periodic"
        int[] curveVertexCounts = [24]
        point3f[] points = [{places}]
        float[] widths = [.02] (
            interpolation = "constant"
        )
    }}""")
    assert area(surface) == pytest.approx(4 * np.pi**2 * 0.01, rel=1e-3)


@pytest.mark.parametrize("wrap", ["nonperiodic", "pinned"])
def test_values_of_several_curves_follow_them(wrap):
    # Curves of 5, 4 and 5 points along y at x = 0, 1 and 2; widths and colors grow along them
    counts = [5, 4, 5]
    places = [(x, y, 0) for x, count in enumerate(counts) for y in range(count)]
    spans = [count - 1 if wrap == "pinned" else count - 3 for count in counts]
    varying = [0.1 * (x + 1) for x, span in enumerate(spans) for _ in range(span + 1)]
    surface = only(f"""def BasisCurves "a" {{
        uniform token basis = "catmullRom"
        uniform token wrap = "{wrap}"
        int[] curveVertexCounts = {counts}
        point3f[] points = {places}
        float[] widths = {varying} (
            interpolation = "varying"
        )
        color3f[] primvars:displayColor = [(.1, 0, 0), (.2, 0, 0), (.3, 0, 0)] (
            interpolation = "uniform"
        )
        texCoord2f[] primvars:st = {[place[:2] for place in places]} (
            interpolation = "vertex"
        )
    }}""")
    sizes = np.linalg.norm(area_vectors(surface), axis=1)
    for curve, span in enumerate(spans):
        mine = surface.face_of == curve
        assert sizes[mine].sum() == pytest.approx(np.pi * 0.1 * (curve + 1) * span, rel=1e-5)
        vertices = surface.faces[mine]
        assert surface.colors[vertices][..., 0] == pytest.approx(0.1 * (curve + 1))
        assert surface.uv[vertices][..., 0] == pytest.approx(curve, abs=1e-6)
        assert surface.uv[vertices][..., 1] == pytest.approx(
            surface.positions[vertices][..., 1], abs=1e-5
        )


def test_broken_curves_are_noted():
    surfaces, notes = read("""def BasisCurves "a" {
        int[] curveVertexCounts = [9]
        point3f[] points = [(0, 0, 0)]
    }""")
    assert not surfaces and "adds up to 9, there are 1 points" in notes[0].text


def test_tetrahedra_show_their_outside():
    surface = only("""def TetMesh "a" {
        int4[] tetVertexIndices = [(0, 1, 2, 3)]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    }""")
    assert volume(surface) == pytest.approx(1 / 6)


@pytest.mark.parametrize("kind", ["NurbsPatch", "Volume", "ParticleField3DGaussianSplat"])
def test_types_that_are_left_out_are_noted(kind):
    surfaces, notes = read(f'def {kind} "a" {{\n}}')
    assert not surfaces
    assert f"prims of type {kind} are left out" in notes[0].text and "/a" in notes[0].text
    assert corners(only('def Cube "a" {}')).shape == (12, 3, 3)


# --- anything at all ---

small = st.integers(-2, 7)
coordinate = st.one_of(st.floats(-2, 2, width=32), st.sampled_from([np.nan, np.inf, 1e38, 0.0]))
points = st.lists(st.tuples(coordinate, coordinate, coordinate), max_size=7)


def text_of(value):
    """Return a number, or several, as USD writes them."""
    if isinstance(value, (list, tuple)):
        inside = ", ".join(text_of(part) for part in value)
        return f"[{inside}]" if isinstance(value, list) else f"({inside})"
    return repr(value)


@settings(deadline=None, derandomize=True, database=None, max_examples=50)
@given(
    values=st.fixed_dictionaries(
        {
            "int[] faceVertexCounts": st.lists(st.integers(-1, 6), max_size=4),
            "int[] faceVertexIndices": st.lists(small, max_size=12),
            "point3f[] points": points,
            "int[] holeIndices": st.lists(small, max_size=2),
            "int[] creaseIndices": st.lists(small, max_size=4),
            "int[] creaseLengths": st.lists(small, max_size=2),
            "float[] creaseSharpnesses": st.lists(coordinate, max_size=2),
            "int[] cornerIndices": st.lists(small, max_size=2),
            "float[] cornerSharpnesses": st.lists(coordinate, max_size=2),
            "normal3f[] normals": points,
        }
    ),
    scheme=st.sampled_from(["none", "catmullClark", "loop", "bilinear"]),
    interpolation=st.sampled_from(sorted(COUNTS)),
    color=points,
    valid=st.booleans(),
)
def test_no_mesh_breaks_the_reader(values, scheme, interpolation, color, valid):
    if valid and values["point3f[] points"]:
        counts = [max(count, 0) for count in values["int[] faceVertexCounts"]]
        number = len(values["point3f[] points"])
        values["int[] faceVertexCounts"] = counts
        values["int[] faceVertexIndices"] = [(3 * i) % number for i in range(sum(counts))]
    lines = [f"{name} = {text_of(value)}" for name, value in values.items()]
    lines.append(f'uniform token subdivisionScheme = "{scheme}"')
    how = f'(\ninterpolation = "{interpolation}"\n)'
    lines.append(f"color3f[] primvars:displayColor = {text_of(color)} {how}")
    surfaces, notes = read(mesh("\n".join([*lines, subset("s", [0, 2])])))
    assert surfaces or notes
    for surface in surfaces:
        assert len(surface.faces) and surface.faces.max() < len(surface.positions)
        assert np.isfinite(surface.positions).all()
        assert len(surface.face_of) == len(surface.faces)
        assert surface.normals is None or np.isfinite(surface.normals).all()
        assert surface.colors is None or np.isfinite(surface.colors).all()


@settings(deadline=None, derandomize=True, database=None, max_examples=60)
@given(
    counts=st.lists(st.integers(-1, 8), max_size=3),
    places=points,
    widths=st.lists(coordinate, max_size=4),
    kind=st.sampled_from(["linear", "cubic"]),
    basis=st.sampled_from(["bezier", "bspline", "catmullRom"]),
    wrap=st.sampled_from(["nonperiodic", "periodic", "pinned"]),
    valid=st.booleans(),
)
def test_no_curves_break_the_reader(counts, places, widths, kind, basis, wrap, valid):
    counts = [len(places)] if valid else counts
    surfaces, notes = read(f"""def BasisCurves "a" {{
        int[] curveVertexCounts = {counts}
        point3f[] points = {text_of(places)}
        float[] widths = {text_of(widths)} (
            interpolation = "vertex"
        )
        uniform token type = "{kind}"
        uniform token basis = "{basis}"
        uniform token wrap = "{wrap}"
    }}""")
    assert surfaces or notes
    for surface in surfaces:
        assert surface.faces.max() < len(surface.positions)
        assert np.isfinite(surface.positions).all()
