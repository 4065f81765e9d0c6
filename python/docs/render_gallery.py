"""Renders the pictures of the gallery: a small JPEG for each scene of `scenes/`.

python python/docs/render_gallery.py [NAME ...]    # as points, usd_street; default: all
"""

from __future__ import annotations

import sys
from pathlib import Path

import manylights
import mitsuba as mi
import numpy as np
from manylights import loading
from manylights.output import channels

HERE = Path(__file__).parent
SCENES = HERE.parents[1] / "scenes"

#: Of the XML scenes, in pixels
SIZE = {"resx": "270", "resy": "180"}
SAMPLES = 64
WIDTH = 270


def picture_of(scene: Path) -> Path:
    """Return the file of a scene's picture."""
    prefix = "usd_" if scene.suffix == ".usda" else ""
    return HERE / "gallery" / f"{prefix}{scene.stem}.jpg"


def draw(scene: Path) -> None:
    """Render a scene and write its picture."""
    defines = SIZE if scene.suffix == ".xml" else {}
    image = manylights.render(loading.load(str(scene), defines, "keep", {}), spp=SAMPLES).bitmap
    colors = channels.colors(image).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32)
    width, height = colors.size()
    if width > WIDTH:
        colors = colors.resample([WIDTH, max(1, round(height * WIDTH / width))])
    colors = colors.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    # A new bitmap has no attributes, which would go into the file
    mi.Bitmap(np.array(colors)).write(str(picture_of(scene)), mi.Bitmap.FileFormat.JPEG, 85)


def main() -> None:
    """Draw the scenes that were named, or all."""
    scenes = sorted([*SCENES.glob("*.xml"), *SCENES.glob("usd/*.usda")])
    # Kernels of other variants take longer to compile than these pictures to render.
    mi.set_variant("scalar_rgb")
    for scene in scenes:
        name = picture_of(scene).stem
        if name in sys.argv[1:] or not sys.argv[1:]:
            draw(scene)
            print(name, picture_of(scene).stat().st_size)


if __name__ == "__main__":
    main()
