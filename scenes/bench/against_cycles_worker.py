"""Renders with Cycles what `against_cycles.py` asks for; runs in a Python that has `bpy`.

Requests are lines of JSON on standard input, answers lines of JSON on standard output:

    {"load": "scene.npz"}                          -> {}
    {"light_tree": true, "spp": 16, "seed": 1,
     "image": "image.exr"}                         -> {"seconds": 1.5}
"""

from __future__ import annotations

import json
import os
import sys
import time

import bpy
import numpy as np
from mathutils import Matrix

#: Threads of a render, as many as manylights has in `against_cycles.py`.
THREADS = int(sys.argv[1])

BLACK, WHITE = (0.0, 0.0, 0.0, 1.0), (1.0, 1.0, 1.0, 1.0)


class Nodes:
    """The nodes of a new material, the last of which is what it shows."""

    def __init__(self, name: str) -> None:
        self.material = bpy.data.materials.new(name)
        self.material.use_nodes = True
        self.tree = self.material.node_tree
        self.tree.nodes.clear()

    def add(self, kind: str, **inputs):
        """Add a node; inputs are values, or sockets to link."""
        node = self.tree.nodes.new(kind)
        for name, value in inputs.items():
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, node.inputs[name])
            else:
                node.inputs[name].default_value = value
        return node

    def join(self, kind: str, *sockets):
        """Link sockets to the inputs of a new node, in their order."""
        node = self.tree.nodes.new(kind)
        for index, socket in enumerate(sockets):
            self.tree.links.new(socket, node.inputs[index])
        return node.outputs[0]

    def finish(self, shader, place: str = "Surface"):
        output = self.tree.nodes.new("ShaderNodeOutputMaterial")
        self.tree.links.new(shader, output.inputs[place])
        return self.material


def surface(name: str, color, lobe):
    """Diffuse, or rough plastic of the given alpha and eta; without a colour that of the faces."""
    nodes = Nodes(name)
    if color is None:
        attribute = nodes.add("ShaderNodeAttribute")
        attribute.attribute_name = "face_color"
        color = attribute.outputs["Color"]
    else:
        color = (*color, 1.0)
    diffuse = nodes.add("ShaderNodeBsdfDiffuse", Color=color, Roughness=0.0).outputs[0]
    if lobe is None:
        return nodes.finish(diffuse)
    alpha, eta = (float(x) for x in lobe)
    glossy = nodes.add("ShaderNodeBsdfAnisotropic", Color=WHITE, Roughness=np.sqrt(alpha))
    glossy.distribution = "GGX"
    fresnel = nodes.add("ShaderNodeFresnel", IOR=eta)
    return nodes.finish(
        nodes.join("ShaderNodeMixShader", fresnel.outputs[0], diffuse, glossy.outputs[0])
    )


def emitter(name: str, radiance):
    """A surface that shines to its front, constantly: Cycles then knows how bright it is."""
    nodes = Nodes(name)
    strength = float(max(radiance))
    shine = nodes.add(
        "ShaderNodeEmission", Color=(*(radiance / strength), 1.0), Strength=strength
    ).outputs[0]
    black = nodes.add("ShaderNodeBsdfDiffuse", Color=BLACK).outputs[0]
    geometry = nodes.add("ShaderNodeNewGeometry")
    material = nodes.finish(
        nodes.join("ShaderNodeMixShader", geometry.outputs["Backfacing"], shine, black)
    )
    material.cycles.emission_sampling = "FRONT"
    return material


def fog(name: str, extinction: float, albedo: float):
    """Grey, homogeneous and isotropic fog, without a surface."""
    nodes = Nodes(name)
    scatter = nodes.add("ShaderNodeVolumeScatter", Color=WHITE, Density=albedo * extinction)
    absorb = nodes.add("ShaderNodeVolumeAbsorption", Color=BLACK, Density=(1 - albedo) * extinction)
    both = nodes.join("ShaderNodeAddShader", scatter.outputs[0], absorb.outputs[0])
    return nodes.finish(both, "Volume")


