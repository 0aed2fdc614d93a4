"""Edges between cells, against one pair at a time in plain Python; and cells that follow their neighbours."""

import math

import numpy as np
import pytest

from render.direct.children import OFFSET_SHARE, WORTH_PLACING, Tree, child_edges
from render.direct.edges import (
    CREASE_COSINE,
    CREASE_M,
    CUT,
    FOLD,
    FOLD_RATIO,
    FOLLOWED,
    GLINT,
    HIGHLIGHT,
    HIGHLIGHT_MARGIN,
    MIXED,
    MIXED_GAP_M,
    RISE_SHARE,
    STEP_M,
    SURFACE,
    TONE,
    Cells,
    Place,
    Table,
    first_edges,
)
from render.direct.footprints import HIT, LARGE, LIT, MOVED, MOVED_CUT
from render.scene.rays import PLAIN_GOLDEN
from render.scene.traced_scene import aligned

HEIGHT, WIDTH, GRID, LEAST = 8, 9, 3, 0.02
COUNT = HEIGHT * WIDTH * GRID**2


def cells_of(seed: int, count: int = COUNT, *, glossy: bool = False) -> Cells:
    """Cells on a few surfaces, half a metre apart or nearly level, some of them nothing or in shadow."""
    draw = np.random.default_rng(seed)
    flags = draw.choice([0, HIT, HIT | LIT, HIT | LIT, HIT | LIT, HIT | LIT | LARGE], count)
    hit = (flags & HIT) != 0
    return Cells(
        np.where(hit, draw.choice([2.0] * 7 + [2.0005, 2.001, 2.04, 2.5], count), 0).astype(np.float32),
        np.where(hit, draw.choice([0.0] * 5 + [0.001, 0.02, 0.2], count), 0).astype(np.float32),
        np.where(hit, draw.choice([0.0] * 5 + [-0.001, 0.01], count), 0).astype(np.float32),
        np.where((flags & LIT) != 0, draw.choice([0.2, 0.21, 0.5], count), 0).astype(np.float32),
        np.where(hit, draw.choice([0.8, 0.82, 0.9], count), 0).astype(np.float32),
        flags.astype(np.uint32),
        *(draw.choice(some, count).astype(np.float32) for some in ([-3, 0.2, 5], [-2, 0, 9], [0, 2, 20]) if glossy),
    )


def between(cells: Cells, a: int, b: int, way: tuple[float, float]) -> tuple[bool, bool, float, bool, float]:
    """differ, apart, contrast, joined, glint: a sentence of `render.direct.edges` a line."""
    hits = [bool(cells.flags[i] & HIT) for i in (a, b)]
    rises = rises_of(cells, a, b, way)
    edge = is_severed(cells, a, b, way) or (all(hits) and abs(rises[0] - rises[1]) > CREASE_M)
    bend = abs(float(cells.facing[a]) - float(cells.facing[b]))
    bright = max(float(cells.radiance[a]), float(cells.radiance[b]))
    tone = abs(float(cells.radiance[a]) - float(cells.radiance[b])) / bright if bright else 0.0
    differ = edge or (all(hits) and (bend > CREASE_COSINE or tone > TONE))
    joined = all(hits) and not edge
    glint = highlight(cells, a, b) if joined and cells.peak is not None else 0.0
    if joined and cells.peak is not None and min(cells.peak[a], cells.peak[b]) > 0 and bright:
        shine = [
            float(cells.peak[i]) / (1 + float(cells.tilt_x[i]) ** 2 + float(cells.tilt_y[i]) ** 2) ** 2 for i in (a, b)
        ]
        paint = [float(cells.radiance[i]) - shining for i, shining in zip((a, b), shine, strict=True)]
        tone = min(tone, abs(paint[0] - paint[1]) / bright)
    return (
        differ,
        gap_of(cells, a, b, way) > MIXED_GAP_M or hits[0] != hits[1],
        1.0 if edge else max(bend, tone),
        joined,
        glint,
    )


def step_of(cells: Cells, a: int, b: int) -> float:
    return float(cells.distance_m[b]) - float(cells.distance_m[a])


def fold_of(slope: float, other_slope: float, step: float) -> tuple[float, float] | None:
    """Compute mean off the centre's and variance of 4,000 distances across a cell that a crease crosses."""
    if abs(slope - other_slope) <= FOLD * max(abs(slope), abs(other_slope)):
        return None
    crease = (step - other_slope) / (slope - other_slope)
    if abs(crease) >= 0.5:
        return None
    at = (np.arange(4000) + 0.5) / 4000 - 0.5
    distances = np.where(at < crease, slope * at, step + other_slope * (at - 1))
    return float(distances.mean()), float(distances.var())


