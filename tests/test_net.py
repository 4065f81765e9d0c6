"""A net for faults of emitters: random scenes of every kind, against what no light sampling made.

`test_any_scene_renders` draws anything that Mitsuba loads; images have to be finite and positive.
Where it fails Hypothesis prints a small description, and `tests.described_scenes.load_any` makes
the scene of it. Many more of these, with crashes and hangs caught, are `make soak`.

The other tests compare means: with the light on a diffuse patch by quadrature in numpy, in vacuum
and through absorbing fog, and with Mitsuba's rays from the BSDF, for lights of any shape, texture
and transformation. Mitsuba's BSDF samples are right where its light samples are not: for bitmaps on
any shape, for normals and colours of meshes. They cannot find points, spots and suns.
"""

import copy

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import strategies as st

from tests import described_scenes, light_quadrature, scene_strategies
from tests.command_line import manylights_process
from tests.example_tools import (
    SEEDS,
    compare_in_scenes,
    for_examples_and_smaller,
    images,
    quick_and_slow,
)
from tests.scene_strategies import FOGS, Seeded, any_scene, lit_patch, strategy, wide_lamps
from tests.soak import Children, check, variant_arguments

pytestmark = pytest.mark.usefixtures("plugin", "own_threads")


LIMIT = 60
"""Seconds for one of the scenes that are rendered in child processes."""


@pytest.fixture(autouse=True)
def quiet():
    """Warnings about each of hundreds of scenes help nobody."""
    before = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    yield
    mi.set_log_level(before)


