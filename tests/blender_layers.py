"""Writes each layer of an OpenEXR file as Blender's compositor reads it to a file of its own.

PYTHON_WITH_BPY tests/blender_layers.py FILE.exr FOLDER WIDTH HEIGHT
"""

import sys

import bpy


def main(path, folder, width, height):
    """Render the compositor's image node once for each of its outputs."""
    scene = bpy.context.scene
    tree = bpy.data.node_groups.new("layers", "CompositorNodeTree")
    tree.interface.new_socket(name="Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    source, shown = tree.nodes.new("CompositorNodeImage"), tree.nodes.new("NodeGroupOutput")
    source.image = bpy.data.images.load(path)
    scene.compositing_node_group = tree
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.view_settings.view_transform = "Raw"
    render.engine, scene.cycles.samples = "CYCLES", 1
    scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(scene.camera)
    for output in source.outputs:
        tree.links.clear()
        tree.links.new(output, shown.inputs[0])
        render.filepath = f"{folder}/{output.name}.exr"
        bpy.ops.render.render(write_still=True)


main(*sys.argv[1:3], *map(int, sys.argv[3:5]))
