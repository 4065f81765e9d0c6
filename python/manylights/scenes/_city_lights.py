"""The lights of the city: where they are, how they face, what they emit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from manylights.scenes import _build as build
from manylights.scenes._build import Quads

#: Metres: width of a block, of a street, and of a building's footprint.
BLOCK, STREET, FOOTPRINT = 36.0, 16.0, 14.5
PITCH = BLOCK + STREET

#: Metres: the cell of the facade that belongs to a window, and the window's share of it.
CELL_WIDTH, CELL_HEIGHT, WINDOW_SHARE = 2.8, 3.3, np.array([0.55, 0.58])

#: Of all window cells this share is lit at most, so that dark windows remain.
LIT_SHARE = 0.55

#: Windows of a block at full size, on average; sets the number of blocks.
WINDOWS_PER_BLOCK = 700

#: Metres above the ground: where the rows of windows begin.
FIRST_FLOOR = 4.0


@dataclass
class Layout:
    """The city without lights: ``blocks`` x ``blocks`` blocks, and the corners of all buildings."""

    blocks: int
    low: np.ndarray
    high: np.ndarray

    @property
    def half(self) -> float:
        """Distance from the centre to the outermost buildings, in metres."""
        return 0.5 * self.blocks * PITCH


def layout_for(rng: np.random.Generator, quads: int) -> Layout:
    """Place four buildings of random height on each block; streets run along x = 0 and y = 0."""
    needed = quads / (LIT_SHARE * WINDOWS_PER_BLOCK)
    blocks = 2 * int(np.ceil(0.5 * np.clip(np.sqrt(needed), 4, 12)))
    index = np.stack(np.meshgrid(np.arange(blocks), np.arange(blocks), indexing="ij"), axis=-1)
    centers = (index.reshape(-1, 2) - 0.5 * blocks + 0.5) * PITCH
    corner = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]], dtype=float)
    offset = 0.5 * (BLOCK - FOOTPRINT) - 3.2
    middle = (centers[:, None] + offset * corner[None]).reshape(-1, 2)
    size = FOOTPRINT * rng.uniform(0.86, 1.0, middle.shape)
    tall = 11.0 + rng.gamma(2.0, 7.5, len(middle))
    zeros = np.zeros((len(middle), 1))
    low = np.concatenate([middle - 0.5 * size, zeros], axis=1)
    high = np.concatenate([middle + 0.5 * size, np.minimum(tall, 62.0)[:, None]], axis=1)
    return Layout(blocks, low, high)


def lights(rng: np.random.Generator, layout: Layout, count: int) -> tuple[dict[str, Quads], Quads]:
    """Return ``count`` lights in all, by sort, and the windows that are dark.

    The sorts are ``lamps``, ``signs``, ``cars``, ``shops`` and ``windows``. The first four have
    fixed shares and lie nearest to the camera, so that even a single light is seen.
    """
    near = np.array([0.0, -layout.half + 20.0, 0.0])
    groups = {
        "lamps": _nearest(_lamps(layout), near, max(1, count // 12)),
        "signs": _nearest(_signs(rng, layout), near, count // 40),
        "cars": _nearest(_car_lights(place_cars(layout)), near, count // 20),
        "shops": _nearest(_shops(rng, layout), near, count // 20),
    }
    missing = count - sum(len(group) for group in groups.values())
    groups["windows"], dark = _windows(rng, layout, missing)
    return groups, dark


def _nearest(quads: Quads, point: np.ndarray, count: int) -> Quads:
    """Return the ``count`` quads nearest to a point, the nearest first."""
    distance = np.linalg.norm(quads.center() - point, axis=1)
    order = np.argsort(distance, kind="stable")[:count]
    return Quads(quads.corner[order], quads.u[order], quads.v[order], quads.radiance[order])


def along_streets(layout: Layout, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points every ``spacing`` metres on the middle of all streets, and their directions."""
    lines = (np.arange(layout.blocks + 1) - 0.5 * layout.blocks) * PITCH
    steps = np.arange(-layout.half + 0.5 * spacing, layout.half, spacing)
    line, step = (array.ravel() for array in np.meshgrid(lines, steps, indexing="ij"))
    zero, one = np.zeros_like(line), np.ones_like(line)
    along_y = np.stack([line, step, zero], axis=1)
    along_x = np.stack([step, line, zero], axis=1)
    position = np.concatenate([along_y, along_x])
    direction = np.concatenate(
        [np.stack([zero, one, zero], axis=1), np.stack([one, zero, zero], axis=1)]
    )
    # A crossing belongs to the streets along y.
    across = np.abs(position[:, 0] / PITCH - np.round(position[:, 0] / PITCH)) * PITCH
    keep = (direction[:, 1] == 1.0) | (across > 0.5 * STREET)
    return position[keep], direction[keep]


