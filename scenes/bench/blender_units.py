"""Compare the lights of Blender's USD files with Cycles: what `blender_light_units` has to do.

    python -m venv blender && blender/bin/pip install bpy      # needs its own Python version
    python scenes/bench/blender_units.py blender/bin/python

Each light stands alone above a grey, diffuse plane. Blender renders it with Cycles, direct light
only, and exports the same scene; manylights renders the file. The ratios are means of our image
over Cycles', as the file says it and with `blender_light_units`, for two sizes of each kind, for
objects that are scaled, for meshes that glow and for the world.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

SPP = 512
RESOLUTION = 16

#: Of surfaces without a material.
GREY = (0.18, 0.18, 0.18)

#: Name, type of the light, its settings, and the scale of its object.
LIGHTS = (
    ("point, radius 0", "POINT", {"shadow_soft_size": 0.0}, 1),
    ("point, radius 0.2", "POINT", {"shadow_soft_size": 0.2}, 1),
    ("spot, radius 0", "SPOT", {"shadow_soft_size": 0.0, "spot_size": 1.2}, 1),
    ("spot, radius 0.2", "SPOT", {"shadow_soft_size": 0.2, "spot_size": 1.2}, 1),
    ("sun, 0.5 degrees", "SUN", {"angle": 0.00873}, 1),
    ("sun, 10 degrees", "SUN", {"angle": 0.1745}, 1),
    ("square, 0.5", "AREA", {"size": 0.5}, 1),
    ("square, 2", "AREA", {"size": 2.0}, 1),
    ("rectangle, 1 x 2", "AREA", {"shape": "RECTANGLE", "size": 1.0, "size_y": 2.0}, 1),
    ("square, 1, scaled by 2", "AREA", {"size": 1.0}, 2),
    ("disk, 0.5", "AREA", {"shape": "DISK", "size": 0.5}, 1),
    ("disk, 2", "AREA", {"shape": "DISK", "size": 2.0}, 1),
    ("ellipse, 1 x 2", "AREA", {"shape": "ELLIPSE", "size": 1.0, "size_y": 2.0}, 1),
    ("glowing mesh, 0.5", "MESH", {"size": 0.5}, 1),
    ("glowing mesh, 1, scaled by 2", "MESH", {"size": 1.0}, 2),
    ("world", "WORLD", {}, 1),
    ("point, 0.2, not normalized", "POINT", {"shadow_soft_size": 0.2, "normalize": False}, 1),
    ("sun, 10 degrees, not normalized", "SUN", {"angle": 0.1745, "normalize": False}, 1),
    ("square, 2, not normalized", "AREA", {"size": 2.0, "normalize": False}, 1),
    ("square, 1, scaled by 2, not normalized", "AREA", {"size": 1.0, "normalize": False}, 2),
    ("disk, 2, not normalized", "AREA", {"shape": "DISK", "size": 2.0, "normalize": False}, 1),
)


def with_blender(folder: Path) -> None:
    """Write the image and the stage of each light; runs in a Python that has `bpy`."""
    import bpy

    # Blender prints to standard output
    os.dup2(2, 1)
    for index, (_, kind, settings, scale) in enumerate(LIGHTS):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        plane = _add_plane(bpy)
        item = _add_light(bpy, kind, settings)
        item.location, item.scale = (0.0, 0.0, 3.0), (scale, scale, scale)
        camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        camera.data.lens = 150.0
        camera.location, camera.rotation_euler = (0.0, -6.0, 6.0), (0.7854, 0.0, 0.0)
        bpy.context.collection.objects.link(camera)
        _render(bpy, camera, str(folder / f"{index}.exr"))
        # The plane is diffuse without a material, and of this grey
        plane.data.materials.clear()
        bpy.ops.wm.usd_export(filepath=str(folder / f"{index}.usdc"))


def _add_light(bpy, kind: str, settings: dict):
    """Add a light of Blender, a mesh that glows, or the world; return its object."""
    if kind == "MESH":
        return _add_glowing_mesh(bpy, settings["size"])
    if kind == "WORLD":
        world = bpy.context.scene.world = bpy.data.worlds.new("world")
        world.use_nodes = True
        background = world.node_tree.nodes["Background"]
        background.inputs["Color"].default_value = (0.6, 0.6, 0.6, 1.0)
        background.inputs["Strength"].default_value = 2.0
        item = bpy.data.objects.new("nothing", None)
    else:
        light = bpy.data.lights.new("light", kind)
        light.energy = 3.0 if kind == "SUN" else 100.0
        for name, value in settings.items():
            setattr(light, name, value)
        item = bpy.data.objects.new("light", light)
    bpy.context.collection.objects.link(item)
    return item


def _add_glowing_mesh(bpy, size: float):
    bpy.ops.mesh.primitive_plane_add(size=size)
    material = bpy.data.materials.new("glow")
    material.use_nodes = True
    inputs = material.node_tree.nodes["Principled BSDF"].inputs
    inputs["Base Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    inputs["Emission Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    inputs["Emission Strength"].default_value = 5.0
    bpy.context.object.data.materials.append(material)
    return bpy.context.object


def _add_plane(bpy):
    bpy.ops.mesh.primitive_plane_add(size=20.0)
    plane = bpy.context.object
    material = bpy.data.materials.new("grey")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    diffuse = tree.nodes.new("ShaderNodeBsdfDiffuse")
    diffuse.inputs["Color"].default_value = (*GREY, 1.0)
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(diffuse.outputs[0], output.inputs["Surface"])
    plane.data.materials.append(material)
    return plane


def _render(bpy, camera, path: str) -> None:
    scene = bpy.context.scene
    scene.camera = camera
    render, cycles = scene.render, scene.cycles
    render.engine, render.threads_mode, render.threads = "CYCLES", "FIXED", 2
    render.resolution_x = render.resolution_y = RESOLUTION
    render.image_settings.file_format = "OPEN_EXR"
    render.image_settings.color_depth = "32"
    cycles.device, cycles.max_bounces, cycles.samples = "CPU", 0, SPP
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    bpy.ops.render.render()
    bpy.data.images["Render Result"].save_render(path)


def brightness(path: Path, **options) -> float:
    """Return the mean of our image of a stage."""
    import manylights.usd
    import mitsuba as mi
    import numpy as np

    description = manylights.usd.load(path, **options)
    description["sensor"]["film"] = {"type": "hdrfilm", "width": RESOLUTION, "height": RESOLUTION}
    image = np.array(mi.render(mi.load_dict(description), spp=SPP))
    return float(image[..., :3].mean()) * description.exposure


def main() -> None:
    if sys.argv[1:2] == ["--blender"]:
        with_blender(Path(sys.argv[2]))
        return
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    import mitsuba as mi
    import numpy as np

    mi.set_variant("scalar_rgb")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = [sys.argv[1], __file__, "--blender", name]
        subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
        print("| light | as in the file | `blender_light_units` |\n|---|---|---|", flush=True)
        for index, (title, *_) in enumerate(LIGHTS):
            theirs = np.array(mi.Bitmap(str(folder / f"{index}.exr")))[..., :3].mean()
            stage = folder / f"{index}.usdc"
            ratios = [brightness(stage), brightness(stage, blender_light_units=True)] / theirs
            print(f"| {title} | {ratios[0]:.3f} | {ratios[1]:.3f} |", flush=True)


if __name__ == "__main__":
    main()
