"""Turns the EXR images of a scene into pictures for the page: crops, error and count maps."""

from __future__ import annotations

import base64
import io
import math
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib
import matplotlib.image
import numpy as np

from manylights.bench import metrics
from manylights.bench.records import Scene, Series
from manylights.errors import UsageError
from manylights.output import channels
from manylights.report import grouping

#: Share of the reference's pixels that the exposure leaves below white.
BELOW_WHITE = 0.97
#: Side of a crop in pixels, at most.
MAX_CROP = 96
#: Larger images are shrunk to this width in pixels: the page holds many.
MAX_WIDTH = 480
#: Colours of maps: lightness rises all the way, so they also work in grey.
ERROR_COLORS, COUNT_COLORS = "inferno", "viridis"
#: Largest error of a map.
MAX_ERROR = 1e12
#: Columns on each side over which a step of the standard deviation is measured.
STEP_WIDTH = 3


@dataclass(frozen=True)
class Picture:
    """An image of 8 bits a channel, with what is written under it."""

    label: str
    pixels: np.ndarray
    alt: str
    notes: list[str] = field(default_factory=list)

    @property
    def uri(self) -> str:
        """The image as an address that is its content."""
        stream = io.BytesIO()
        matplotlib.image.imsave(stream, self.pixels, format="png")
        return data_uri("image/png", stream.getvalue())


@dataclass(frozen=True)
class MapRow:
    """Maps of one quantity on one scale; ``colors`` is matplotlib's name of the colours."""

    title: str
    low: float
    high: float
    logarithmic: bool
    colors: str
    pictures: list[Picture]

    @property
    def gradient(self) -> str:
        """The colours as a CSS gradient, for the scale."""
        stops = matplotlib.colormaps[self.colors](np.linspace(0, 1, 9), bytes=True)[:, :3]
        texts = [f"rgb({', '.join(map(str, stop))})" for stop in stops]
        return f"linear-gradient(to right, {', '.join(texts)})"


@dataclass(frozen=True)
class ScenePictures:
    """All pictures of a scene; ``box`` is the crop's left, top, width and height in percent."""

    scene: Scene
    whole: Picture
    box: tuple[float, float, float, float]
    crops: list[Picture]
    maps: list[MapRow]


def scene_pictures(scene: Scene, epsilon: float, remarks: list[str]) -> ScenePictures | None:
    """Make the pictures of a scene, None if no rendering at equal time was kept.

    What is missing and not needed is told in ``remarks``, and so is a folder that is missing as a
    whole.

    Raises:
        UsageError: the reference or a rendering at equal time is missing or unreadable.
    """
    chosen = [series for series in grouping.shown(scene) if series.equal_time]
    if not chosen:
        return None
    if not scene.folder.is_dir():
        # Results are also published as numbers alone.
        remarks.append(f"{scene.name}: no folder, its pictures are left out")
        return None
    reference = read_image(scene, "reference.exr")
    images = [read_image(scene, f"{series.key}.exr") for series in chosen]
    window = _window(reference)
    exposure = _exposure(reference)
    crops = [Picture("reference", _tone_mapped(reference[window], exposure), "reference, crop")]
    for series, image in zip(chosen, images):
        pixels = _tone_mapped(image[window], exposure)
        name = grouping.label(series)
        alt = f"{name}, crop, error {series.equal_time['error_trimmed']:.2g}"
        crops.append(Picture(name, pixels, alt, _numbers(series)))
    maps = [_error_maps(chosen, images, reference, epsilon), *_count_maps(scene, chosen, remarks)]
    whole = Picture(scene.title, _tone_mapped(_shrink(reference), exposure), "reference, whole")
    return ScenePictures(scene, whole, _percent(window, reference), crops, maps)


def deviation_lines(
    scene: Scene, chosen: list[Series], remarks: list[str]
) -> list[tuple[Series, np.ndarray]]:
    """Standard deviation of one sample by column, from the variance images that there are."""
    lines = []
    for series in chosen if scene.folder.is_dir() else []:
        name = f"{series.key}.variance.exr"
        if (scene.folder / name).exists():
            lines.append((series, np.sqrt(read_image(scene, name).mean(axis=(0, 2)))))
        else:
            remarks.append(f"{scene.name}/{name}: missing, its line is left out")
    return lines


def largest_step(line: np.ndarray) -> float:
    """Largest ratio of the means of a few columns left and right of any column."""
    if len(line) < 2 * STEP_WIDTH or line.min() <= 0:
        return math.nan
    means = np.convolve(line, np.full(STEP_WIDTH, 1 / STEP_WIDTH), "valid")
    ratios = means[STEP_WIDTH:] / means[:-STEP_WIDTH]
    return float(np.exp(np.abs(np.log(ratios)).max()))


def read_image(scene: Scene, name: str) -> np.ndarray:
    """Read three colour channels of an image of ``scene``."""
    found = _read(scene, name)
    try:
        return np.stack([found[channel] for channel in channels.RGB], axis=-1)
    except KeyError as error:
        raise UsageError(f"{scene.folder / name}: no channel {error}") from None


def _read(scene: Scene, name: str) -> dict[str, np.ndarray]:
    """Read all channels of an image by name, and check its size."""
    import mitsuba as mi

    if mi.variant() is None:
        # Files are read in the same way in all variants, but one has to be set.
        mi.set_variant("scalar_rgb")
    path: Path = scene.folder / name
    if not path.exists():
        raise UsageError(f"{path}: no such file, though results.json says that it was rendered")
    planes = channels.read(path)
    height, width = next(iter(planes.values())).shape
    if (height, width) != (scene.height, scene.width):
        size = f"{width} x {height}"
        raise UsageError(f"{path}: {size} pixels instead of {scene.width} x {scene.height}")
    return planes


