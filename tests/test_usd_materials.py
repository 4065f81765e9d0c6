"""Materials of USD stages against numbers: texels, constants, and pictures where they decide."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pxr")

import mitsuba as mi
from hypothesis import given, settings
from hypothesis import strategies as st
from manylights.usd.copies import copies
from manylights.usd.geometry import surfaces_of
from manylights.usd.materials import Materials
from manylights.usd.textures import scaled
from pxr import Usd, UsdUtils

from tests.conftest import require_variant
from tests.usd_surfaces import (
    SQUARE,
    area,
    area_vectors,
    context_of,
    kinds,
    material_on,
    mesh_of,
    meshes_of,
    only,
    picture,
    stage_of,
    volume,
)

ST = """
    texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (
        interpolation = "vertex"
    )
"""
BOUND = "rel material:binding = </m>\n"


@pytest.fixture(autouse=True)
def _scalar():
    require_variant("scalar_rgb")


def square(body=ST + BOUND, name="a"):
    """Return the text of a square with a material."""
    return f'def Mesh "{name}" {{\n{SQUARE}\n{body}\n}}\n'


def preview(inputs="", nodes=""):
    """Return the text of a material with a UsdPreviewSurface."""
    return f"""def Material "m" {{
        token outputs:surface.connect = </m/s.outputs:surface>
        def Shader "s" {{
            uniform token info:id = "UsdPreviewSurface"
            {inputs}
            token outputs:surface
        }}
        {nodes}
    }}\n"""


def image_node(file, inputs="", st=True):
    """Return the text of a texture at /m/t, with texture coordinates st."""
    return f"""def Shader "t" {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @{file}@
            {"float2 inputs:st.connect = </m/r.outputs:result>" if st else ""}
            {inputs}
            float outputs:r
            float outputs:g
            float outputs:b
            float outputs:a
            float3 outputs:rgb
        }}
        def Shader "r" {{
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }}"""


def write(folder, name, pixels):
    """Write an image; its rows run downwards."""
    mi.Bitmap(np.ascontiguousarray(pixels)).write(str(folder / name))


def material_of(text, folder=None, path="/a"):
    """Return the material of a prim, and the notes."""
    stage = stage_of(text, folder)
    context = context_of(stage)
    surface = surfaces_of(stage.GetPrimAtPath(path), context)[0]
    return material_on(surface, Materials(context)), context.notes


def principled(material):
    """Return the dictionary of the BSDF inside of those that wrap it."""
    found = material.bsdf
    while "bsdf" in found:
        found = found["bsdf"]
    return found


def texel(texture, u, v):
    """Evaluate a texture at texture coordinates of USD: one number, or three."""
    found = mi.load_dict(texture)
    si = mi.SurfaceInteraction3f()
    si.uv = [u, 1 - v]
    is_number = texture["bitmap"].pixel_format() == mi.Bitmap.PixelFormat.Y
    return found.eval_1(si) if is_number else np.array(found.eval(si))


def connected(name, output="rgb"):
    """Return the text that connects an input of the surface to the image."""
    kind = "color3f" if output == "rgb" else "float"
    return f"{kind} inputs:{name}.connect = </m/t.outputs:{output}>"


# --- constants ---


def test_surfaces_without_values_have_the_fallbacks():
    material, notes = material_of(square() + preview())
    expected = {"roughness": 0.5, "eta": 1.5, "base_color": {"type": "rgb", "value": [0.18] * 3}}
    assert principled(material) == {"type": "principled", **expected}
    assert material.bsdf["type"] == "twosided" and material.emission is None and not notes


def test_constants_become_those_of_the_principled_bsdf():
    inputs = """
        color3f inputs:diffuseColor = (.25, .5, .75)
        float inputs:roughness = .25
        float inputs:metallic = .5
        float inputs:ior = 1.25
        float inputs:clearcoat = .5
        float inputs:clearcoatRoughness = .25
        color3f inputs:emissiveColor = (2, 4, 8)
    """
    material, _ = material_of(square() + preview(inputs))
    found = principled(material)
    assert found["base_color"]["value"] == [0.25, 0.5, 0.75]
    assert (found["roughness"], found["metallic"], found["eta"]) == (0.25, 0.5, 1.25)
    assert found["clearcoat"] == 0.5
    assert found["clearcoat_gloss"] == pytest.approx((0.1 - 0.0625) / 0.099)
    assert material.emission == {"type": "rgb", "value": [2, 4, 8]}


def test_specular_workflow_becomes_grey_reflectance():
    inputs = "int inputs:useSpecularWorkflow = 1\ncolor3f inputs:specularColor = (.04, .04, .04)"
    material, notes = material_of(square() + preview(inputs + "\nfloat inputs:metallic = 1"))
    assert principled(material)["specular"] == pytest.approx(0.5)
    assert "metallic" not in principled(material) and "eta" not in principled(material)
    assert kinds(notes) == ["specular workflow"]


def test_blocked_inputs_have_the_fallback():
    inputs = "float inputs:roughness = None\ncolor3f inputs:diffuseColor = None"
    material, _ = material_of(square() + preview(inputs))
    assert principled(material)["roughness"] == 0.5


def test_inputs_follow_the_material_interface_and_node_graphs():
    text = """def Material "m" {
        float inputs:rough = .75
        token outputs:surface.connect = </m/g.outputs:surface>
        def NodeGraph "g" {
            float inputs:inner.connect = </m.inputs:rough>
            token outputs:surface.connect = </m/g/s.outputs:surface>
            def Shader "s" {
                uniform token info:id = "UsdPreviewSurface"
                float inputs:roughness.connect = </m/g.inputs:inner>
                token outputs:surface
            }
        }
    }"""
    material, notes = material_of(square() + text)
    assert principled(material)["roughness"] == 0.75 and not notes


# --- images ---


@pytest.mark.parametrize(
    ("shape", "kind", "space", "expected"),
    [
        ((4, 4, 3), np.uint8, "auto", 0.5029),
        ((4, 4, 4), np.uint8, "auto", 0.5029),
        ((4, 4, 3), np.uint8, "sRGB", 0.5029),
        ((4, 4, 3), np.uint8, "raw", 0.7373),
        ((4, 4, 1), np.uint8, "auto", 0.7373),
        ((4, 4, 1), np.uint8, "sRGB", 0.5029),
        ((4, 4, 3), np.uint16, "auto", 0.7373),
        ((4, 4, 3), np.uint16, "sRGB", 0.5029),
    ],
)
def test_colors_are_decoded_by_their_space_and_depth(tmp_path, shape, kind, space, expected):
    write(tmp_path, "i.png", np.full(shape, 188 * (257 if kind == np.uint16 else 1), dtype=kind))
    node = image_node("i.png", f'token inputs:sourceColorSpace = "{space}"')
    text = square() + preview(connected("diffuseColor"), node)
    material, notes = material_of(text, tmp_path)
    value = texel(principled(material)["base_color"], 0.5, 0.5)
    assert value == pytest.approx([expected] * 3, abs=1e-3) and not notes


def test_data_are_raw_unless_srgb_is_authored(tmp_path):
    write(tmp_path, "i.png", np.full((4, 4, 3), 188, dtype=np.uint8))
    for space, expected in (("auto", 0.7373), ("raw", 0.7373), ("sRGB", 0.5029)):
        node = image_node("i.png", f'token inputs:sourceColorSpace = "{space}"')
        material, notes = material_of(
            square() + preview(connected("roughness", "g"), node), tmp_path
        )
        value = texel(principled(material)["roughness"], 0.5, 0.5)
        assert value == pytest.approx(expected, abs=1e-3)
        assert kinds(notes) == (["data color space"] if space == "auto" else [])


def test_color_space_of_the_file_attribute_wins(tmp_path):
    write(tmp_path, "i.png", np.full((4, 4, 3), 188, dtype=np.uint8))
    node = image_node("i.png", 'token inputs:sourceColorSpace = "sRGB"')
    node = node.replace("@i.png@", '@i.png@ (\ncolorSpace = "raw"\n)')
    material, _ = material_of(square() + preview(connected("diffuseColor"), node), tmp_path)
    assert texel(principled(material)["base_color"], 0.5, 0.5) == pytest.approx(
        [0.7373] * 3, abs=1e-3
    )


def test_acescg_by_name_becomes_rec709(tmp_path):
    write(tmp_path, "i.ACEScg.exr", np.full((4, 4, 3), [0.5, 0.25, 0.25], dtype=np.float32))
    material, _ = material_of(
        square() + preview(connected("emissiveColor"), image_node("i.ACEScg.exr")), tmp_path
    )
    # White stays white, so the rest is a quarter of the matrix's first column
    expected = 0.25 + 0.25 * np.array([1.70505, -0.13026, -0.02400])
    assert texel(material.emission, 0.5, 0.5) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(("channel", "expected"), [("r", 0.2), ("g", 0.4), ("b", 0.6), ("a", 0.8)])
def test_channels_are_picked(tmp_path, channel, expected):
    write(tmp_path, "orm.png", np.full((4, 4, 4), [51, 102, 153, 204], dtype=np.uint8))
    node = image_node("orm.png", 'token inputs:sourceColorSpace = "raw"')
    for name in ("roughness", "metallic", "clearcoat"):
        material, notes = material_of(square() + preview(connected(name, channel), node), tmp_path)
        value = texel(principled(material)[name], 0.5, 0.5)
        assert value == pytest.approx(expected, abs=1e-3) and not notes


def test_roughness_comes_from_its_channel_in_a_picture(tmp_path):
    # Green is rough, blue is smooth: a mirror shows the far light only where it is meant to
    write(tmp_path, "i.png", np.full((4, 4, 3), [0, 255, 20], dtype=np.uint8))
    node = image_node("i.png", 'token inputs:sourceColorSpace = "raw"')
    lamp = {"l": {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0}}
    values = []
    for channel in "gb":
        inputs = connected("roughness", channel) + "\nfloat inputs:metallic = 1"
        stage = stage_of(square() + preview(inputs, node), tmp_path)
        values.append(picture(stage, lights=lamp, light=0).mean())
    # Seen and lit along the normal, GGX is F / (4 pi alpha^2) with alpha the squared roughness
    assert values[0] == pytest.approx(0.18 / (4 * np.pi), rel=2e-2)
    assert values[1] > 100 * values[0]


def test_scale_and_bias_follow_the_decoding(tmp_path):
    write(tmp_path, "i.png", np.full((4, 4, 3), 188, dtype=np.uint8))
    extra = "float4 inputs:scale = (.5, 1, 1, 1)\nfloat4 inputs:bias = (.1, 0, -.25, 0)"
    material, _ = material_of(
        square() + preview(connected("diffuseColor"), image_node("i.png", extra)), tmp_path
    )
    linear = 0.50289
    assert texel(principled(material)["base_color"], 0.3, 0.3) == pytest.approx(
        [linear / 2 + 0.1, linear, linear - 0.25], abs=1e-3
    )


QUARTERS = np.array([[[1, 0, 0], [0, 1, 0]], [[0, 0, 1], [1, 1, 1]]], dtype=np.float32)
"""Top row red, green; bottom row blue, white."""


def quarters(folder):
    """Write an image of four large pixels."""
    write(folder, "q.exr", QUARTERS.repeat(8, axis=0).repeat(8, axis=1))


def emissive(folder, extra="", body=ST + BOUND, nodes=""):
    """Return a stage with a square that shines as the image."""
    quarters(folder)
    node = image_node("q.exr", extra)
    return stage_of(square(body) + preview(connected("emissiveColor"), node + nodes), folder)


def shown_quarters(folder):
    """Return the four corners of a picture of the image: its first row is the top one."""
    clamp = 'token inputs:wrapS = "clamp"\ntoken inputs:wrapT = "clamp"'
    return picture(emissive(folder, clamp), size=4, light=0, emission=True)[::3, ::3]


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_images_are_upright_and_not_mirrored(tmp_path, variant):
    require_variant(variant)
    assert shown_quarters(tmp_path) == pytest.approx(QUARTERS, abs=1e-3)


@pytest.mark.parametrize("planted", [lambda uv: uv, lambda uv: 1 - uv])
def test_planted_mirrors_are_found(tmp_path, monkeypatch, planted):
    monkeypatch.setattr("manylights.usd.copies.to_mitsuba_uv", planted)
    assert shown_quarters(tmp_path) != pytest.approx(QUARTERS, abs=0.5)


@pytest.mark.parametrize(
    ("modes", "u", "v", "expected"),
    [
        (("repeat", "repeat"), 1.25, 0.75, "red"),
        (("mirror", "mirror"), 1.25, 0.75, "green"),
        (("clamp", "clamp"), 1.25, 0.75, "green"),
        (("clamp", "clamp"), 0.25, -3.0, "blue"),
        (("black", "black"), 1.25, 0.75, "black"),
        (("black", "black"), 0.25, 0.75, "red"),
        (("black", "black"), 0.25, -0.2, "black"),
        (("useMetadata", "useMetadata"), 1.25, 0.75, "red"),
    ],
)
def test_wrap_modes(tmp_path, modes, u, v, expected):
    wrap = f'token inputs:wrapS = "{modes[0]}"\ntoken inputs:wrapT = "{modes[1]}"'
    colors = {"red": [1, 0, 0], "green": [0, 1, 0], "blue": [0, 0, 1], "black": [0, 0, 0]}
    text = square() + preview(connected("emissiveColor"), image_node("q.exr", wrap))
    quarters(tmp_path)
    material, _ = material_of(text, tmp_path)
    assert texel(material.emission, u, v) == pytest.approx(colors[expected], abs=1e-3)


def test_wrapping_is_noted_only_where_coordinates_leave_the_image(tmp_path):
    assert kinds(meshes_of(emissive(tmp_path))[1]) == []
    far = ST.replace("(1, 1)", "(3, 1)") + BOUND
    assert kinds(meshes_of(emissive(tmp_path, body=far))[1]) == ["wrap"]
    repeat = 'token inputs:wrapS = "repeat"\ntoken inputs:wrapT = "repeat"'
    assert kinds(meshes_of(emissive(tmp_path, repeat, far))[1]) == []


@settings(deadline=None, derandomize=True, database=None, max_examples=25)
@given(
    scale=st.tuples(st.floats(0.3, 2), st.floats(0.3, 2)),
    angle=st.floats(-180, 180),
    shift=st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
    at=st.tuples(st.floats(0, 1), st.floats(0, 1)),
)
def test_transforms_of_texture_coordinates(tmp_path_factory, scale, angle, shift, at):
    folder = tmp_path_factory.mktemp("t", numbered=True)
    ramp = np.stack(np.meshgrid(np.arange(64), np.arange(64)), axis=-1) + 0.5
    ramp = np.concatenate([ramp / 64, np.zeros((64, 64, 1))], axis=2)
    ramp[..., 1] = 1 - ramp[..., 1]  # green is v
    write(folder, "ramp.exr", ramp.astype(np.float32))
    wrap = 'token inputs:wrapS = "clamp"\ntoken inputs:wrapT = "clamp"'
    node = image_node("ramp.exr", wrap).replace("</m/r.outputs:result>", "</m/x.outputs:result>")
    node += f"""
        def Shader "x" {{
            uniform token info:id = "UsdTransform2d"
            float2 inputs:in.connect = </m/r.outputs:result>
            float2 inputs:scale = {scale}
            float inputs:rotation = {angle}
            float2 inputs:translation = {shift}
            float2 outputs:result
        }}"""
    material, _ = material_of(square() + preview(connected("emissiveColor"), node), folder)
    turn = np.radians(angle)
    x, y = np.array(scale) * at
    place = np.array(
        [x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)]
    ) + np.array(shift)
    expected = np.clip(place, 0.5 / 64, 1 - 0.5 / 64)
    assert texel(material.emission, *at)[:2] == pytest.approx(expected, abs=2e-3)


def test_texture_coordinates_are_found_by_name_and_by_connection(tmp_path):
    quarters(tmp_path)
    body = BOUND + ST + ST.replace("primvars:st", "primvars:uv1").replace("(0, 0)", "(.9, .9)")
    node = image_node("q.exr").replace(
        'string inputs:varname = "st"', "string inputs:varname.connect = </m.inputs:name>"
    )
    text = preview(connected("emissiveColor"), node)
    text = text.replace('def Material "m" {', 'def Material "m" {\nstring inputs:name = "uv1"')
    material, _ = material_of(square(body) + text, tmp_path)
    assert material.uv_primvar == "uv1"
    stage = stage_of(square(body) + text, tmp_path)
    meshes, notes = meshes_of(stage)
    uv = np.array(mi.traverse(meshes["mesh0"])["vertex_texcoords"]).reshape(-1, 2)
    assert uv[0] == pytest.approx([0.9, 0.1]) and not notes


def test_meshes_without_texture_coordinates_are_noted(tmp_path):
    _, notes = meshes_of(emissive(tmp_path, body=BOUND))
    assert kinds(notes) == ["texture coordinates"]


def test_udim_tiles_lie_side_by_side(tmp_path):
    for number, color in ((1001, [1, 0, 0]), (1002, [0, 1, 0]), (1012, [0, 0, 1])):
        write(tmp_path, f"t.{number}.exr", np.full((8, 8, 3), color, dtype=np.float32))
    text = square() + preview(connected("emissiveColor"), image_node("t.<UDIM>.exr"))
    material, notes = material_of(text, tmp_path)
    for u, v, expected in (
        *((0.5, 0.5, [1, 0, 0]), (1.5, 0.5, [0, 1, 0])),
        *((1.5, 1.5, [0, 0, 1]), (0.5, 1.5, [0, 0, 0])),
    ):
        assert texel(material.emission, u, v) == pytest.approx(expected, abs=1e-3)
    assert not notes


def test_images_in_packages_are_read(tmp_path):
    quarters(tmp_path)
    text = square() + preview(connected("emissiveColor"), image_node("q.exr"))
    stage = stage_of(text, tmp_path)
    package = str(tmp_path / "all.usdz")
    assert UsdUtils.CreateNewUsdzPackage(stage.GetRootLayer().realPath, package)
    (tmp_path / "q.exr").unlink()
    stage = Usd.Stage.Open(package)
    context = context_of(stage)
    surface = surfaces_of(stage.GetPrimAtPath("/a"), context)[0]
    material = material_on(surface, Materials(context))
    assert texel(material.emission, 0.25, 0.75) == pytest.approx([1, 0, 0], abs=1e-3)
    assert not context.notes


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("none.png", "missing texture"),
        ("tiles.<UDIM>.png", "missing texture"),
        *((name, "broken texture") for name in ("text.png", "cut.png", "huge.png", "cut.exr")),
    ],
)
def test_images_that_cannot_be_read_have_their_fallback(tmp_path, name, kind):
    write(tmp_path, "whole.png", np.full((32, 32, 3), 188, dtype=np.uint8))
    whole = (tmp_path / "whole.png").read_bytes()
    (tmp_path / "text.png").write_text("no image")
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])
    write(tmp_path, "whole.exr", np.full((32, 32, 3), 0.5, dtype=np.float32))
    cut = (tmp_path / "whole.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(cut[: len(cut) // 2])
    (tmp_path / "huge.png").write_bytes(whole[:16] + b"\0\1\0\0" * 2 + whole[24:])
    node = image_node(name, "float4 inputs:fallback = (.1, .2, .3, .4)")
    material, notes = material_of(square() + preview(connected("diffuseColor"), node), tmp_path)
    assert principled(material)["base_color"]["value"] == pytest.approx([0.1, 0.2, 0.3])
    assert kinds(notes) == [kind] and name in notes[0].text and "/m/t" in notes[0].text
    material, _ = material_of(square() + preview(connected("roughness", "a"), node), tmp_path)
    assert principled(material)["roughness"] == pytest.approx(0.4)


def test_images_of_one_pixel_are_constant(tmp_path):
    write(tmp_path, "one.png", np.full((1, 1, 3), 188, dtype=np.uint8))
    material, _ = material_of(
        square() + preview(connected("diffuseColor"), image_node("one.png")), tmp_path
    )
    assert texel(principled(material)["base_color"], 0.1, 0.9) == pytest.approx(
        [0.5029] * 3, abs=1e-3
    )


def test_circles_in_a_network_end(tmp_path):
    quarters(tmp_path)
    node = image_node("q.exr").replace("</m/r.outputs:result>", "</m/x.outputs:result>")
    node += """
        def Shader "x" {
            uniform token info:id = "UsdTransform2d"
            float2 inputs:in.connect = </m/x.outputs:result>
            float2 outputs:result
        }"""
    material, _ = material_of(square() + preview(connected("emissiveColor"), node), tmp_path)
    assert material.emission["type"] == "bitmap"


@pytest.mark.parametrize("variant", ["scalar_rgb", "scalar_spectral"])
@pytest.mark.parametrize("textured", [True, False])
def test_emission_above_one_in_spectra_and_its_scale(tmp_path, variant, textured):
    require_variant(variant)
    write(tmp_path, "e.exr", np.full((4, 4, 3), [20, 5, 0.5], dtype=np.float32))
    inputs = (
        connected("emissiveColor") if textured else "color3f inputs:emissiveColor = (20, 5, .5)"
    )
    stage = stage_of(square() + preview(inputs, image_node("e.exr")), tmp_path)
    image = picture(stage, light=0, emission=True).mean(axis=(0, 1))
    assert image == pytest.approx([20, 5, 0.5], rel=0.05)
    context = context_of(stage)
    surface = surfaces_of(stage.GetPrimAtPath("/a"), context)[0]
    material = material_on(surface, Materials(context))
    half = {
        "m": mesh_of(
            surface, material, context, np.eye(4), "m", scaled(material.emission, [0.5, 1, 2])
        )
    }
    image = picture(stage_of(""), light=0, entries=half).mean(axis=(0, 1))
    assert image == pytest.approx([10, 5, 1], rel=0.05)


# --- normal maps ---


def lit_by(text, folder, direction):
    """Return the brightness of the square under light that travels in a direction."""
    lamp = {"l": {"type": "directional", "direction": direction, "irradiance": 1.0}}
    return picture(stage_of(text, folder), size=4, light=0, lights=lamp).mean()


@pytest.mark.parametrize(
    ("tilt", "towards"),
    [((0.6, 0, 0.8), [1, 0]), ((0, 0.6, 0.8), [0, 1]), ((-0.6, 0, 0.8), [-1, 0])],
)
def test_normal_maps_tilt_along_texture_coordinates(tmp_path, tilt, towards):
    encoded = np.round((np.array(tilt) + 1) / 2 * 255).astype(np.uint8)
    write(tmp_path, "n.png", np.tile(encoded, (4, 4, 1)))
    extra = "float4 inputs:scale = (2, 2, 2, 1)\nfloat4 inputs:bias = (-1, -1, -1, 0)"
    node = image_node("n.png", extra + '\ntoken inputs:sourceColorSpace = "raw"')
    text = square() + preview(
        "normal3f inputs:normal.connect = </m/t.outputs:rgb>\nfloat inputs:roughness = 1", node
    )
    side = np.array([*towards, 0.2])
    near, far = (lit_by(text, tmp_path, list(-side * [s, s, 1])) for s in (1, -1))
    flat = lit_by(square() + preview("float inputs:roughness = 1"), tmp_path, list(-side))
    assert near > 1.5 * flat and far < 0.5 * flat


def test_other_scales_of_normal_maps_are_encoded_anew(tmp_path):
    write(tmp_path, "n.exr", np.full((4, 4, 3), [0.6, 0, 0.8], dtype=np.float32))
    write(tmp_path, "n.png", np.full((4, 4, 3), [204, 128, 230], dtype=np.uint8))
    cases = {
        ("n.exr", ""): [0.8, 0.5, 0.9],
        ("n.png", "float4 inputs:scale = (-2, 2, 2, 1)\nfloat4 inputs:bias = (1, -1, -1, 0)"): [
            *(0.2, 0.502, 0.902)
        ],
        ("n.png", ""): [0.8, 0.502, 0.902],
    }
    for (file, extra), expected in cases.items():
        node = image_node(file, extra + '\ntoken inputs:sourceColorSpace = "raw"')
        text = square() + preview("normal3f inputs:normal.connect = </m/t.outputs:rgb>", node)
        material, notes = material_of(text, tmp_path)
        values = np.array(material.bsdf["bsdf"]["normalmap"]["bitmap"])[0, 0]
        assert values == pytest.approx(expected, abs=2e-3)
        assert kinds(notes) == (["normal map"] if (file, extra) == ("n.png", "") else [])


# --- opacity ---

BLACK = """
    color3f inputs:diffuseColor = (0, 0, 0)
    int inputs:useSpecularWorkflow = 1
    color3f inputs:specularColor = (0, 0, 0)
