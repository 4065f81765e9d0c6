"""Merged emissive meshes: the same surfaces with the same radiance, and what is left alone."""

import manylights
import mitsuba as mi
import numpy as np
import pytest
from manylights import loading
from manylights.loading import merging

from tests import light_scenes
from tests import statistics_tools as tools
from tests.conftest import require_variant
from tests.light_scenes import area, diffuse, make_mesh, rgb, transform

pytestmark = pytest.mark.usefixtures("plugin")

CHECKS = {
    "type": "bitmap",
    "bitmap": mi.Bitmap(np.random.default_rng(0).random((4, 4, 3), dtype=np.float32)),
}


def lamp(x, radiance, kind="rectangle", **more):
    """A small lamp under the sky at `x` that shines to the floor."""
    place = transform().translate([x, 0, 2]).rotate([1, 0, 0], 170).scale(0.2)
    return {"type": kind, "to_world": place, "emitter": area(radiance), **more}


def lamps(**more):
    """Three lamps of one kind."""
    return {f"lamp_{i}": lamp(i - 1.0, rgb([4 + i, 3, 2 - i]), **more) for i in range(3)}


def merged_ids(scene, **options):
    return sorted(
        sorted(ids) for ids in manylights.merge_emitters(scene, **options).merged.values()
    )


@pytest.fixture(params=["scalar_rgb", "llvm_ad_rgb", "llvm_ad_mono"])
def any_variant(request):
    """Variants in which attributes are what lights are; these tests need no integrator."""
    return require_variant(request.param)


@pytest.fixture(params=["scalar_rgb", "llvm_ad_rgb"])
def rendering_variant(request):
    return require_variant(request.param)


def rays():
    """Origins and directions of rays that cross the place of the lamps from above and below."""
    generator = np.random.default_rng(1)
    origins = generator.uniform([-1.5, -0.6, 0], [1.5, 0.6, 4], (300, 3))
    targets = generator.uniform([-2, -0.8, 1.9], [2, 0.8, 2.1], (300, 3))
    return origins, targets - origins


def seen(scene):
    """What the rays see: point, normals, texture coordinates, radiance and reflectance."""
    origins, directions = rays()
    if not mi.variant().startswith("scalar"):
        ray = mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f(directions.T))
        return np.concatenate([np.array(x).reshape(-1, 300) for x in _facts(scene, ray)]).T
    columns = (_facts(scene, mi.Ray3f(*pair)) for pair in zip(origins, directions))
    return np.array([np.concatenate([np.ravel(x) for x in facts]) for facts in columns])


def _facts(scene, ray):
    hit = scene.ray_intersect(ray)
    shape, jit = hit.shape, not mi.variant().startswith("scalar")
    if not jit and shape is None:
        return (np.zeros(3 * 5 + 2 + 1),)
    emitter, bsdf, context = hit.emitter(scene), hit.bsdf(), mi.BSDFContext()
    light = emitter.eval(hit) if jit or emitter is not None else mi.Spectrum(0)
    scattered = bsdf.eval(context, hit, mi.Vector3f(0.3, 0.4, 0.8))
    valid = mi.Float(1) if not jit else mi.Float(hit.is_valid())
    return hit.p * valid, hit.n * valid, hit.sh_frame.n, hit.uv, light, scattered, valid


def crowd():
    """Lamps of all kinds that are merged: mirrored, flipped, textured BSDFs, spectra, meshes."""
    texture = {"type": "twosided", "inner": {"type": "diffuse", "reflectance": CHECKS}}
    scene = {"type": "scene"}
    kinds = (
        {"kind": "rectangle"},
        {"kind": "cube"},
        {"kind": "rectangle", "flip_normals": True},
        {"kind": "cube", "face_normals": True},
        {"kind": "rectangle", "bsdf": texture},
        {"kind": "cube", "bsdf": {**texture, "inner": {**texture["inner"]}}},
    )
    radiances = (rgb([1, 2, 3]), {"type": "uniform", "value": 2.5}, 1.5, {"type": "d65"})
    generator = np.random.default_rng(2)
    for index in range(24):
        light = lamp(0, radiances[index % 4], **kinds[index % 6])
        x, y, z = generator.uniform([-1.2, -0.2, 1.9], [1.2, 0.2, 2.1])
        place = transform().translate([x, y, z]).rotate([1, 2, 3], 50.0 * index)
        light["to_world"] = place.scale([0.2, 0.1, -0.2 if index % 5 else 0.2])
        scene[f"lamp_{index}"] = light
    triangles, normals = light_scenes.octahedron(np.array([0, 0, 2]), 0.3)
    for index, shift in enumerate(np.array([[-0.5, 0, 0], [0.5, 0, 0]])):
        mesh = make_mesh(triangles + shift, rgb([index, 2, 1]), None, normals)
        scene[f"mesh_{index}"] = mesh
    return scene