def add_mesh(name: str, vertices, faces):
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", np.ravel(vertices).astype(np.float32))
    mesh.loops.add(3 * len(faces))
    mesh.loops.foreach_set("vertex_index", np.ravel(faces).astype(np.int32))
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", 3 * np.arange(len(faces), dtype=np.int32))
    mesh.update(calc_edges=True)
    mesh.shade_flat()
    bpy.context.collection.objects.link(bpy.data.objects.new(name, mesh))
    return mesh


def add_shape(data: dict, index: int) -> None:
    part = lambda key: data[f"{key}_{index}"]  # noqa: E731
    name = f"shape_{index}"
    mesh = add_mesh(name, part("vertices"), part("faces"))
    if f"fog_{index}" in data:
        mesh.materials.append(fog(name, *(float(x) for x in part("fog"))))
        return
    if f"radiance_{index}" in data:
        colors, which = np.unique(part("radiance"), axis=0, return_inverse=True)
        for number, color in enumerate(colors):
            mesh.materials.append(emitter(f"{name}_{number}", color))
        mesh.polygons.foreach_set("material_index", np.ravel(which).astype(np.int32))
        return
    color = part("color")
    if len(color) > 1:
        attribute = mesh.attributes.new("face_color", "FLOAT_COLOR", "FACE")
        rgba = np.concatenate([color, np.ones((len(color), 1))], axis=1)
        attribute.data.foreach_set("color", rgba.ravel().astype(np.float32))
    shared = None if len(color) > 1 else color[0]
    mesh.materials.append(surface(name, shared, data.get(f"lobe_{index}")))


def add_point(position, intensity) -> None:
    light = bpy.data.lights.new("point", "POINT")
    light.shadow_soft_size = 0.0
    strength = float(max(intensity))
    light.color = intensity / strength
    light.energy = 4.0 * np.pi * strength
    item = bpy.data.objects.new("point", light)
    item.location = position
    bpy.context.collection.objects.link(item)


def load(path: str) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    data = dict(np.load(path, allow_pickle=False))
    for index in range(int(data["shapes"])):
        add_shape(data, index)
    for position, intensity in zip(data["positions"], data["intensities"]):
        add_point(position, intensity)
    camera = bpy.data.cameras.new("camera")
    camera.sensor_fit, camera.angle = "HORIZONTAL", float(data["fov"])
    camera.clip_start, camera.clip_end = 1e-2, 1e4
    item = bpy.data.objects.new("camera", camera)
    item.matrix_world = Matrix(data["camera"].tolist())
    bpy.context.collection.objects.link(item)
    settings(item, *(int(x) for x in data["size"]))


def settings(camera, width: int, height: int) -> None:
    """Direct light, unbiased, a box filter of one pixel, no denoiser."""
    scene = bpy.context.scene
    scene.camera = camera
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.threads_mode, render.threads = "FIXED", THREADS
    render.use_persistent_data = True
    render.image_settings.file_format = "OPEN_EXR"
    render.image_settings.color_depth = "32"
    cycles.device, cycles.max_bounces = "CPU", 0
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.light_sampling_threshold = 0.0


def render(light_tree: bool, spp: int, seed: int, image: str) -> dict:
    scene = bpy.context.scene
    scene.cycles.use_light_tree, scene.cycles.samples, scene.cycles.seed = light_tree, spp, seed
    scene.render.filepath = image
    start = time.perf_counter()
    bpy.ops.render.render()
    seconds = time.perf_counter() - start
    bpy.data.images["Render Result"].save_render(image)
    return {"seconds": seconds}


def main() -> None:
    # Blender prints to standard output
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin:
        request = json.loads(line)
        answer = load(request["load"]) if "load" in request else render(**request)
        print(json.dumps(answer or {}), file=answers, flush=True)


if __name__ == "__main__":
    main()