"""


def sky_through(inputs, folder=None, nodes=""):
    """Return how much of the sky is seen through a black square."""
    return picture(stage_of(square() + preview(BLACK + inputs, nodes), folder), size=8)


@pytest.mark.parametrize(
    ("opacity", "threshold", "seen"),
    [(0.5, 0.5, 0), (0.5, 0.51, 1), (0.25, 0, 0.75), (1, 0, 0), (0, 0, 1)],
)
def test_opacity_and_its_threshold(opacity, threshold, seen):
    inputs = f"float inputs:opacity = {opacity}\nfloat inputs:opacityThreshold = {threshold}"
    assert sky_through(inputs).mean() == pytest.approx(seen, abs=0.04)


def test_opacity_is_noted_unless_it_is_presence():
    text = square() + preview("float inputs:opacity = .5")
    assert kinds(material_of(text)[1]) == ["opacity"]
    text = square() + preview('float inputs:opacity = .5\ntoken inputs:opacityMode = "presence"')
    assert kinds(material_of(text)[1]) == []


def test_opaque_alpha_makes_no_mask(tmp_path):
    write(tmp_path, "i.png", np.full((4, 4, 3), 188, dtype=np.uint8))
    text = square() + preview(connected("opacity", "a"), image_node("i.png"))
    material, notes = material_of(text, tmp_path)
    assert material.bsdf["type"] == "twosided" and not notes


def test_cutouts_are_sharp(tmp_path):
    alpha = np.zeros((8, 8, 4), dtype=np.uint8)
    alpha[:, :4, 3], alpha[:, 4:, 3] = 127, 128
    write(tmp_path, "i.png", alpha)
    inputs = connected("opacity", "a") + "\nfloat inputs:opacityThreshold = 0.5"
    image = sky_through(inputs, tmp_path, image_node("i.png"))
    assert image[:, :4] == pytest.approx(1, abs=1e-3)
    assert image[:, 4:] == pytest.approx(0, abs=1e-3)


# --- without a material ---


@pytest.mark.parametrize("from_z", [1, -1])
def test_squares_are_grey_from_both_sides(from_z):
    image = picture(stage_of(square("")), size=4, from_z=from_z)
    assert image.mean() == pytest.approx(0.18, rel=1e-3)


def test_display_color_of_faces_and_vertices_in_pictures():
    color = 'color3f[] primvars:displayColor = {} (\ninterpolation = "{}"\n)'
    faces = square(color.format("[(.2, .4, .6)]", "uniform"))
    assert picture(stage_of(faces), size=4).mean(axis=(0, 1)) == pytest.approx(
        [0.2, 0.4, 0.6], rel=1e-3
    )
    # Black on the left, white on the right
    ramp = square(color.format("[(0,0,0), (1,1,1), (1,1,1), (0,0,0)]", "vertex"))
    image = picture(stage_of(ramp), size=16).mean(axis=(0, 2))
    assert image == pytest.approx((np.arange(16) + 0.5) / 16, abs=0.02)


def test_display_opacity_is_a_mask():
    body = "color3f[] primvars:displayColor = [(0, 0, 0)]\nfloat[] primvars:displayOpacity = [.25]"
    assert picture(stage_of(square(body)), size=8).mean() == pytest.approx(0.75, abs=0.02)


def of_color(primvar):
    """Return a material whose color is a primvar of surfaces."""
    nodes = f"""def Shader "c" {{
        uniform token info:id = "UsdPrimvarReader_float3"
        string inputs:varname = "{primvar}"
        float3 inputs:fallback = (.1, .2, .3)
        float3 outputs:result
    }}"""
    return preview("color3f inputs:diffuseColor.connect = </m/c.outputs:result>", nodes)


def test_readers_of_display_color_in_a_material():
    text = of_color("displayColor")
    body = BOUND + "color3f[] primvars:displayColor = [(.5, .5, .5)]"
    material, _ = material_of(square(body) + text)
    assert principled(material)["base_color"] == {"type": "mesh_attribute", "name": "face_color"}
    material, notes = material_of(square(BOUND) + text)
    assert principled(material)["base_color"]["value"] == pytest.approx([0.1, 0.2, 0.3])
    assert kinds(notes) == ["primvar reader"]


def seen_colors(folder, text):
    """Return the reflectance at four places of the square."""
    from manylights import usd

    path = folder / "colors.usda"
    path.write_text("#usda 1.0\n" + text)
    description = usd.load(path)
    scene, found = mi.load_dict(description), []
    for x, y in ((-0.9, -0.8), (0.8, -0.9), (0.9, 0.8), (-0.8, 0.9)):
        si = scene.ray_intersect(mi.Ray3f([x, y, 5.0], [0, 0, -1]))
        found.append(np.ravel(si.bsdf().eval_diffuse_reflectance(si)))
    return np.array(found), description.notes


@pytest.mark.parametrize("interpolation", ["faceVarying", "vertex", "uniform"])
def test_a_material_may_read_any_color_of_its_mesh(tmp_path, interpolation):
    """As Blender writes color attributes; displayColor is another one."""
    text = of_color("Col")
    corners = np.array([(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0)], dtype=float)
    values = corners[:1] if interpolation == "uniform" else corners
    listed = ", ".join(str(tuple(value.tolist())) for value in values)
    body = f'color3f[] primvars:Col = [{listed}] (\ninterpolation = "{interpolation}"\n)\n'
    body += "color3f[] primvars:displayColor = [(.5, .5, .5)]\n"
    found, notes = seen_colors(tmp_path, square(BOUND + body) + text)
    expected = corners[:1] if interpolation == "uniform" else corners
    assert np.allclose(found, expected, atol=0.2)
    assert "primvar reader" not in kinds(notes)


def test_a_color_that_the_mesh_does_not_have_is_noted(tmp_path):
    text = of_color("Col")
    found, notes = seen_colors(tmp_path, square(BOUND) + text)
    assert np.allclose(found, [0.1, 0.2, 0.3]) and "primvar reader" in kinds(notes)


# --- bindings ---


def other(name, red):
    """Return the text of a material with a color of its own."""
    text = preview(f"color3f inputs:diffuseColor = ({red}, 0, 0)")
    return text.replace("/m", f"/{name}").replace('"m"', f'"{name}"')


@pytest.mark.parametrize(
    ("bindings", "red"),
    [
        ({"": "x", ":preview": "y", ":full": "z"}, 0.75),
        ({"": "x", ":preview": "y"}, 0.5),
        ({"": "x"}, 0.25),
        ({":full": "z"}, 0.75),
    ],
)
@pytest.mark.parametrize("applied", [False, True])
def test_bindings_for_full_renders_beat_previews_beat_all(bindings, red, applied):
    lines = "\n".join(f"rel material:binding{k} = </{name}>" for k, name in bindings.items())
    text = square(lines)
    if applied:
        text = text.replace('"a" {', '"a" (\nprepend apiSchemas = ["MaterialBindingAPI"]\n) {')
    text += other("x", 0.25) + other("y", 0.5) + other("z", 0.75)
    assert principled(material_of(text)[0])["base_color"]["value"] == [red, 0, 0]


def test_bindings_are_inherited_and_subsets_have_their_own():
    text = (
        f"""def Xform "w" {{
        rel material:binding = </x>
        def Mesh "a" {{ {SQUARE}
            def GeomSubset "s" {{
                uniform token elementType = "face"
                uniform token familyName = "materialBind"
                int[] indices = [0]
                rel material:binding = </y>
            }}
        }}
        def Mesh "b" {{ {SQUARE}
        }}
    }}
    """
        + other("x", 0.25)
        + other("y", 0.5)
    )
    assert principled(material_of(text, path="/w/a")[0])["base_color"]["value"] == [0.5, 0, 0]
    assert principled(material_of(text, path="/w/b")[0])["base_color"]["value"] == [0.25, 0, 0]


def test_only_the_emissive_subset_shines():
    # Two unit squares, of which one has the radiance 5: the flux is 5 pi
    text = """def Mesh "a" {
        int[] faceVertexCounts = [4, 4]
        int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 5, 4]
        point3f[] points = [(-1, 0, 0), (0, 0, 0), (1, 0, 0), (-1, 1, 0), (0, 1, 0), (1, 1, 0)]
        def GeomSubset "s" {
            uniform token elementType = "face"
            uniform token familyName = "materialBind"
            int[] indices = [1]
            rel material:binding = </m>
        }
    }
    """ + preview("color3f inputs:emissiveColor = (5, 5, 5)")
    stage = stage_of(text)
    context = context_of(stage)
    surfaces = surfaces_of(stage.GetPrimAtPath("/a"), context)
    materials = [material_on(surface, Materials(context)) for surface in surfaces]
    flux = [
        np.pi * area(s) * m.emission["value"][0] for s, m in zip(surfaces, materials) if m.emission
    ]
    assert flux == pytest.approx([5 * np.pi])
    image = picture(stage, size=2, light=0, emission=True).mean(axis=2)
    assert image == pytest.approx(np.array([[0, 5], [0, 0]]))


def test_materials_that_are_missing_or_without_a_surface_are_counted():
    text = square("rel material:binding = </gone>") + "".join(
        square(BOUND.replace("/m", "/empty"), f"b{i}") for i in range(3)
    )
    text += 'def Material "empty" {\n}\n'
    _, notes = meshes_of(stage_of(text))
    assert kinds(notes) == ["missing material", "material without a surface"]
    assert notes[1].count == 3 and "3" in notes[1].text and "Principled BSDF" in notes[1].text


def test_shaders_of_other_renderers_are_grey_with_one_note():
    text = (
        square()
        + """def Material "m" {
        token outputs:arnold:surface.connect = </m/s.outputs:out>
        def Shader "s" {
            uniform token info:id = "arnold:standard_surface"
            token outputs:out
        }
    }"""
    )
    material, notes = material_of(text)
    assert material.bsdf["bsdf"]["reflectance"]["value"] == [0.18] * 3
    assert len(notes) == 1 and "arnold:standard_surface" in notes[0].text


# --- MaterialX, OmniPBR, Mitsuba ---


def mtlx(identifier, inputs, nodes=""):
    """Return the text of a material in MaterialX's context."""
    return f"""def Material "m" {{
        token outputs:mtlx:surface.connect = </m/s.outputs:out>
        def Shader "s" {{
            uniform token info:id = "{identifier}"
            {inputs}
            token outputs:out
        }}
        {nodes}
    }}\n"""