def test_rays_see_the_same_surfaces_with_the_same_radiance(any_variant):
    scene = crowd()
    merged = manylights.merge_emitters(scene)
    # Flipped or with a texture or neither; meshes without texture coordinates
    assert sorted(len(ids) for ids in merged.merged.values()) == [2, 4, 8, 12]
    assert len(merged) == 1 + 4
    expected, found = seen(mi.load_dict(scene)), seen(mi.load_dict(merged))
    hits = np.count_nonzero(expected[:, -1])
    assert 50 < hits < 300 and np.count_nonzero(np.any(expected[:, 11:14] > 0, axis=1)) > 20
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


def test_picture_of_lamps_has_the_same_bits(rendering_variant):
    scene = {**lamps(), **{f"cube_{i}": lamp(i - 0.5, rgb([i, 2, 3]), "cube") for i in range(2)}}
    scene |= {"type": "scene", "sensor": light_scenes.sensor()}
    scene["sensor"]["to_world"] = transform().look_at([0, -1, 0], [0, 0, 2], [0, 1, 0])
    scene["integrator"] = {"type": "manylights_direct"}
    merged = manylights.merge_emitters(scene)
    assert sum(len(ids) for ids in merged.merged.values()) == 5
    images = [np.array(mi.render(mi.load_dict(s), spp=16, seed=3)) for s in (scene, merged)]
    assert (images[0] > 0).any()
    np.testing.assert_array_equal(*images)


def few_lamps(factor=1.0):
    """Four rectangles and cubes above the stage, the first one `factor` times as bright."""
    lights = light_scenes.shapes("rectangle", 3, seed=3, size=0.4, total=12.0)
    lights |= light_scenes.shapes("cube", 1, seed=4, size=0.4, total=4.0)
    color = lights["rectangle_0"]["emitter"]["radiance"]["value"]
    lights["rectangle_0"]["emitter"] = area(rgb(factor * np.array(color)))
    return {**light_scenes.stage(), **lights, "integrator": {"type": "manylights_direct"}}


def images(scene, first):
    return tools.render_seeds(mi.load_dict(scene), spp=64, seeds=range(first, first + 16))


def test_means_are_those_of_separate_lamps_and_a_brighter_lamp_is_noticed(rendering_variant):
    separate = images(few_lamps(), 0)
    merged = manylights.merge_emitters(few_lamps())
    assert [len(ids) for ids in merged.merged.values()] == [4]
    tools.assert_same_mean(images(merged, 100), separate, label="merged")
    brighter = images(manylights.merge_emitters(few_lamps(1.1)), 100)
    assert not tools.compare_means(brighter, separate).passes


@pytest.mark.parametrize(
    "odd",
    [
        {"emitter": area(CHECKS)},
        {"emitter": {**area(rgb([1, 1, 1])), "sampling_weight": 2.0}},
        {"emitter": {"type": "directionalarea", "radiance": rgb([1, 1, 1])}},
        {"type": "disk"},
        {"bsdf": diffuse(0.4, 0.4, 0.4)},
        {"flip_normals": True},
        {"interior": {"type": "homogeneous"}},
        {"silhouette_sampling_weight": 0.5},
        {"type": "ply", "filename": "nowhere.ply"},
    ],
    ids=lambda odd: "-".join(odd),
)
def test_a_lamp_that_differs_stays_as_it_is(scalar, odd):
    scene = {"type": "scene", **lamps(), "odd": {**lamp(0, rgb([1, 1, 1])), **odd}}
    merged = manylights.merge_emitters(scene)
    assert list(merged.merged.values()) == [["lamp_0", "lamp_1", "lamp_2"]]
    assert repr(merged["odd"]) == repr(scene["odd"])


def test_meshes_with_attributes_stay(scalar, tmp_path):
    radiance = {"type": "mesh_attribute", "name": "face_color"}
    corners = light_scenes.triangles(2)
    colored = {f"m{i}": make_mesh(corners, radiance, np.ones((2, 3))) for i in range(2)}
    assert merged_ids({"type": "scene", **colored}) == []
    make_mesh(corners, rgb([1, 1, 1]), np.ones((2, 3))).write_ply(str(tmp_path / "m.ply"))
    file = lamp(0, 1.0, "ply", filename=str(tmp_path / "m.ply"))
    assert merged_ids({"type": "scene", "a": file, "b": file}) == []
    painted = {f"m{i}": make_mesh(corners, rgb([1, 1, 1]), np.ones((2, 3))) for i in range(2)}
    assert merged_ids({"type": "scene", **painted}) == []