def is_severed(cells: Cells, a: int, b: int, way: tuple[float, float]) -> bool:
    """Tell whether one of both is nothing or in shadow, or their planes do not explain the step between them."""
    return bool((cells.flags[a] ^ cells.flags[b]) & (HIT | LIT)) or gap_of(cells, a, b, way) > STEP_M


def gap_of(cells: Cells, a: int, b: int, way: tuple[float, float]) -> float:
    """Measure how far the step between two hits is beyond what both planes predict."""
    if not cells.flags[a] & cells.flags[b] & HIT:
        return 0.0
    step, rises = step_of(cells, a, b), rises_of(cells, a, b, way)
    return max(step - max(rises), min(rises) - step)


def rises_of(cells: Cells, a: int, b: int, way: tuple[float, float]) -> list[float]:
    return [float(cells.slope_x_m[i]) * way[0] + float(cells.slope_y_m[i]) * way[1] for i in (a, b)]


def highlight(cells: Cells, a: int, b: int) -> float:
    """The nearest to no tilt among a thousand points between two cells, half a step nearer yet for the rows beside."""
    tilts = np.array([(cells.tilt_x[i], cells.tilt_y[i]) for i in (a, b)], float)
    step = float(np.linalg.norm(tilts[1] - tilts[0]))
    nearest = np.linalg.norm(tilts[0] + np.linspace(0, 1, 1001)[:, None] * (tilts[1] - tilts[0]), axis=1).min()
    peak = min(float(cells.peak[a]), float(cells.peak[b])) / (1 + max(nearest - step / 2, 0) ** 2) ** 2
    step = max(step, 1e-3)
    missed = 2 * (1 + 2 * math.pi / step) * math.exp(-2 * math.pi / step) * min(1.0, math.pi / 2 / step)
    return peak * max(HIGHLIGHT_MARGIN * missed, RISE_SHARE * min(step, 1.0))


def index_of(x: int, y: int) -> int:
    """Cell in column x and row y of the image: pixel by pixel, in each row by row."""
    pixel = y // GRID * WIDTH + x // GRID
    return pixel * GRID**2 + y % GRID * GRID + x % GRID