def test_standard_surface():
    inputs = """
        float inputs:base = .5
        color3f inputs:base_color = (.2, .4, .6)
        float inputs:metalness = .25
        float inputs:specular_roughness = .75
        float inputs:specular_IOR = 1.25
        float inputs:emission = 3
        color3f inputs:emission_color = (1, 2, 0)
        color3f inputs:opacity = (.5, .5, .5)
    """
    material, notes = material_of(square() + mtlx("ND_standard_surface_surfaceshader", inputs))
    found = principled(material)
    assert found["base_color"]["value"] == pytest.approx([0.1, 0.2, 0.3])
    assert (found["metallic"], found["roughness"], found["eta"]) == (0.25, 0.75, 1.25)
    assert material.emission["value"] == pytest.approx([3, 6, 0])
    assert material.bsdf["type"] == "mask" and material.bsdf["opacity"] == pytest.approx(0.5)
    assert not notes


@pytest.mark.parametrize(
    "node, weight, index",
    [
        ("ND_standard_surface_surfaceshader", "specular", "specular_IOR"),
        ("ND_open_pbr_surface_surfaceshader", "specular_weight", "specular_ior"),
    ],
)
@pytest.mark.parametrize("share", [0.0, 0.25, 2.0])
def test_specular_weight_scales_the_reflectance_at_normal_incidence(node, weight, index, share):
    inputs = f"float inputs:{weight} = {share}\nfloat inputs:{index} = 1.6"
    material, notes = material_of(square() + mtlx(node, inputs))
    eta = principled(material)["eta"]
    reflectance = share * (0.6 / 2.6) ** 2
    assert ((eta - 1) / (eta + 1)) ** 2 == pytest.approx(reflectance, abs=1e-7)
    assert not notes
    _, notes = material_of(square() + mtlx(node, "color3f inputs:specular_color = (1, .5, 1)"))
    assert "specular_color" in notes[0].text