ANY = [
    pytest.param("scalar_rgb", 80),
    pytest.param("scalar_spectral", 40),
    pytest.param("llvm_ad_rgb", 3),
    pytest.param("scalar_rgb", 3000, marks=pytest.mark.slow),
    pytest.param("scalar_spectral", 3000, marks=pytest.mark.slow),
    pytest.param("llvm_ad_rgb", 100, marks=pytest.mark.slow),
    pytest.param("llvm_ad_spectral", 100, marks=pytest.mark.slow),
    pytest.param("llvm_ad_mono_polarized", 100, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("variant", "examples"), ANY, indirect=["variant"])
def test_any_scene_renders(variant, examples):
    """Everything at once: no crash, no hang, nothing negative or not finite.

    In child processes, so that a crash is a failure like others, of which Hypothesis prints the
    smallest scene.
    """
    with Children(variant, LIMIT) as children:

        def renders(description):
            text = children.ask(description)
            assert not text, text

        drawn = strategy(any_scene, **variant_arguments())
        for_examples_and_smaller(renders, drawn, examples)


def test_seeded_descriptions_are_those_of_the_soak():
    """The same number gives the same scene, another one another scene."""
    assert any_scene(Seeded(3)) == any_scene(Seeded(3)) != any_scene(Seeded(4))


@pytest.mark.parametrize("hide_emitters", [False, True])
def test_instances_in_scalar_variant(scalar, hide_emitters):
    """Rays of the camera and of the BSDF meet instances, which have no shape of their own."""
    scene = any_scene(Seeded(0)) | {"instances": "diffuse", "medium": None, "environment": None}
    disk = {"kind": "disk", "flip": False, "radiance": {"kind": "uniform", "value": 1.0}}
    scene["lights"] = [disk | {"steps": [["translate", [0.0, 0.0, 2.0]]]}]
    for kind in ("manylights_direct", "manylights_volpath"):
        integrator = {"type": kind, "hide_emitters": hide_emitters}
        assert not check(scene | {"integrator": integrator})


def test_hidden_emitter_is_passed_along_its_surface(scalar):
    """A ray along the wall of a hidden cylinder found it again and again: no end."""
    scene = any_scene(Seeded(0)) | {"instances": None, "medium": None, "environment": None}
    place = [["translate", [0.375, -1.406, 1.047]], ["rotate", [0.75, 0.3438, 1.0], -16.88]]
    place += [["scale", [0.1331, 0.1331, 0.21]]]
    cylinder = {"kind": "cylinder", "flip": False, "surface": "twosided"}
    cylinder["radiance"] = {"kind": "uniform", "value": 1.0}
    scene |= {"floor": "diffuse", "ball": "diffuse"}
    camera = {"kind": "perspective", "crop": False, "sampler": "orthogonal", "spp": 9}
    scene |= {"lights": [cylinder | {"steps": place}], "camera": camera, "power": 1.0}
    scene |= {"integrator": {"type": "manylights_direct", "hide_emitters": True}}
    with Children("scalar_rgb", LIMIT) as children:
        assert not children.ask(scene)


def test_border_near_the_end_of_a_shadow_ray_is_passed_once(tmp_path):
    """Rays to the far wall of a thin clear tube, which shines inwards, met it for ever: no end."""
    scene = tmp_path / "tube.xml"
    scene.write_text("""<scene version="3.0.0">
        <integrator type="manylights_volpath"><integer name="max_depth" value="2"/></integrator>
        <sensor type="perspective">
            <float name="fov" value="20"/>
            <transform name="to_world">
                <lookat origin="1, -1, 1" target=".9, -.1, .6" up="0, 0, 1"/>
            </transform>
            <film type="hdrfilm">
                <integer name="width" value="16"/> <integer name="height" value="16"/>
            </film>
        </sensor>
        <shape type="rectangle">
            <transform name="to_world"><translate z=".599"/></transform>
        </shape>
        <shape type="cylinder">
            <transform name="to_world">
                <scale value=".0001"/> <rotate x=".3" y=".4" z=".866" angle="50"/>
                <translate x=".9" y="-.1" z=".6"/>
            </transform>
            <boolean name="flip_normals" value="true"/>
            <bsdf type="null"/>
            <emitter type="area"><rgb name="radiance" value="1"/></emitter>
        </shape>
    </scene>""")
    image = tmp_path / "tube.exr"
    options = ("--spp", 256, "--variant", "scalar_rgb")
    process = manylights_process("render", scene, "-o", image, *options)
    assert process.returncode == 0, process.stderr


# ------------------------------------------------------------------------------------ quadrature


LARGEST = 1 << 13
"""Samples per pixel at most: noisy scenes do not hold up the others."""


def ours(load, scene):
    """Images of the integrator that belongs to a description."""
    loaded = load(scene)
    return images(loaded, mi.load_dict(scene["integrator"]), seed_of(scene), LARGEST)


def seed_of(scene):
    """A seed that is always the same for a description, and another one for each."""
    return int.from_bytes(repr(scene).encode(), "little") % (2**31 - 1000)


def ours_and_quadrature(scene):
    """Images of the description's integrator, and those of numpy."""
    seeds = range(seed_of(scene), seed_of(scene) + SEEDS)
    return ours(described_scenes.load_patch, scene), light_quadrature.images(scene, seeds)


KINDS = (*scene_strategies.SHAPES, *scene_strategies.POINTS)


@quick_and_slow(2, 40)
def test_light_in_vacuum(scalar, examples):
    """Each kind of light, alone or among others."""
    scenes = st.one_of([strategy(lit_patch, kind=kind) for kind in KINDS])
    compare_in_scenes(scenes, examples * len(KINDS), ours_and_quadrature)


@quick_and_slow(2, 50)
def test_light_through_fog(scalar, examples):
    """Homogeneous media and grids; borders between patch, camera and lights."""
    scenes = st.one_of([strategy(lit_patch, fog=fog) for fog in FOGS])
    compare_in_scenes(scenes, examples * len(FOGS), ours_and_quadrature)


@pytest.mark.slow
@pytest.mark.parametrize("fog", [None, *FOGS])
def test_light_in_llvm_variant(llvm, fog):
    """The same in llvm_ad_rgb."""
    compare_in_scenes(strategy(lit_patch, fog=fog), 20, ours_and_quadrature)


def test_planted_bias_of_one_light_is_found(scalar):
    """One of several lights is brighter by a tenth, which is a few percent of the image."""

    def estimate(scene):
        brighter = copy.deepcopy(scene)
        light = brighter["lights"][0]
        light["value"] = [1.1 * value for value in light["value"]]
        return ours(described_scenes.load_patch, brighter), ours_and_quadrature(scene)[1]

    with pytest.raises(AssertionError, match="significance"):
        compare_in_scenes(strategy(lit_patch, kind="point"), 4, estimate)


@pytest.mark.parametrize("wrap", scene_strategies.WRAPS)
@pytest.mark.parametrize("kind", ["bilinear", "nearest", "checkerboard"])
def test_lookup_of_textures(scalar, kind, wrap):
    """The quadrature reads textures as Mitsuba does: far outside of [0, 1], turned and mirrored."""
    generator = np.random.default_rng(5)
    texture = {"kind": "bitmap", "size": [3, 4], "scale": 2.0, "seed": 1, "wrap": wrap}
    texture["filter"] = kind
    if kind == "checkerboard":
        texture = {"kind": kind, "colours": [[0.1, 0.2, 0.3], [0.9, 0.8, 0.7]]}
    texture["to_uv"] = [["translate", [0.3, -0.2]], ["rotate", 25], ["scale", [-2, 1.5]]]
    loaded = mi.load_dict(described_scenes.radiance_dict(texture))
    uv = generator.uniform(-3, 3, (200, 2))
    expected = light_quadrature.lookup(texture, uv)
    for point, value in zip(uv, expected):
        si = mi.SurfaceInteraction3f()
        si.uv = point
        np.testing.assert_allclose(np.array(loaded.eval(si)), value, atol=2e-4)


# ------------------------------------------------------------------------------- rays of the BSDF


def ours_and_rays(scene):
    """Images of the description's integrator, and those of Mitsuba's rays from the BSDF."""
    reference = mi.load_dict({"type": "direct", "emitter_samples": 0, "bsdf_samples": 4})
    loaded = described_scenes.load_lamps(scene)
    expected = images(loaded, reference, seed_of(scene) + 500, LARGEST)
    return ours(described_scenes.load_lamps, scene), expected


@quick_and_slow(8, 150)
def test_wide_lamps(scalar, examples):
    """Large lights and an environment, for any material."""
    compare_in_scenes(strategy(wide_lamps), examples, ours_and_rays)


@pytest.mark.slow
def test_wide_lamps_in_llvm_variant(llvm):
    """The same in llvm_ad_rgb."""
    compare_in_scenes(strategy(wide_lamps), 40, ours_and_rays)