@pytest.mark.parametrize("glossy", [False, True], ids=["paint", "polished"])
@pytest.mark.parametrize("whole", [True, False], ids=["image", "single-pixels"])
@pytest.mark.parametrize("seed", range(2))
def test_first_cells_are_compared_with_their_neighbours(seed: int, whole: bool, glossy: bool) -> None:
    cells = cells_of(seed, glossy=glossy)
    draw = np.random.default_rng(100 + seed)
    filter_octaves = [draw.uniform(low, high, COUNT).astype(np.float32) for low, high in ((4, 5), (0, 0.1), (0, 0.05))]
    bits, path, half, minor = first_edges(cells, filter_octaves, GRID, WIDTH if whole else 0, LEAST)
    cut, mixed, shining = (cells.flags & LARGE) != 0, np.zeros(COUNT, bool), np.zeros(COUNT, bool)
    followed = turned = 0
    for y, x in np.ndindex(HEIGHT * GRID, WIDTH * GRID):
        here, means, halves, variances, follows = index_of(x, y), [], [], [], True
        folded, shifts, spreads = False, [], []
        for axis, (dx, dy) in enumerate(((1, 0), (0, 1))):
            steps, paths, gains = [], [], []
            slope = float(cells[1 + axis][here]) / GRID
            shift, spread = 0.0, slope**2 / 12
            for sign in (1, -1):
                u, v = x + sign * dx, y + sign * dy
                same = 0 <= u < WIDTH * GRID and 0 <= v < HEIGHT * GRID
                other = index_of(u, v) if same else -1
                within = same and other // GRID**2 == here // GRID**2
                if not same or not (whole or within):
                    continue
                pair = (here, other) if sign > 0 else (other, here)
                differ, apart, contrast, joined, glint = between(cells, *pair, (dx / GRID, dy / GRID))
                energy = max(cells.radiance[here], cells.radiance[other]) / GRID**2
                cut[here] |= differ and energy * contrast >= LEAST
                mixed[here] |= within and differ and apart
                shining[here] |= glint / GRID**2 >= LEAST
                fold = fold_of(slope * sign, float(cells[1 + axis][other]) / GRID * sign, step_of(cells, here, other))
                hits = cells.flags[here] & cells.flags[other] & HIT
                if fold and hits and not is_severed(cells, *pair, (dx / GRID, dy / GRID)):
                    folded, (shift, spread) = True, fold
                    follows &= joined
                if joined:
                    steps.append(float(cells.distance_m[pair[1]]) - float(cells.distance_m[pair[0]]))
                    paths.append(float(filter_octaves[0][pair[1]]) - float(filter_octaves[0][pair[0]]))
                    gains.append(float(cells.radiance[pair[1]]) - float(cells.radiance[pair[0]]))
            shifts.append(shift)
            spreads.append(spread)
            if not steps:
                follows = False
                continue
            two = len(steps) == 2
            off = abs(float(cells[1 + axis][here]) / GRID - np.mean(steps))
            bend = abs(steps[0] - steps[1]) / 4 if two else 0.0
            follows &= off <= max(bend, FOLLOWED * float(cells.distance_m[here]))
            slope, curve = np.mean(paths), paths[0] - paths[1] if two else 0.0
            gain = np.clip(np.mean(gains) / max(float(cells.radiance[here]), 1e-9), -2, 2)
            means.append(curve / 24 + gain * slope / 12)
            halves.append(abs(slope) / 2)
            variances.append(slope**2 / 4 + curve**2 / 240)
        follows &= cells.flags[here] & (HIT | LARGE) == HIT and cells.radiance[here] > 0
        expected = [span[here] for span in filter_octaves]
        steepest = math.hypot(*(float(cells[1 + axis][here]) for axis in range(2))) / GRID
        ratio = 2 * float(filter_octaves[1][here]) / max(steepest, 1e-9)
        if folded and cells.flags[here] & (HIT | LARGE) == HIT and ratio < FOLD_RATIO and not follows:
            turned += 1
            spans = [ratio * math.sqrt(3 * spread) for spread in spreads]
            expected = [expected[0] + ratio * sum(shifts), math.hypot(*spans), min(spans)]
        if follows:
            followed += 1
            expected = [filter_octaves[0][here] + sum(means), math.sqrt(sum(variances)), min(halves)]
        assert np.allclose([path[here], half[here], minor[here]], expected, rtol=1e-5, atol=1e-6)
    assert np.array_equal((bits & CUT) != 0, cut) and np.array_equal((bits & MIXED) != 0, mixed)
    assert np.array_equal((bits & GLINT) != 0, shining) and (0 < shining.sum() < COUNT) == glossy
    assert followed > 0 and turned > 10 and 10 < cut.sum() < COUNT and mixed.any()