def side_of(direction: np.ndarray) -> np.ndarray:
    """Return the horizontal unit vectors to the right of the given directions."""
    return np.stack([direction[:, 1], -direction[:, 0], np.zeros(len(direction))], axis=1)


def _lamps(layout: Layout) -> Quads:
    """Street lamps on both sides, 6.5 m high, shining down."""
    middle, direction = along_streets(layout, 17.0)
    right = side_of(direction)
    parts = []
    for sign in (-1.0, 1.0):
        center = middle + sign * 4.6 * right + np.array([0.0, 0.0, 6.5])
        u, v = 0.7 * direction, -0.3 * right
        radiance = np.tile(180.0 * np.array(build.WARM), (len(center), 1))
        down = np.cross(u, v)[:, 2:] < 0.0
        parts.append(
            Quads(center - 0.5 * (u + v), np.where(down, u, v), np.where(down, v, u), radiance)
        )
    return Quads.join(parts)


def _signs(rng: np.random.Generator, layout: Layout) -> Quads:
    """Two-sided signs in neon colours that stand out from the facades along y."""
    size = np.array([1.1, 3.6])
    at_left = rng.random(len(layout.low)) < 0.5
    x = np.where(at_left, layout.low[:, 0] - size[0] - 0.2, layout.high[:, 0] + 0.2)
    share = rng.uniform(0.1, 0.9, len(x))
    y = layout.low[:, 1] + share * (layout.high[:, 1] - layout.low[:, 1])
    z = rng.uniform(3.6, 8.0, len(x))
    corner = np.stack([x, y, z], axis=1)
    u = np.tile([size[0], 0.0, 0.0], (len(x), 1))
    v = np.tile([0.0, 0.0, size[1]], (len(x), 1))
    power = build.log_uniform(rng, len(x), 3.0, 1.0)[:, None]
    radiance = power * build.pick(rng, build.NEON, len(x))
    thick = np.array([0.0, 0.12, 0.0])
    toward_camera = Quads(corner, u, v, radiance)
    away = Quads(corner + thick + u, -u, v, radiance)
    pairs = [np.stack([getattr(toward_camera, name), getattr(away, name)], axis=1).reshape(-1, 3)
             for name in ("corner", "u", "v", "radiance")]  # fmt: skip
    return Quads(*pairs)