def test_open_pbr_surface_and_its_fallbacks():
    text = mtlx("ND_open_pbr_surface_surfaceshader", "float inputs:emission_luminance = 5")
    material, _ = material_of(square() + text)
    assert principled(material)["base_color"]["value"] == [0.8] * 3
    assert principled(material)["roughness"] == pytest.approx(0.3)
    assert material.emission["value"] == [5, 5, 5]


def test_unlit_surface_only_emits():
    inputs = "float inputs:emission = 2\ncolor3f inputs:emission_color = (1, .5, 0)"
    material, notes = material_of(square() + mtlx("ND_surface_unlit", inputs))
    assert material.emission["value"] == [2, 1, 0] and not notes
    assert principled(material)["base_color"]["value"] == [0, 0, 0]


def test_black_emissive_images_make_no_lights(tmp_path):
    write(tmp_path, "i.png", np.zeros((4, 4, 3), dtype=np.uint8))
    text = square() + preview(connected("emissiveColor"), image_node("i.png"))
    assert material_of(text, tmp_path)[0].emission is None


def test_images_of_material_x(tmp_path):
    quarters(tmp_path)
    nodes = """
        def Shader "i" {
            uniform token info:id = "ND_tiledimage_color3"
            asset inputs:file = @q.exr@
            float2 inputs:uvtiling = (2, 1)
            color3f outputs:out
        }
        def Shader "e" {
            uniform token info:id = "ND_extract_color3"
            color3f inputs:in.connect = </m/i.outputs:out>
            int inputs:index = 1
            float outputs:out
        }
        def Shader "n" {
            uniform token info:id = "ND_normalmap_float"
            float3 inputs:in.connect = </m/i.outputs:out>
            float3 outputs:out
        }
    """
    inputs = """
        color3f inputs:base_color.connect = </m/i.outputs:out>
        float inputs:specular_roughness.connect = </m/e.outputs:out>
        float3 inputs:normal.connect = </m/n.outputs:out>
    """
    text = square() + mtlx("ND_standard_surface_surfaceshader", inputs, nodes)
    material, notes = material_of(text, tmp_path)
    found = principled(material)
    assert texel(found["base_color"], 0.125, 0.75) == pytest.approx([1, 0, 0], abs=1e-3)
    assert texel(found["base_color"], 0.375, 0.75) == pytest.approx([0, 1, 0], abs=1e-3)
    assert texel(found["roughness"], 0.375, 0.75) == pytest.approx(1, abs=1e-3)
    assert texel(found["roughness"], 0.125, 0.75) == pytest.approx(0, abs=1e-3)
    normals = np.array(material.bsdf["bsdf"]["normalmap"]["bitmap"])
    assert normals[0, 0] == pytest.approx([1, 0, 0]) and not notes


