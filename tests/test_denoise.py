"""`--denoise`: images without noise beside those with it."""

import sys
from types import SimpleNamespace

import manylights
import mitsuba as mi
import numpy as np
import pytest
from manylights import cli, scenes
from manylights.bench import metrics
from manylights.errors import UsageError
from manylights.output import channels, denoise, exr

from tests.conftest import require_variant
from tests.test_images import scene

pytestmark = pytest.mark.usefixtures("plugin")

BAND = {"type": "spectrum", "value": [(400, 1.0), (700, 1.0)]}
SIZE = {"width": 96, "height": 72}


@pytest.fixture
def oidn():
    pytest.importorskip("mitsuba_oidn", reason="mitsuba-oidn is not installed")
    return require_variant("scalar_rgb")


def box_filtered():
    description = scene()
    description["camera"]["film"] |= {"rfilter": {"type": "box"}, "component_format": "float32"}
    return description


def test_layers_beside_an_image_that_stays_as_it_is(oidn, tmp_path):
    plain, both = tmp_path / "a.exr", tmp_path / "b.exr"
    manylights.render(box_filtered(), output=plain, spp=4)
    result = manylights.render(box_filtered(), output=both, spp=4, denoise=True)
    before, after = exr.read(plain)[0], exr.read(both)[0]
    layers = {f"albedo.{letter}" for letter in "RGB"} | {f"normal.{letter}" for letter in "XYZ"}
    layers |= {f"{name}.{c}" for name in ("denoised", "emission") for c in "RGB"} | {"samples"}
    assert set(after) == set(before) | layers
    for name, plane in before.items():
        np.testing.assert_array_equal(plane, after[name], err_msg=name)
    shown = np.stack([after[f"denoised.{letter}"] for letter in "RGB"], axis=-1)
    np.testing.assert_array_equal(shown, result.denoised)
    assert not result.notes or all("denoise" not in note for note in result.notes)
    png = channels.read_colors(tmp_path / "b.png")
    np.testing.assert_allclose(png, np.clip(shown, 0, 1), atol=0.012)


