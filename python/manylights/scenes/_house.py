"""A house with three floors of rooms: most of its lights cannot be seen from where one is."""

from __future__ import annotations

import numpy as np

from manylights.scenes import _build as build

#: Rooms along each side of a floor, and floors.
SIDE, FLOORS = 6, 3
#: Metres: the side of a room, its height, half the width of a door and its height, the thickness
#: of walls and of floors.
ROOM, CEILING, DOOR_HALF, DOOR_HEIGHT, WALL, SLAB = 4.0, 2.6, 0.5, 2.0, 0.1, 0.3
STOREY = CEILING + SLAB


def house(
    n_lights: int = 1000,
    *,
    seed: int = 0,
    width: int = 256,
    height: int = 144,
    spp: int = 16,
    integrator="manylights_direct",
) -> dict:
    """108 rooms on three floors, with doors, furniture, and bulbs that hang anywhere in them.

    Rooms differ in brightness by two decades, and so do the bulbs of a room: the brightest lights
    are behind walls, floors and ceilings nearly everywhere. The total power does not depend on the
    number of bulbs.

    Args:
        n_lights: number of point lights, 1 to 1,000,000.
        seed: of the random numbers.
        width, height: of the image in pixels.
        spp: samples per pixel.
        integrator: name of a plugin, or its dictionary.
    """
    n_lights = build.check_count(n_lights)
    build.require_variant()
    rng = build.random(seed)
    low, high = np.array(_slabs() + _walls() + _furniture(rng)).swapaxes(0, 1)
    parts = {
        "rooms": build.boxes("rooms", low, high, rng.uniform(0.4, 0.7, (len(low), 3))),
        **build.numbered("bulb", _bulbs(rng, n_lights)),
    }
    corner = np.array([2 * ROOM, 2 * ROOM, STOREY])
    sensor = build.camera(
        corner + np.array([0.3, 0.3, 1.6]),
        corner + np.array([ROOM, 0.8 * ROOM, 1.2]),
        width=width,
        height=height,
        spp=spp,
        fov=80.0,
    )
    return build.scene(integrator, sensor, parts)


def _slabs() -> list:
    """Return the boxes of the floors and of the roof as pairs of corners."""
    end = SIDE * ROOM + WALL
    return [
        ([-WALL, -WALL, level * STOREY - SLAB], [end, end, level * STOREY])
        for level in range(FLOORS + 1)
    ]


def _walls() -> list:
    """Return the walls; those between two rooms leave a door."""
    middle = 0.5 * ROOM
    with_door = [
        (0.0, middle - DOOR_HALF, 0.0),
        (middle + DOOR_HALF, ROOM, 0.0),
        (middle - DOOR_HALF, middle + DOOR_HALF, DOOR_HEIGHT),
    ]
    walls = []
    for index in np.ndindex(FLOORS, 2, SIDE + 1, SIDE):
        level, axis, line, place = index
        pieces = [(0.0, ROOM, 0.0)] if line in (0, SIDE) else with_door
        for begin, end, bottom in pieces:
            low, high = np.zeros(3), np.zeros(3)
            low[axis], high[axis] = line * ROOM - 0.5 * WALL, line * ROOM + 0.5 * WALL
            low[1 - axis], high[1 - axis] = place * ROOM + begin, place * ROOM + end
            low[2], high[2] = level * STOREY + bottom, level * STOREY + CEILING
            walls.append((low, high))
    return walls


def _furniture(rng: np.random.Generator) -> list:
    """Return boxes on the floors, two for each room."""
    boxes = []
    for level in np.repeat(np.arange(FLOORS), 2 * SIDE * SIDE):
        center = rng.uniform(0.4, SIDE * ROOM - 0.4, 2)
        half, top = rng.uniform(0.08, 0.25, 2), rng.uniform(0.3, 1.2)
        bottom = level * STOREY
        boxes.append(([*(center - half), bottom], [*(center + half), bottom + top]))
    return boxes


def _bulbs(rng: np.random.Generator, count: int) -> list:
    """Return point lights in rooms of random brightness."""
    room = rng.integers(0, [SIDE, SIDE, FLOORS], (count, 3))
    gain = build.log_uniform(rng, SIDE * SIDE * FLOORS, 1.0, 2.0).reshape(SIDE, SIDE, FLOORS)
    place = rng.uniform([0.2, 0.2, 0.8], [ROOM - 0.2, ROOM - 0.2, CEILING - 0.1], (count, 3))
    position = room * [ROOM, ROOM, STOREY] + place
    weight = build.log_uniform(rng, count, 1.0, 2.0) * gain[tuple(room.T)]
    intensity = (1000.0 * weight / weight.sum())[:, None]
    intensity = intensity * build.pick(rng, (build.WARM, build.WHITE, *build.NEON), count)
    return [build.point(*item) for item in zip(position, intensity)]