@pytest.mark.parametrize("glossy", [False, True], ids=["paint", "polished"])
@pytest.mark.parametrize("cut_before", [0, 1, 2])
def test_children_are_compared_with_all_that_lies_beside_them(cut_before: int, glossy: bool) -> None:
    """In an image of 8 x 6 pixels, two of them not asked for, whose cells were cut at random in passes before."""
    draw, (grid, width, first) = np.random.default_rng(cut_before), (2, 8, 1)
    pixels = np.delete(np.arange(first, 48), [3, 16])
    rank_of = np.full(48 - first, -1, np.int32)
    rank_of[pixels - first] = np.arange(len(pixels))
    places = [
        Place(pixel, 0, grid * (pixel % width) + i % grid, grid * (pixel // width) + i // grid)
        for pixel in pixels
        for i in range(grid**2)
    ]
    child = np.full(4000, -1, np.int32)
    for _ in range(cut_before + 1):
        start = len(places)
        parents = np.sort(draw.choice(np.flatnonzero(child[:start] < 0), start // 3, replace=False))
        child[parents] = start + 4 * np.arange(len(parents))
        for pixel, level, column, row in [places[parent] for parent in parents]:
            places += [Place(pixel, level + 1, 2 * column + i % 2, 2 * row + i // 2) for i in range(4)]
    count = len(places)
    cells = cells_of(cut_before, count, glossy=glossy)
    where, areas = {place[1:]: number for number, place in enumerate(places)}, {}
    expected = np.where(cells.flags & LARGE, CUT, 0)
    expected[:start] = 0
    for number in range(start, count):
        _, level, column, row = places[number]
        for way_x, way_y in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            above = ((up, (column + way_x) >> level - up, (row + way_y) >> level - up) for up in range(level, -1, -1))
            beside = next((where[place] for place in above if place in where), None)
            if beside is not None:
                bits = bits_of_pair(cells, (number, beside), [places[number], places[beside]], grid)
                expected[[number, beside]] |= bits
                area = area_of_pair(cells, (number, beside), [places[number], places[beside]], grid)
                if area and (beside < start or way_x + way_y > 0):  # two new cells meet once
                    areas[number, beside] = area
    bits, pairs = child_edges(Tree(grid, width, first, rank_of, child[:count]), table_of(places, cells), parents, LEAST)
    assert np.array_equal(bits, expected)
    found = {(int(a), int(b)): area for a, b, area in zip(*pairs, strict=True)}
    assert len(pairs.one) == len(found) > 100 and found == pytest.approx(areas, rel=1e-3)
    assert all(20 < np.count_nonzero(bits & bit) < count - 20 for bit in (CUT, MIXED, GLINT)[: 2 + glossy])


def table_of(places: list[Place], cells: Cells) -> Table:
    """Pack cells by row."""
    parts = [(4, np.int32), (8, np.float32), *([] if cells.peak is None else [(4, np.float32)])]
    rows = [aligned(len(places) * width, kind).reshape(-1, width) for width, kind in parts]
    rows[0][:] = places
    for part, names in zip(rows[1:], (SURFACE, HIGHLIGHT), strict=False):
        for number, name in enumerate(names):
            part[:, number] = getattr(cells, name).view(np.float32)
    return Table(rows[0], rows[1], None if cells.peak is None else rows[2])


def bits_of_pair(cells: Cells, pair: tuple[int, int], places: list[Place], grid: int) -> int:
    """CUT, MIXED and GLINT of two cells at these places, a sentence of `render.direct.edges` a line."""
    widths = [1 / (grid * 2**place.level) for place in places]
    centres = [((place.column + 0.5) * w, (place.row + 0.5) * w) for place, w in zip(places, widths, strict=True)]
    differ, apart, contrast, _, glint = between(cells, *pair, tuple(np.subtract(centres[1], centres[0])))
    energy, of_one_pixel = max(cells.radiance[list(pair)]) * max(widths) ** 2, places[0].pixel == places[1].pixel
    cut, shining = differ and energy * contrast >= LEAST, glint > 0 and glint * max(widths) ** 2 >= LEAST
    return CUT * cut | MIXED * (differ and apart and of_one_pixel) | GLINT * shining


def area_of_pair(cells: Cells, pair: tuple[int, int], places: list[Place], grid: int) -> float:
    """Compute how much of the second cell is on the first one's side of the middle between both rays; 0: not placed."""
    if places[0].pixel != places[1].pixel:
        return 0.0
    widths = [1 / (grid * 2**place.level) for place in places]
    centres = np.array([((p.column + 0.5) * w, (p.row + 0.5) * w) for p, w in zip(places, widths, strict=True)])
    ways = [abs(places[0][axis] // 2 ** (places[0].level - places[1].level) - places[1][axis]) for axis in (2, 3)]
    axis = int(np.argmax(ways))  # they are beside each other along it
    rays = [
        centre[axis] + OFFSET_SHARE * width * ray_offset_of(place, axis, grid)
        for centre, width, place in zip(centres, widths, places, strict=True)
    ]
    way = 1 if centres[1][axis] > centres[0][axis] else -1
    border = centres[0][axis] + way * widths[0] / 2
    area = way * ((rays[0] + rays[1]) / 2 - border) * widths[0]
    severed = is_severed(cells, *pair, tuple(np.subtract(centres[1], centres[0])))
    return area if severed and max(cells.radiance[list(pair)]) * abs(area) >= WORTH_PLACING * LEAST else 0.0


def ray_offset_of(place: Place, axis: int, grid: int) -> float:
    """Compute a ray's offset along an axis in cell widths: golden turns by its row (along x) or column (along y)."""
    number = place.row if axis == 0 else place.column
    golden = PLAIN_GOLDEN / 2**32
    if place.level > 0:
        return MOVED_CUT * (number * golden % 1 - 0.5)
    turns = (number - (number // grid + 0.5) * grid + 0.5) * (golden if axis == 0 else -golden)
    return MOVED * (turns - round(turns))


def test_nothing_to_compare() -> None:
    alone = cells_of(1, 1)
    assert first_edges(alone, [np.ones(1, np.float32)] * 3, 1, 1, 0.1)[0].tolist() == [
        CUT * bool(alone.flags[0] & LARGE)
    ]