def test_albedo_and_normals_help(oidn):
    """A checkerboard is kept though the noise is as large."""
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:64, :64]
    albedo = np.where((x // 4 + y // 4) % 2, 0.8, 0.2)[..., np.newaxis] * np.ones(3)
    noisy = albedo * rng.gamma(1.0, 1.0, (64, 64, 1))
    normal = np.zeros((64, 64, 3))
    guided = np.concatenate([noisy, albedo, normal], axis=2).astype(np.float32)
    names = [*"RGB", *(f"albedo.{c}" for c in "RGB"), *(f"normal.{c}" for c in "XYZ")]
    with_them = denoise.denoised(guided, names)
    without = denoise.denoised(guided[..., :3].copy(), names[:3])
    errors = [metrics.rmse(found, albedo) for found in (with_them, without, noisy)]
    assert errors[0] < 0.7 * errors[1] and errors[1] < errors[2]


def test_bright_lamps_leave_nothing_beside(oidn):
    """They are taken away before, with their exposure, and come back after."""
    rng = np.random.default_rng(3)
    image = rng.gamma(1.0, 1.0, (48, 64, 6)).astype(np.float32) * 0.01
    emitted = np.zeros((48, 64, 3), np.float32)
    emitted[20:24, 30:33] = 5000.0
    image[..., 3:] = emitted
    image[..., :3] += 2 * emitted
    names = [*"RGB", *(f"emission.{c}" for c in "RGB")]
    found = denoise.denoised(image, names, exposure=2.0)
    np.testing.assert_allclose(found[20:24, 30:33], 1e4, rtol=1e-4)
    beside = emitted[..., 0] == 0
    assert np.abs(found[beside] - 0.01).max() < 0.01
    # In fog less of them arrives than they emit
    image[..., 3:] *= 100
    assert np.abs(denoise.denoised(image, names)[beside] - 0.01).max() < 0.01
    gray = denoise.denoised(image[..., [0, 3, 4, 5]], ["Y", *names[3:]], exposure=0.02)
    assert np.abs(gray[beside] - 0.01).max() < 0.01


def test_films_of_luminance(oidn):
    gray = np.random.default_rng(1).random((32, 48, 2), dtype=np.float32)
    kept = gray.copy()
    assert denoise.denoised(gray, ["Y", "A"]).shape == (32, 48, 1)
    np.testing.assert_array_equal(gray, kept)


@pytest.mark.parametrize("film", [{"pixel_format": "xyz"}, {"type": "specfilm"}])
def test_films_without_colours_are_named_before_the_render(film, oidn):
    description = box_filtered()
    description["camera"]["film"] |= film
    if "type" in film:
        require_variant("scalar_spectral")
        description["camera"]["film"] = {**film, "a": BAND}
    description["integrator"] = {"type": "path"}

    def never(progress):
        raise AssertionError("it was rendered")

    with pytest.raises(UsageError, match="denoise: the film has no colour channels"):
        manylights.render(description, denoise=True, integrator="keep", progress=never)


def test_a_wide_filter_is_reported(oidn):
    result = manylights.render(scene(), spp=1, denoise=True)
    assert sum("the film's filter spreads noise" in note for note in result.notes) == 1


def test_integrators_of_others_have_no_guides(oidn, tmp_path):
    description = {**box_filtered(), "integrator": {"type": "path"}}
    for wanted in (description, mi.load_dict(description)):
        result = manylights.render(
            wanted, output=tmp_path / "a.exr", spp=1, denoise=True, integrator="keep"
        )
        planes = exr.read(tmp_path / "a.exr")[0]
        assert result.denoised.shape == (12, 16, 3) and "denoised.R" in planes
        assert not any(name.startswith("albedo") for name in planes)


SCENES = {
    "city": lambda: scenes.city(300, **SIZE, spp=4),
    "house": lambda: scenes.house(100, **SIZE, spp=4),
    "glossy": lambda: scenes.glossy(100, **SIZE, spp=4),
    "fog": lambda: scenes.fog_rooms(40, **SIZE, spp=4),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_there_is_less_error(name, oidn):
    """Than the noisy image has, against a reference of 16 times its samples."""
    reference = manylights.render(SCENES[name](), spp=64, seed=7).image[..., :3]
    result = manylights.render(SCENES[name](), spp=4, denoise=True)
    noisy, clean = (
        metrics.relative_mse(image, reference, metrics.TRIM)
        for image in (result.image[..., :3], result.denoised)
    )
    assert clean < noisy, (name, noisy, clean)


def test_what_to_install_is_named(monkeypatch, tmp_path, capsys):
    require_variant("scalar_rgb")
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    with pytest.raises(
        UsageError, match=r"mitsuba-oidn, type: pip install 'manylights\[denoise\]'"
    ):
        manylights.render(scene(), spp=1, denoise=True)
    command = ["render", "no.xml", "-o", str(tmp_path / "a.exr"), "--denoise"]
    assert cli.main(command) == 2 and "manylights[denoise]" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "used"),
    [("normal", []), ("albedo", ["albedo"]), ("albedo,normal", ["albedo", "normal"])],
)
def test_normals_alone_are_no_guide(monkeypatch, given, used):
    """Open Image Denoise has no filter for them."""
    seen = []

    def filtered(color, hdr, **guides):
        seen.append(list(guides))
        return color

    monkeypatch.setitem(sys.modules, "mitsuba_oidn", SimpleNamespace(denoise=filtered))
    letters = {"albedo": "RGB", "normal": "XYZ"}
    layers = [f"{name}.{letter}" for name in given.split(",") for letter in letters[name]]
    image = np.ones((4, 4, 3 + len(layers)), np.float32)
    denoise.denoised(image, [*"RGB", *layers])
    assert seen == [used]


def test_what_the_denoiser_lacks_is_named(monkeypatch, tmp_path):
    (tmp_path / "mitsuba_oidn.py").write_text("import no_such_library")
    monkeypatch.delitem(sys.modules, "mitsuba_oidn", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UsageError, match=r"mitsuba-oidn.*\(No module named 'no_such_library'\)"):
        denoise.check_installed()


def test_parts_are_denoised_when_they_are_one(oidn, tmp_path):
    whole, files = tmp_path / "a.exr", []
    manylights.render(box_filtered(), output=whole, spp=4, denoise=True)
    for number in (1, 2):
        part = {"part": (number, 2), "aovs": "albedo,normal,emission"}
        files += manylights.render(box_filtered(), output=tmp_path / "b.exr", spp=4, **part).files
    merged = tmp_path / "b.exr"
    manylights.merge(files, merged, denoise=True)
    assert_same_planes(whole, merged)
    # Of finished images, too
    manylights.merge([whole], merged, denoise=True)
    assert_same_planes(whole, merged)
    with pytest.raises(UsageError, match=r"denoise True: must be left out with part"):
        manylights.render(scene(), spp=1, denoise=True, part=(1, 2))


def assert_same_planes(path, other):
    """The same channels, and the same bits but for what a mean rounds."""
    first, second = exr.read(path)[0], exr.read(other)[0]
    assert set(first) == set(second)
    for name, plane in first.items():
        np.testing.assert_allclose(plane, second[name], rtol=1e-5, atol=1e-6, err_msg=name)


# ------------------------------------------------------------------------------- the preview


def test_exposure_brightens_the_preview_alone(tmp_path):
    require_variant("scalar_rgb")
    images = []
    for stops in (0.0, 1.0):
        out = tmp_path / f"{stops}.exr"
        manylights.render(scene(intensity=0.3), output=out, spp=4, exposure=stops)
        images.append((exr.read(out)[0]["G"], channels.read_colors(out.with_suffix(".png"))))
    np.testing.assert_array_equal(images[0][0], images[1][0])
    dark = images[1][1][..., 1] < 0.9
    assert dark.mean() > 0.5 and images[0][1].max() > 0.02
    np.testing.assert_allclose(
        images[1][1][..., 1][dark], 2 * images[0][1][..., 1][dark], atol=0.02
    )


@pytest.mark.parametrize("stops", [65, float("nan"), -1e9])
def test_exposures_out_of_range_are_named(stops):
    require_variant("scalar_rgb")
    with pytest.raises(UsageError, match=r"exposure .*: must be a number from -64 to 64"):
        manylights.render(scene(), spp=1, exposure=stops)