def test_preview_surface_is_taken_before_other_contexts():
    text = preview("float inputs:roughness = .25").replace(
        "token outputs:surface.connect",
        "token outputs:mtlx:surface.connect = </m/t.outputs:out>\ntoken outputs:surface.connect",
        1,
    )
    material, _ = material_of(square() + text)
    assert principled(material)["roughness"] == 0.25


def test_constants_of_omni_pbr():
    text = (
        square()
        + """def Material "m" {
        token outputs:mdl:surface.connect = </m/s.outputs:out>
        def Shader "s" {
            uniform token info:implementationSource = "sourceAsset"
            uniform asset info:mdl:sourceAsset = @OmniPBR.mdl@
            uniform token info:mdl:sourceAsset:subIdentifier = "OmniPBR"
            color3f inputs:diffuse_color_constant = (.1, .2, .3)
            float inputs:metallic_constant = .5
            token outputs:out
        }
    }"""
    )
    found = principled(material_of(text)[0])
    assert found["base_color"]["value"] == pytest.approx([0.1, 0.2, 0.3])
    assert found["metallic"] == 0.5


def test_shaders_of_mitsuba_become_their_dictionaries(tmp_path):
    quarters(tmp_path)
    text = (
        square()
        + """def Material "m" {
        token outputs:surface.connect = </m/p.outputs:surface>
        token outputs:mitsuba:surface.connect = </m/s.outputs:out>
        def Shader "p" {
            uniform token info:id = "UsdPreviewSurface"
            token outputs:surface
        }
        def Shader "s" {
            uniform token info:id = "mitsuba_twosided"
            token inputs:nested_bsdf.connect = </m/s/n.outputs:out>
            token outputs:out
            def Shader "n" {
                uniform token info:id = "mitsuba_roughplastic"
                float inputs:alpha = .25
                color3f inputs:diffuse_reflectance.connect = </m/s/t.outputs:rgb>
                token outputs:out
            }
            def Shader "t" {
                uniform token info:id = "mitsuba_bitmap"
                asset inputs:filename = @q.exr@
                matrix3d inputs:to_uv = ((2, 0, 0), (0, 3, 0), (5, 0, 1))
                float3 outputs:rgb
            }
        }
    }"""
    )
    material, notes = material_of(text, tmp_path)
    nested = material.bsdf["nested_bsdf"]
    assert material.bsdf["type"] == "twosided" and nested["type"] == "roughplastic"
    assert nested["alpha"] == 0.25
    assert nested["diffuse_reflectance"]["filename"] == str(tmp_path / "q.exr")
    matrix = np.array(nested["diffuse_reflectance"]["to_uv"].matrix)
    assert matrix == pytest.approx(np.array([[2, 0, 5], [0, 3, 0], [0, 0, 1]]))
    assert not notes
    mi.load_dict(material.bsdf)


