"""The command ``manylights demo``."""

from __future__ import annotations

import mitsuba as mi

from manylights import lights, loading, scenes
from manylights.cli import options as shared
from manylights.cli.render import render_to
from manylights.loading import integrators, ours, samplers
from manylights.output import images
from manylights.progress import say
from manylights.scenes._build import MOST_LIGHTS

HELP = """\
Generates a city at night with thousands of lights, renders it, and says how long that took.
"""


def add(commands, common) -> None:
    """Add the command to the subparsers ``commands``; ``common`` has the options of all."""
    parser = commands.add_parser(
        "demo", parents=[common], help="render a city with many lights", description=HELP
    )
    parser.add_argument(
        "-o", "--output", default="city", metavar="PREFIX", help="of both images (default: city)"
    )
    positive = shared.positive
    parser.add_argument(
        "--lights",
        type=_lights,
        default=20000,
        help=f"number of lights, at most {MOST_LIGHTS:,} (default: 20000)",
    )
    parser.add_argument(
        "--spp", type=positive, help="samples per pixel (default: 64, scalar variants 16)"
    )
    parser.add_argument("--width", type=positive, default=640, help="in pixels (default: 640)")
    parser.add_argument("--height", type=positive, default=360, help="in pixels (default: 360)")
    shared.add_machine(parser)
    parser.set_defaults(command=_run)


def _run(options) -> None:
    target = images.check_output(f"{options.output.removesuffix('.exr')}.exr")
    variant = shared.start(options)
    spp = options.spp or (16 if variant.startswith("scalar") else 64)
    description = scenes.city(
        options.lights,
        seed=options.seed,
        width=options.width,
        height=options.height,
        spp=spp,
        integrator={"type": ours.DIRECT, "block_size": integrators.BLOCK_SIZE},
    )
    description["sensor"]["sampler"]["type"] = samplers.SOBOL
    loaded = loading.LoadedScene(mi.load_dict(description), 1, [])
    count = sum(lights.count_kinds(loaded.scene).values())
    say(f"lights: {count:,}")
    wanted = {"spp": spp, "seed": options.seed, "threads": options.threads}
    seconds = render_to(loaded, target, wanted).seconds
    print(f"{count:,} lights, {options.width}x{options.height}, {spp} spp: {seconds:.1f} s")


def _lights(text: str) -> int:
    return shared.integer(text, 1, MOST_LIGHTS, f"an integer from 1 to {MOST_LIGHTS:,}")
