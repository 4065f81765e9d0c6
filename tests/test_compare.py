"""Errors of images on hand-made arrays, and the command `manylights compare`."""

import json

import mitsuba as mi
import numpy as np
import pytest
from manylights.bench import metrics
from manylights.cli import main

pytest.importorskip("flip_evaluator")

SHAPE = (18, 32, 3)


@pytest.fixture(autouse=True)
def scalar_variant(scalar):
    """Bitmaps need some variant."""


@pytest.fixture
def picture():
    return np.random.default_rng(1).random(SHAPE).astype(np.float32)


@pytest.fixture
def write(tmp_path):
    """A function that writes an array as EXR and returns the path as text."""

    def run(name, pixels, channels=("R", "G", "B")):
        path = tmp_path / f"{name}.exr"
        pixels = np.ascontiguousarray(pixels, dtype=np.float32)
        mi.Bitmap(pixels, channel_names=list(channels)).write(str(path))
        return str(path)

    return run


def assert_fails(capsys, arguments, *words):
    """The command returns 2 and prints one line with all the words."""
    assert main(["compare", *arguments]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    for word in words:
        assert word in lines[0]


def test_relative_error_of_a_pixel():
    reference = np.full((2, 2, 3), 2.0)
    image = reference.copy()
    image[0, 1] += [0.3, 0.0, -0.6]
    errors = metrics.relative_errors(image, reference)
    expected = (0.3**2 + 0.6**2) / 3 / (2.0**2 + (0.05 * 2.0) ** 2)
    np.testing.assert_allclose(errors, [[0, expected], [0, 0]])
    assert metrics.relative_mse(image, reference) == pytest.approx(expected / 4)


def test_dark_pixels_are_compared_with_the_mean():
    reference = np.array([[[0.0] * 3, [1.0] * 3]])
    errors = metrics.relative_errors(reference + 0.1, reference)
    assert errors[0, 0] == pytest.approx(0.01 / (0.05 * 0.5) ** 2)


def test_black_references():
    black = np.zeros((1, 2, 3))
    assert metrics.relative_mse(black, black) == 0.0
    assert metrics.relative_mse(black + 1.0, black) == np.inf


def test_trimming_leaves_out_the_worst():
    values = np.array([1.0] * 999 + [1e6])
    assert metrics.trimmed_mean(values, 0.001) == 1.0
    assert metrics.trimmed_mean(values, 0.0) == pytest.approx((999 + 1e6) / 1000)
    assert metrics.trimmed_mean(np.array([3.0])) == 3.0


def test_expected_error_of_a_variance_is_that_of_images():
    """Images of independent normal noise have, on average, the error that their variance says."""
    rng = np.random.default_rng(3)
    reference = rng.uniform(0.5, 2.0, (40, 40, 3))
    sigma = 0.2 * reference
    errors = [
        metrics.relative_mse(reference + sigma * rng.normal(size=sigma.shape), reference)
        for _ in range(20)
    ]
    # 32,000 pixels: the mean of squares varies by less than 1 %.
    expected = metrics.variance_error(sigma**2, reference)
    assert np.mean(errors) == pytest.approx(expected, rel=0.04)


def test_flip_of_equal_images_is_zero(picture):
    assert metrics.flip_error(picture, picture) == 0.0
    assert 0.0 < metrics.flip_error(picture + 0.3, picture) < 1.0


def test_equal_images(capsys, write, picture):
    first, second = write("a", picture), write("b", picture)
    assert main(["compare", first, second]) == 0
    assert "equal" in capsys.readouterr().out


def test_rounding_is_no_difference(write, picture):
    assert main(["compare", write("a", picture * (1 + 1e-6)), write("b", picture)]) == 0


def test_different_images_and_a_larger_threshold(capsys, write, picture):
    paths = [write("a", picture * 1.1), write("b", picture)]
    assert main(["compare", *paths]) == 1
    assert "different" in capsys.readouterr().out
    assert main(["compare", *paths, "--threshold", "0.02"]) == 0


def test_a_single_bad_pixel_is_trimmed_only_if_allowed(write, picture):
    spoilt = picture.copy()
    spoilt[3, 4] = 1e4
    paths = [write("a", spoilt), write("b", picture)]
    assert main(["compare", *paths, "--trim", "0"]) == 1
    assert main(["compare", *paths, "--trim", "0.001"]) == 0


def test_numbers_as_json(capsys, write, picture):
    main(["compare", write("a", picture + 0.5), write("b", picture), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["rmse"] == pytest.approx(0.5, rel=1e-5)
    assert found["mean_difference"] == pytest.approx(0.5, rel=1e-5)
    assert found["relative_mse"] == pytest.approx(
        metrics.relative_mse(picture + 0.5, picture), rel=1e-5
    )
    assert 0.0 < found["flip"] < 1.0
    assert found["equal"] is False


def test_errors_against_a_reference(capsys, write, picture):
    noise = np.random.default_rng(2).normal(size=SHAPE)
    better, worse = write("a", picture + 0.1 * noise), write("b", picture + 0.2 * noise)
    reference = ("--reference", write("r", picture))
    assert main(["compare", better, worse, *reference, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["ratio"]["relative_mse"] == pytest.approx(0.25, rel=1e-3)
    assert found["ratio"]["rmse"] == pytest.approx(0.5, rel=1e-3)
    assert main(["compare", worse, better, *reference]) == 1
    assert "A is worse than B" in capsys.readouterr().out
    assert main(["compare", worse, better, *reference, "--threshold", "5"]) == 0


def test_a_perfect_b_has_no_ratio(write, picture):
    perfect, other = write("b", picture), write("a", picture + 0.1)
    assert main(["compare", perfect, perfect, "--reference", perfect]) == 0
    assert main(["compare", other, perfect, "--reference", perfect]) == 1


def test_picture_is_red_where_a_is_brighter(write, picture, tmp_path):
    spoilt = picture.copy()
    spoilt[:9] *= 2.0
    spoilt[9:, :16] = 0.0
    paths = [write("a", spoilt), write("b", picture)]
    main(["compare", *paths, "-o", str(tmp_path / "diff.png")])
    pixels = np.array(mi.Bitmap(str(tmp_path / "diff.png"))).astype(float)
    top, left, equal = pixels[:9], pixels[9:, :16], pixels[9:, 16:]
    assert top[..., 0].mean() > 200 and top[..., 2].max() == 0
    assert left[..., 2].mean() > 200 and left[..., 0].max() == 0
    assert equal.max() == 0


def test_gray_and_alpha_are_understood(write, picture):
    gray = np.repeat(picture[..., :1], 3, axis=2)
    assert main(["compare", write("a", picture[..., :1], "Y"), write("b", gray)]) == 0
    with_alpha = np.concatenate([picture, np.ones((*SHAPE[:2], 1))], axis=2)
    assert main(["compare", write("c", with_alpha, "RGBA"), write("d", picture)]) == 0


def test_other_sizes(capsys, write, picture):
    paths = [write("a", picture), write("b", picture[:9])]
    assert_fails(capsys, paths, "b.exr", "32 x 9", "32 x 18")


def test_broken_pixels(capsys, write, picture):
    spoilt = picture.copy()
    spoilt[2, 3, 1], spoilt[5, 6] = np.nan, np.inf
    assert_fails(capsys, [write("a", spoilt), write("b", picture)], "a.exr", "2 pixels")


def test_missing_and_unreadable_files(capsys, write, picture, tmp_path):
    good, text = write("a", picture), tmp_path / "text.exr"
    text.write_text("no image")
    assert_fails(capsys, [good, str(tmp_path / "no.exr")], "no.exr", "no such file")
    assert_fails(capsys, [good, str(text)], "text.exr", "not a readable image")


def test_channels_without_colour(capsys, write, picture, tmp_path):
    path = str(tmp_path / "maps.exr")
    formats = mi.Bitmap.PixelFormat
    mi.Bitmap(formats.MultiChannel, mi.Struct.Type.Float32, [32, 18], 2, ["u", "v"]).write(path)
    assert_fails(capsys, [path, write("a", picture)], "maps.exr", "no colour channels")


@pytest.mark.parametrize("name", ["missing/d.png", "d.exr"])
def test_pictures_that_cannot_be_written(capsys, write, picture, tmp_path, name):
    path = write("a", picture)
    assert_fails(capsys, [path, path, "-o", str(tmp_path / name)], name)


@pytest.mark.parametrize("option", [("--threshold", "-1"), ("--threshold", "x"), ("--trim", "1")])
def test_wrong_numbers(capsys, write, picture, option):
    path = write("a", picture)
    with pytest.raises(SystemExit) as raised:
        main(["compare", path, path, *option])
    assert raised.value.code == 2
    assert f"{option[1]}: must be" in capsys.readouterr().err


@pytest.mark.parametrize("factor", [0.0, -1.0, 1e-20, 1e-8, 1e20])
def test_flip_takes_black_and_dim_references(factor):
    """flip-evaluator ends the process where it finds no exposure."""
    image = np.random.default_rng(1).random((16, 16, 3), dtype=np.float32)
    found = metrics.flip_error(image, np.float32(factor) * image)
    assert 0.1 < found <= 1.0
    assert metrics.flip_error(0 * image, np.float32(factor) * image) >= 0.0
    if factor > 0:
        assert metrics.flip_error(factor * image, factor * image) == 0.0


def test_flip_of_black_images_is_nothing():
    black = np.zeros((16, 16, 3), np.float32)
    assert metrics.flip_error(black, black) == metrics.flip_error(-1.0 + black, black) == 0.0