# --- meshes ---

matrices = st.lists(st.floats(-2, 2), min_size=12, max_size=12).map(
    lambda x: np.vstack([np.array(x).reshape(3, 4), [0, 0, 0, 1]])
)


@settings(deadline=None, derandomize=True, database=None, max_examples=50)
@given(matrices)
def test_outsides_stay_outside_under_any_matrix(matrix):
    determinant = np.linalg.det(matrix[:3, :3])
    if abs(determinant) < 0.05:
        return
    ball = only('def Sphere "a" {}')
    moved = copies(ball, None, matrix.T[None])
    assert volume(moved) == pytest.approx(abs(determinant) * volume(ball), rel=1e-3)
    outside = np.einsum("mi,mki->mk", area_vectors(moved), moved.normals[moved.faces])
    # The flat triangles of a squeezed ball are a little off its normals
    assert outside.sum() / 3 > 0.98 * area(moved) and (outside > -0.02 * area(moved)).all()
    assert np.linalg.norm(moved.normals, axis=1) == pytest.approx(1, abs=1e-5)


def test_mirrored_lamps_shine_to_their_outside():
    text = 'def Xform "w" {\ndouble3 xformOp:scale = (-1, 1, 1)\n'
    text += 'uniform token[] xformOpOrder = ["xformOp:scale"]\n' + square() + "}\n"
    text += preview("color3f inputs:emissiveColor = (2, 2, 2)")
    for from_z, expected in ((1, 2), (-1, 0)):
        image = picture(stage_of(text), size=4, from_z=from_z, light=0, emission=True)
        assert image.mean() == pytest.approx(expected)