def test_meshes_of_the_same_bsdf_object_are_merged_and_of_others_not(scalar):
    white, grey = (mi.load_dict(diffuse(*[x] * 3)) for x in (0.8, 0.4))
    scene = {"type": "scene", **lamps(bsdf=white), "grey": lamp(0, 1.0, bsdf=grey)}
    scene["also_white"] = mi.load_dict(lamp(0, 2.0, bsdf=white))
    assert merged_ids(scene) == [["also_white", "lamp_0", "lamp_1", "lamp_2"]]


def test_lamps_to_keep_and_lamps_that_others_refer_to_stay(scalar):
    green = diffuse(0, 0.5, 0)
    scene = {"type": "scene", **lamps(bsdf=green)}
    scene |= {"a": lamp(0, 1.0, bsdf=green), "b": lamp(0, 1.0, id="named", bsdf=green)}
    assert merged_ids(scene) == [["a", "lamp_0", "lamp_1", "lamp_2", "named"]]
    assert merged_ids(scene, keep=("a", "named")) == [["lamp_0", "lamp_1", "lamp_2"]]
    scene["floor"] = {"type": "rectangle", "bsdf": {"type": "ref", "id": "a.bsdf"}}
    assert merged_ids(scene, keep=("b",)) == [["lamp_0", "lamp_1", "lamp_2"]]
    mi.load_dict(manylights.merge_emitters(scene))


def test_a_shape_to_keep_that_is_not_there_is_refused_with_those_near(scalar):
    scene = {
        "type": "scene",
        **lamps(),
        "floor": mi.load_dict(lamp(0, 1.0)),
        "grey": diffuse(1, 1, 1),
    }
    scene["group"] = {"type": "shapegroup", "inner": lamp(0, 1.0)}
    for known in ("lamp_1", "floor", "group", "group.inner"):
        manylights.merge_emitters(scene, keep=[known])
    wrong = "keep 'lmp_1': the scene has no shape of this id, near ones are lamp_1, lamp_"
    with pytest.raises(ValueError, match=wrong):
        manylights.merge_emitters(scene, keep=["lamp_0", "lmp_1"])
    for other in ("grey", "zz", 3):
        with pytest.raises(ValueError, match=rf"keep '?{other}'?: .*, it has lamp_0, .*floor"):
            manylights.merge_emitters(scene, keep={other})


def test_what_is_no_description_is_named(scalar):
    for wrong in (None, "scene.xml", mi.load_dict({"type": "scene"})):
        with pytest.raises(ValueError, match=r"must be a dictionary for mi\.load_dict"):
            manylights.merge_emitters(wrong)
    with pytest.raises(ValueError, match="keep 'lamp': must be a list of ids"):
        manylights.merge_emitters({"type": "scene"}, keep="lamp")


def test_a_file_read_with_face_normals_is_not_joined_with_smooth_ones(scalar, tmp_path):
    triangles, normals = light_scenes.octahedron(np.array([0, 0, 2]), 0.3)
    path = str(tmp_path / "ball.ply")
    make_mesh(triangles, rgb([1, 1, 1]), None, normals).write_ply(path)
    files = {f"file_{i}": lamp(i, 1.0, "ply", filename=path, face_normals=i > 1) for i in range(4)}
    scene = {"type": "scene", **files}
    assert merged_ids(scene) == [["file_0", "file_1"], ["file_2", "file_3"]]
    found = (seen(mi.load_dict(s)) for s in (scene, manylights.merge_emitters(scene)))
    np.testing.assert_allclose(*found, rtol=1e-6, atol=1e-6)


def test_a_bsdf_shared_with_other_shapes_is_still_shared(scalar):
    reference = {"type": "ref", "id": "paint"}
    texture = {"type": "ref", "id": "pattern"}
    scene = {
        "type": "scene",
        "pattern": {"type": "checkerboard"},
        "white": {"type": "diffuse", "id": "paint", "reflectance": texture},
        "floor": {"type": "rectangle", "bsdf": reference},
        "twice": {"type": "rectangle", "bsdf": {"type": "twosided", "inner": reference}},
        **lamps(bsdf=reference),
    }
    before = repr(scene)
    merged = manylights.merge_emitters(scene)
    assert merged_ids(scene) == [["lamp_0", "lamp_1", "lamp_2"]]
    loaded = mi.load_dict(merged)
    bsdfs = {shape.id(): shape.bsdf() for shape in loaded.shapes()}
    assert bsdfs["merged_3_emitters"] is bsdfs["floor"]
    values = [name for name, _ in mi.traverse(loaded) if name.endswith("color0.value")]
    assert len(values) == 1, values
    assert repr(scene) == before, "the scene was changed"