def place_cars(layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Return where cars stand on both lanes, in metres, and the unit vectors they drive along."""
    rng = np.random.default_rng(layout.blocks)
    middle, direction = along_streets(layout, 13.0)
    lane = np.where(rng.random(len(middle)) < 0.5, -1.0, 1.0)[:, None]
    forward = lane * direction
    jitter = rng.uniform(-3.0, 3.0, (len(middle), 1))
    return middle + 2.6 * side_of(forward) + jitter * direction, forward


def _car_lights(cars: tuple[np.ndarray, np.ndarray]) -> Quads:
    """For each car two white lights in front and two red ones behind."""
    position, forward = cars
    up = np.tile([0.0, 0.0, 0.2], (len(position), 1))
    parts = []
    for facing, radiance in ((1.0, (30.0, 28.0, 24.0)), (-1.0, (8.0, 0.15, 0.1))):
        normal = facing * forward
        edge = 0.36 * np.cross(np.array([0.0, 0.0, 1.0]), normal)
        for side in (-0.6, 0.6):
            center = position + 2.13 * normal + side * side_of(forward)
            corner = center + np.array([0.0, 0.0, 0.62]) - 0.5 * (edge + up)
            parts.append(Quads(corner, edge, up, np.tile(radiance, (len(position), 1))))
    return Quads.join(parts)


def _shops(rng: np.random.Generator, layout: Layout) -> Quads:
    """Two shop windows at the foot of each facade."""
    facade, _, _ = _cells(layout, 1.0)
    length = np.linalg.norm(facade[:, 1], axis=1, keepdims=True)
    along = facade[:, 1] / length
    outward = facade[:, 2] / length
    shades = (build.WARM,) * 5 + (build.WHITE,) * 4 + build.NEON
    parts = []
    for start in (0.08, 0.56):
        corner = facade[:, 0] + start * facade[:, 1] + 0.03 * outward
        corner = corner + np.array([0.0, 0.0, 0.8])
        power = build.log_uniform(rng, len(facade), 0.7, 1.0)[:, None]
        colors = build.pick(rng, shades, len(facade))
        up = np.tile([0.0, 0.0, 2.1], (len(facade), 1))
        parts.append(Quads(corner, 0.36 * length * along, up, power * colors))
    return Quads.join(parts)


def _windows(rng: np.random.Generator, layout: Layout, lit: int) -> tuple[Quads, Quads]:
    """Choose ``lit`` of the window cells of all facades; return lit and dark windows.

    The cells are as large as ``CELL_WIDTH`` and ``CELL_HEIGHT`` say, or as much smaller as the
    number of lights needs.
    """
    scale = 1.0
    facade, columns, rows = _cells(layout, scale)
    while (columns * rows).sum() * LIT_SHARE < lit:
        scale *= 0.97 * min(1.0, np.sqrt((columns * rows).sum() * LIT_SHARE / lit))
        facade, columns, rows = _cells(layout, scale)
    total = int((columns * rows).sum())
    order = rng.permutation(total)
    power = build.log_uniform(rng, lit, 0.5, 3.0)[:, None]
    colors = build.pick(rng, (build.WARM, build.WARM, build.WHITE, build.COOL), lit)
    bright = _window_quads(facade, columns, rows, order[:lit], scale)
    bright.radiance = power * colors
    dark_count = min(total - lit, 60000)
    return bright, _window_quads(facade, columns, rows, order[lit : lit + dark_count], scale)


def _cells(layout: Layout, scale: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return facades (corner, edge along, normal; shape (f, 3, 3)) and their columns and rows."""
    low, high = layout.low, layout.high
    size = high - low
    zero = np.zeros(len(low))
    east = np.stack([high[:, 0], low[:, 1], zero], axis=1)
    north = np.stack([high[:, 0], high[:, 1], zero], axis=1)
    west = np.stack([low[:, 0], high[:, 1], zero], axis=1)
    south = np.stack([low[:, 0], low[:, 1], zero], axis=1)
    x, y = (size[:, axis : axis + 1] * np.eye(3)[axis] for axis in (0, 1))
    facade = np.concatenate(
        [
            np.stack([corner, edge, np.cross(edge, [0.0, 0.0, 1.0])], axis=1)
            for corner, edge in ((east, y), (north, -x), (west, -y), (south, x))
        ]
    )
    along = np.linalg.norm(facade[:, 1], axis=1)
    columns = np.maximum((along - 0.6) // (CELL_WIDTH * scale), 1).astype(np.int64)
    tall = np.tile(size[:, 2], 4) - FIRST_FLOOR - 0.5
    rows = np.maximum(tall // (CELL_HEIGHT * scale), 1).astype(np.int64)
    return facade, columns, rows


def _window_quads(facade, columns, rows, chosen: np.ndarray, scale: float) -> Quads:
    """Return the quads of the chosen cells, counted through all facades; they do not shine."""
    ends = np.cumsum(columns * rows)
    index = np.searchsorted(ends, chosen, side="right")
    within = chosen - (ends - columns * rows)[index]
    column, row = within % columns[index], within // columns[index]
    corner, edge, normal = facade[index, 0], facade[index, 1], facade[index, 2]
    length = np.linalg.norm(edge, axis=1, keepdims=True)
    along, outward = edge / length, normal / np.linalg.norm(normal, axis=1, keepdims=True)
    window = WINDOW_SHARE * scale * np.array([CELL_WIDTH, CELL_HEIGHT])
    start = (column + 0.5)[:, None] * length / columns[index][:, None] - 0.5 * window[0]
    bottom = FIRST_FLOOR + CELL_HEIGHT * scale * row + 0.2 * CELL_HEIGHT * scale
    origin = corner + along * start + 0.03 * outward
    origin[:, 2] = bottom
    u = window[0] * along
    v = np.tile([0.0, 0.0, window[1]], (len(chosen), 1))
    return Quads(origin, u, v, np.zeros((len(chosen), 3)))