def _exposure(reference: np.ndarray) -> float:
    """Factor that leaves most pixels of the reference below white."""
    bright = float(np.quantile(reference.max(axis=-1), BELOW_WHITE))
    return 1 / bright if bright > 0 else 1.0


def _window(reference: np.ndarray) -> tuple[slice, slice]:
    """Choose the crop: the square with most contrast in the reference, whatever the methods did."""
    height, width = reference.shape[:2]
    side = max(1, min(MAX_CROP, round(0.6 * min(height, width))))
    logarithm = np.log(reference.mean(axis=-1) + 1e-2 * reference.mean() + 1e-9)
    step = max(1, side // 8)
    places = [
        (top, left)
        for top in range(0, height - side + 1, step)
        for left in range(0, width - side + 1, step)
    ]
    top, left = max(
        places, key=lambda at: logarithm[at[0] : at[0] + side, at[1] : at[1] + side].var()
    )
    return slice(top, top + side), slice(left, left + side)


def _percent(window: tuple[slice, slice], image: np.ndarray) -> tuple[float, float, float, float]:
    height, width = image.shape[:2]
    rows, columns = window
    return (
        100 * columns.start / width,
        100 * rows.start / height,
        100 * (columns.stop - columns.start) / width,
        100 * (rows.stop - rows.start) / height,
    )


def _numbers(series: Series) -> list[str]:
    """What is written under a rendering at equal time."""
    at = series.equal_time
    lines = [
        f"{at['spp']} spp, {at['seconds']:.2g} s",
        f"error {at['error_trimmed']:.3g}",
        f"untrimmed {at['error']:.3g}",
    ]
    if at.get("flip") is not None:
        lines.append(f"FLIP {at['flip']:.3f}")
    return lines


def _error_maps(chosen, images, reference, epsilon: float) -> MapRow:
    errors = [metrics.relative_errors(image, reference, epsilon) for image in images]
    # Where the reference is black everywhere they are infinite.
    errors = [_shrink(np.minimum(error, MAX_ERROR)) for error in errors]
    low, high = _decades(errors)
    pictures = []
    for series, error in zip(chosen, errors):
        shade = (np.log10(np.maximum(error, low)) - math.log10(low)) / math.log10(high / low)
        name = grouping.label(series)
        alt = f"{name}: map of the error"
        pictures.append(Picture(name, _colored(shade, ERROR_COLORS), alt, _numbers(series)[1:2]))
    title = "Relative squared error"
    return MapRow(title, low, high, True, ERROR_COLORS, pictures)


def _decades(errors: list[np.ndarray]) -> tuple[float, float]:
    """Powers of ten around most errors of all methods."""
    together = np.concatenate([error[error > 0] for error in errors] or [np.ones(1)])
    if not len(together):
        return 1e-4, 1.0
    low, high = np.quantile(together, (0.05, 0.995))
    high = 10.0 ** math.ceil(math.log10(high))
    return max(10.0 ** math.floor(math.log10(low)), high / 1e6), high


def _count_maps(scene: Scene, chosen: list[Series], remarks: list[str]) -> list[MapRow]:
    """Maps of what our methods counted, for those whose file is there."""
    found = []
    for series in chosen:
        # Mitsuba's own integrators count nothing, and what looks at all lights counts them all:
        # on its scale the others would look alike.
        if not series.mitsubas and series.method != "exhaustive":
            name = f"{series.key}.maps.exr"
            if (scene.folder / name).exists():
                found.append((series, _read(scene, name)))
            else:
                remarks.append(f"{scene.name}/{name}: missing, its maps are left out")
    for series, counts in found:
        lacking = ", ".join(key for key in channels.WORK if key not in counts)
        if lacking:
            remarks.append(f"{scene.name}/{series.key}.maps.exr: has no channel {lacking}")
    rows = [_count_row(channels.COUNTS[key], key, found) for key in channels.WORK]
    return [row for row in rows if row]


def _count_row(title: str, key: str, found: list) -> MapRow | None:
    counts = [(series, parts[key]) for series, parts in found if key in parts]
    if not counts:
        return None
    high = max(float(np.quantile(count, 0.995)) for _, count in counts) or 1.0
    pictures = []
    for series, count in counts:
        name = grouping.label(series)
        mean = f"mean {count.mean():.3g}"
        pixels = _colored(_shrink(count) / high, COUNT_COLORS)
        pictures.append(Picture(name, pixels, f"{name}: {title}, {mean}", [mean]))
    return MapRow(f"{title} per sample", 0.0, high, False, COUNT_COLORS, pictures)


def _shrink(image: np.ndarray) -> np.ndarray:
    """Average blocks of pixels until the image is narrow enough for the page."""
    factor = math.ceil(image.shape[1] / MAX_WIDTH)
    if factor == 1 or image.shape[0] < factor:
        return image
    height, width = (size // factor * factor for size in image.shape[:2])
    blocks = image[:height, :width].reshape(
        height // factor, factor, width // factor, factor, *image.shape[2:]
    )
    return blocks.mean(axis=(1, 3))


def _tone_mapped(image: np.ndarray, exposure: float) -> np.ndarray:
    """Apply the exposure and the curve of sRGB."""
    linear = np.clip(image * exposure, 0, 1)
    curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(255 * curve).astype(np.uint8)


def _colored(shade: np.ndarray, colors: str) -> np.ndarray:
    return matplotlib.colormaps[colors](np.clip(shade, 0, 1), bytes=True)[..., :3]


def data_uri(kind: str, data: bytes) -> str:
    """Return ``data`` as an address, so that a page needs no other file."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
