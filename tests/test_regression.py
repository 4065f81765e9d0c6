"""Each scene in `scenes/` still looks as its reference image, which Mitsuba's integrators rendered.

`tests/README.md` says how the references are made. A failure writes a picture of the difference.
"""

import gc

import mitsuba as mi
import numpy as np
import pytest

from tests import statistics_tools as tools
from tests.conftest import require_variant
from tests.make_references import (
    BLOCK,
    SEEDS,
    load_scene,
    read_reference,
    reference_path,
    scene_names,
)

pytestmark = pytest.mark.usefixtures("plugin")

# Not those of the references: the two images share no random numbers.
FIRST_SEED = 1000
IMAGES, SAMPLES = 6, 12

# With more images the variance is better known: of glass in fog and of smoke, where light is found
# by chance. Visibility is learnt from 2^16 samples, 11 per pixel.
EFFORT_OF = {"glass_fog": (20, 12), "heterogeneous": (20, 12)}
BIAS_OF = {"no_lights": None}


@pytest.fixture(autouse=True)
def no_scene_is_left():
    """Free the scenes of a test: calls of emitters in LLVM variants compile those of all scenes."""
    yield
    gc.collect()


def images_of(name, scene, sensor):
    """Renderings with the scene's own integrator."""
    count, spp = EFFORT_OF.get(name, (IMAGES, SAMPLES))
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    return tools.render_seeds(scene, None, spp, seeds, sensor)[..., :3]


def compare(images, path):
    """Comparison of renderings with a reference file: image mean and blocks."""
    mean, error = read_reference(path)
    # With a box filter pixels share no sample, and blocks neither: their errors are independent.
    variances = tools.pixel_variances(images)
    tiles = tools.welch_from_moments(
        *tools.moments(images, BLOCK, variances), mean, error**2, SEEDS - 1
    )
    whole = max(images.shape[1:3])
    found = (part[0, 0] for part in tools.moments(images, whole, variances))
    variance, blocks = (part[0, 0] for part in tools.variance_of_tile_mean(error**2, whole))
    image = tools.welch_from_moments(*found, mean.mean(axis=(0, 1)), variance, blocks * (SEEDS - 1))
    return tools.Comparison(image, tiles, tools.SIGNIFICANCE)


def enlarged(blocks):
    """Blocks as an image of the original size."""
    return blocks.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)


def difference_picture(images, comparison):
    """Four panels: the rendering, its blocks, the reference, and the difference.

    The difference is red where the rendering is brighter than the reference and blue where it is
    darker; full colour means significant.
    """
    tiles = comparison.tiles
    scale = 0.8 / max(np.quantile(tiles.mean_b, 0.98), 1e-6)
    worst = np.take_along_axis(tiles.t, np.abs(tiles.t).argmax(axis=2)[..., np.newaxis], axis=2)
    # Both signs of a significant difference saturate: the threshold in standard errors.
    limit = np.abs(tiles.t)[tiles.p < comparison.tile_threshold].min(initial=6.0)
    shade = np.clip(np.abs(worst) / limit, 0, 1)
    toward = np.where(worst > 0, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    difference = 1 - shade + shade * toward
    panels = [
        scale * images.mean(axis=0),
        scale * enlarged(tiles.mean_a),
        scale * enlarged(tiles.mean_b),
        enlarged(difference),
    ]
    gap = np.ones((images.shape[1], 4, 3))
    parts = [panel for each in panels for panel in (each, gap)][:-1]
    return np.concatenate(parts, axis=1)


def write_picture(path, picture):
    """Write linear colours as a PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    bitmap = mi.Bitmap(np.ascontiguousarray(picture.clip(0, 1), dtype=np.float32))
    bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True).write(
        str(path)
    )


def check(images, path, folder, bias=tools.BIAS):
    """Compare with a reference; on failure write the picture and name it."""
    tools.assert_finite(images, path.stem)
    comparison = compare(images, path)
    if not comparison.passes:
        picture = folder / f"{path.stem}.png"
        write_picture(picture, difference_picture(images, comparison))
        pytest.fail(f"{comparison.message(path.stem)}\n  picture: {picture}")
    if bias is not None:
        found = comparison.detectable_bias()
        assert found <= bias, f"{path.stem}: only a bias of {100 * found:.1f} % would be found"


@pytest.mark.parametrize("name", scene_names())
def test_scene_matches_reference(llvm, name, failure_folder):
    """Image mean and blocks agree with the reference, for each sensor of the scene."""
    scene = load_scene(name, sampler="manylights_sobol")
    for sensor in range(len(scene.sensors())):
        path = reference_path(name, sensor)
        assert path.exists(), f"no reference: run python -m tests.make_references {name}"
        check(images_of(name, scene, sensor), path, failure_folder, BIAS_OF.get(name, tools.BIAS))


def test_scalar_variant_matches_reference(failure_folder):
    """The references hold for scalar variants, too."""
    require_variant("scalar_rgb")
    images = images_of("points", load_scene("points", sampler="manylights_sobol"), 0)
    check(images, reference_path("points", 0), failure_folder)


def test_planted_bias_is_found_and_drawn(llvm, tmp_path):
    """2 % more in the whole image, or 10 % more in one block, fails and leaves a picture."""
    path = reference_path("points", 0)
    images = images_of("points", load_scene("points", sampler="manylights_sobol"), 0)
    check(images, path, tmp_path)
    assert not list(tmp_path.iterdir())
    one_block = images.copy()
    one_block[:, 5 * BLOCK : 6 * BLOCK, 3 * BLOCK : 4 * BLOCK] *= 1.1
    for biased in (1.02 * images, one_block):
        with pytest.raises(pytest.fail.Exception, match=r"picture: .*points\.png"):
            check(biased, path, tmp_path)
        picture = mi.Bitmap(str(tmp_path / "points.png"))
        assert picture.size()[1] == images.shape[1]
        (tmp_path / "points.png").unlink()


def test_references_are_small():
    """All references together stay under a megabyte, and none is left over."""
    paths = list(reference_path("any", 0).parent.glob("*.exr"))
    assert sum(path.stat().st_size for path in paths) < 1_000_000
    assert {path.stem.split("-")[0] for path in paths} == set(scene_names())