def test_meshes_with_zero_normals_have_those_of_their_faces():
    body = 'normal3f[] normals = [(0, 0, 0)] (\ninterpolation = "constant"\n)'
    meshes, _ = meshes_of(stage_of(square(body)))
    normals = np.array(mi.traverse(meshes["mesh0"])["vertex_normals"]).reshape(-1, 3)
    assert normals == pytest.approx(np.tile([0, 0, 1], (4, 1)))


# --- anything at all ---

odd_values = st.sampled_from(
    [
        *("float {} = nan", "float {} = inf", "float {} = -3", "int {} = 2", 'string {} = "a"'),
        *("color3f {} = (2, nan, -1)", "float2 {} = (1, 2)", "token {}", "asset {} = @none.png@"),
        *("float {} = None", "float[] {} = [1, 2]", "float {}.connect = </m/gone.outputs:out>"),
        *("float4 {} = (1, 2, 3, 4)", "float {}.connect = </m.inputs:gone>", "bool {} = true"),
        "float {}.connect = </m/s.outputs:surface>",
    ]
)
INPUTS = (
    *("diffuseColor", "roughness", "metallic", "ior", "clearcoat", "clearcoatRoughness", "opacity"),
    *("opacityThreshold", "emissiveColor", "normal", "useSpecularWorkflow", "specularColor"),
    *("displacement", "occlusion", "opacityMode"),
)