@pytest.mark.parametrize("integrator", ["direct", "path", "aov"])
def test_integrators_of_mitsuba_are_refused(scalar, integrator):
    part = {"type": integrator}
    if integrator == "aov":
        part |= {"aovs": "d:depth", "image": {"type": "path"}}
    scene = {"type": "scene", **lamps(), "integrator": part}
    with pytest.raises(
        ValueError, match="finds no light on merged emitters, use manylights_direct"
    ):
        manylights.merge_emitters(scene)
    with pytest.raises(ValueError, match="finds no light"):
        manylights.merge_emitters({**scene, "integrator": mi.load_dict(part)})
    ours = {"type": "manylights_volpath"}
    part = {**part, "image": ours} if integrator == "aov" else ours
    assert manylights.merge_emitters({**scene, "integrator": part}).merged
    assert manylights.merge_emitters({**scene, "integrator": mi.load_dict(ours)}).merged


def test_nothing_is_merged_in_spectral_variants():
    require_variant("scalar_spectral")
    grey = {f"grey_{i}": lamp(i, {"type": "uniform", "value": 2.5}) for i in range(2)}
    scene = {"type": "scene", **lamps(), **grey}
    merged = manylights.merge_emitters(scene)
    assert merged.merged == {} and merged == scene


XML_LAMP = """<shape type="{kind}" id="{name}">
    <transform name="to_world">
        <rotate x="1" angle="170"/><scale value=".3"/><translate x="{x}" z="2"/>
    </transform>
    <ref id="white"/>
    <emitter type="area"><rgb name="radiance" value="4 {x} 2"/></emitter>
</shape>"""

XML_SCENE = """<scene version="3.0.0">
    {integrator}
    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="0,-4,1" target="0,0,0.5" up="0,0,1"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="24"/><integer name="height" value="16"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <bsdf type="diffuse" id="white"/>
    <shape type="rectangle" id="floor"><ref id="white"/></shape>
    {lamps}
</scene>"""


def write_scene(path, integrator):
    places = (("rectangle", 0.5), ("rectangle", 1), ("cube", 1.5))
    text = "".join(XML_LAMP.format(kind=kind, name=f"at_{x}", x=x) for kind, x in places)
    path.write_text(XML_SCENE.format(integrator=integrator, lamps=text))
    return str(path)


def test_render_merges_the_lamps_of_a_scene_file(scalar, tmp_path):
    path = write_scene(tmp_path / "scene.xml", '<integrator type="direct"/>')
    loaded = loading.load(path)
    assert loaded.notes[-1] == "emitters: 3 meshes merged into 1"
    bsdfs = {shape.id(): shape.bsdf() for shape in loaded.scene.shapes()}
    assert set(bsdfs) == {"floor", "merged_3_emitters"}
    assert bsdfs["floor"] is bsdfs["merged_3_emitters"]
    ours = mi.load_dict({"type": "manylights_direct"})
    a = tools.render_seeds(loaded.scene, ours, 128, range(16))
    b = tools.render_seeds(mi.load_file(path), ours, 128, range(100, 116))
    tools.assert_same_mean(a, b, label="render")


@pytest.mark.parametrize(
    "integrator",
    [
        '<integrator type="ptracer"/>',
        '<integrator type="aov"><string name="aovs" value="s:shape_index"/>'
        '<integrator type="direct"/></integrator>',
    ],
    ids=["of-mitsuba", "shows-shapes"],
)
def test_render_does_not_merge_what_would_change_the_image(scalar, tmp_path, integrator):
    loaded = loading.load(write_scene(tmp_path / "scene.xml", integrator))
    assert len(loaded.scene.shapes()) == 4
    assert not any("merged" in note for note in loaded.notes)


def test_merged_ids_are_logged(scalar, monkeypatch):
    said = []
    monkeypatch.setattr(merging.mi, "Log", lambda level, text: said.append((level, text)))
    manylights.merge_emitters({"type": "scene", **lamps()})
    assert said == [(mi.LogLevel.Info, "merged_3_emitters: lamp_0, lamp_1, lamp_2")]