@settings(deadline=None, derandomize=True, database=None, max_examples=50)
@given(st.dictionaries(st.sampled_from(INPUTS), odd_values, max_size=4))
def test_no_input_of_a_surface_breaks_the_reader(inputs):
    lines = "\n".join(text.format(f"inputs:{name}") for name, text in inputs.items())
    material, _ = material_of(square() + preview(lines))
    mi.load_dict(material.bsdf)
    if material.emission:
        mi.load_dict({"type": "area", "radiance": material.emission})


@settings(deadline=None, derandomize=True, database=None, max_examples=30)
@given(
    st.dictionaries(
        st.sampled_from(
            ("file", "st", "scale", "bias", "fallback", "wrapS", "wrapT", "sourceColorSpace")
        ),
        odd_values,
        max_size=3,
    )
)
def test_no_input_of_a_texture_breaks_the_reader(inputs):
    lines = "\n".join(text.format(f"inputs:{name}") for name, text in inputs.items())
    lines = 'uniform token info:id = "UsdUVTexture"\n' + lines
    node = f'def Shader "t" {{\n{lines}\nfloat3 outputs:rgb\n}}'
    text = square() + preview(connected("diffuseColor"), node)
    meshes, _ = meshes_of(stage_of(text))
    assert len(meshes) == 1
