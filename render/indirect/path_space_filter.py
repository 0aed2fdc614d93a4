"""Late indirect light shared by the paths that meet one small region of a surface: a filter, fast and biased.

Light that arrives an excess path x after the direct light from x1, the first surface, met a second one at least x / 2
away from there. Seen from there, points of the first surface much closer together than that are one. So
light is averaged over regions of a width that is a share of x, in octaves of x; what comes before the first octave
stays with its own pixel. This is path-space filtering (Keller, Dahm, Binder 2014; Binder, Fricke, Keller 2018), with
regions that widen with delay as irradiance samples are spaced by the distance of what they see (Ward, Rubinstein, Clear
1988).

A region is a cube of the world, in one of GRIDS grids, and a class of normals. It keeps what comes to its points over
the path from the laser to x1, without the way to the camera ("unwarped") and divided by the reflectance
("demodulated"), and the mean direction in which that path grows along the surface: light from one side reaches points
farther away later, to first order. Light of diffuse lobes goes into one region of one octave in each grid, and pixels
read the regions of some points of theirs: energy is kept. The bias is what differs within a region, shadows above all.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, Floats, Interactions, Masks, Rays, UInts, Vectors
from render.indirect.accumulators import IndirectAccumulator
from render.indirect.path_cells import scatter_add_fixed_point
from render.scene.rays import camera_rays, first_opaque
from render.scene.traced_scene import Float, TracedScene, UInt32, dr, mi, upload

UInt64, Int32 = mi.UInt64, mi.Int32
# Width of a region in its octave's excess path, and of the widest in the mean distance, at PATHS paths a pixel. They
# shrink with paths^-SHRINKING, so that the bias goes where the noise does.
KAPPA, WIDEST, REFERENCE_SPP, SHRINKING = 0.2, 0.15, 16, 0.3
GATHER_POINTS = 8  # points of a pixel that read
# Every region is one of a grid, and there are so many grids, shifted against one another: their mean is smooth where
# one grid has steps, and has less noise. Two were best for their time (measured).
HASH_GRIDS = 2
MAX_OCTAVES = 16
UNIT_WEIGHT = 1 << 24  # weight of all paths of a pixel: divided by their number, it stays a whole one
FINENESS = 0.8  # of cells, in those of the pixels that read them: wider ones are faster and have less noise, more bias
GROWTH = 0.03  # of a region's cells along the path
KEY_BITS, NORMAL_BITS = 15, 2  # of a cube's number along an axis (they wrap around), and of a class of normals


class Octaves(NamedTuple):
    """Per octave: where its excess path begins, the width of its regions and of the first of their cells [m]; how many
    cells a region has."""

    from_m: np.ndarray
    size_m: np.ndarray
    width_m: np.ndarray
    cells: np.ndarray

    @property
    def size(self) -> int:
        return len(self.from_m)


class Point(NamedTuple):
    """Points on surfaces: position, normal toward the camera, optical path to the camera, and diffuse reflectance."""

    p: Vectors
    n: Vectors
    path: Floats
    reflectance: Floats


class ArrivingLight(NamedTuple):
    """Light that comes to points from x2, which lies `towards`, after `path_m` from the laser; late from `late_m` on.

    `radiance` is what the pixel sees of it by one path, which counts with `weight` quanta of UNIT_WEIGHT (see
    `PathSpaceFilter.count_paths`) in a region of each grid. `diffuse`: whether it leaves by a diffuse lobe.
    """

    late_m: Floats
    towards: Vectors
    diffuse: Masks
    batch: UInts
    path_m: Floats
    radiance: Floats
    weight: Floats


def octaves(
    paths: float, footprint_m: float, distance_m: float, longest_m: float, width_m: float, growth: float
) -> Octaves:
    """Return octaves for so many paths a pixel, from regions of a pixel's footprint to the widest; the last one is
    open."""
    shrunk = (REFERENCE_SPP / paths) ** SHRINKING
    count = 1 + max(0, round(math.log2(shrunk * WIDEST * distance_m / footprint_m)))
    count = min(count, MAX_OCTAVES)
    size = footprint_m * 2.0 ** np.arange(count)
    start = size / (shrunk * KAPPA)
    width = FINENESS * (width_m + growth * start)
    # an octave's excess paths, what the camera's way differs by across a region, and that along it to its middle
    length = np.append(np.diff(start), longest_m) + 2 * math.sqrt(3) * size
    cells = np.ceil(np.log1p(GROWTH * length / width) / GROWTH).astype(np.int64) + 1
    return Octaves(start, size, width, cells)


def point_of(si: Interactions, ray: Rays, path_m: Floats, transmission: Floats, hit: Masks) -> Point:
    """Return the point that a camera's ray met.

    What it reflects diffusely depends on where the light comes from, on coated surfaces; that of one direction stands
    for all: regions are divided by it and multiplied with it again.
    """
    normal = mi.Vector3f(dr.select(dr.dot(si.n, ray.d) > 0, -si.n, si.n))
    context = mi.BSDFContext()
    context.type_mask = mi.BSDFFlags.DiffuseReflection
    _, weight = si.bsdf().sample(context, si, Float(0.5), mi.Point2f(0.25, 0.5), hit)
    reflectance = dr.select(hit & (weight[0] > 0), weight[0] * transmission, 0)
    return Point(mi.Point3f(si.p), normal, Float(path_m), reflectance)


def late_from(world: TracedScene, point: Point, from_m: Floats) -> Array:
    """Return the path from the laser to points [m] from which on light there is late: so much behind direct light."""
    return point.path + dr.norm(point.p - world.laser) - dr.norm(point.p - world.eye) + from_m


class PathSpaceFilter:
    """The regions that some pixels of the image see, and the light in them, by batches.

    `pixels` are flat (-1: none); what is read is added to `IndirectAccumulator` by their places in that list.
    Not a dataclass: Dr.Jit would take its fields for variables of a loop.
    """

    def __init__(
        self, world: TracedScene, pixels: np.ndarray, filter_octaves: Octaves, batches: int, quantum: float, seed: int
    ) -> None:
        self.filter_octaves, self.batches = filter_octaves, batches
        numbers = np.random.SeedSequence(seed).generate_state(4)
        shift = numbers[:3] * 2.0**-32 + np.arange(HASH_GRIDS)[:, None] / HASH_GRIDS
        self._shift = mi.Vector3f(*(upload(Float, np.tile(part, filter_octaves.size)) for part in shift.T))
        self._quantum, self._per_quantum = dr.opaque(Float, quantum), dr.opaque(Float, 1 / quantum)
        self.from_m, self._size = dr.opaque(Float, float(filter_octaves.from_m[0])), _by_level(filter_octaves.size_m)
        self._width, self._last = _by_level(filter_octaves.width_m), dr.opaque(UInt32, filter_octaves.size - 1)
        self.place, self.points = _points(world, pixels, dr.opaque(UInt32, int(numbers[3])))
        reader, level = _each(dr.width(self.place), filter_octaves.size * HASH_GRIDS)
        point = _gathered(self.points, reader)
        key = self._key(point, level)
        dr.eval(key, point.path)
        found, row = _numbered(key.numpy())
        self._row_of = upload(UInt32, row)
        nearest = np.full(len(found), np.inf, np.float32)  # of the paths' type: ten times as fast
        np.minimum.at(nearest, row, point.path.numpy())
        # the length of the search is part of its kernel: one for all views of a size, but where there are very many
        self._searched = 1 << max(len(pixels) * MAX_OCTAVES * HASH_GRIDS, len(found)).bit_length()
        self._keys = upload(UInt64, np.append(found, np.uint64(2**64 - 1)), self._searched)
        self._nowhere = len(found)
        self._lay_out(found, nearest)

    def _lay_out(self, found: np.ndarray, nearest_m: np.ndarray) -> None:
        """Lay out cells for the regions of the keys `found`, whose points are at least `nearest_m` from the camera."""
        octave = (found >> np.uint64(3 * (KEY_BITS + NORMAL_BITS))).astype(np.int64) // HASH_GRIDS
        cells = self.filter_octaves.cells[octave]
        reach = 0.5 * math.sqrt(3) * self.filter_octaves.size_m[octave]
        self._base = upload(Float, np.append(nearest_m + self.filter_octaves.from_m[octave] - 3 * reach, 0))
        self._first, self._cells = (upload(UInt32, np.append(part, 0)) for part in (np.cumsum(cells) - cells, cells))
        size = max(int(cells.sum()), 1)
        self.energy = dr.zeros(UInt64, size * self.batches)
        self.path_gradient = dr.zeros(UInt64, size * 3)
        self.paths, self.filled = dr.zeros(UInt64, len(found) + 1), dr.zeros(UInt32, len(found) + 1)

    def _key(self, point: Point, level: UInts) -> Array:
        """Encode level, class of normals and cube of a point in one number. A level is a grid of an octave."""
        size, key = dr.gather(Float, self._size, level), UInt64(level)
        for part in point.n:
            key = (key << NORMAL_BITS) | UInt64(UInt32(Int32(dr.round(part)) + 1))
        for part, shift in zip(point.p, self._shift, strict=True):
            number = UInt32(Int32(dr.floor(part / size + dr.gather(Float, shift, level)))) & ((1 << KEY_BITS) - 1)
            key = (key << KEY_BITS) | UInt64(number)
        return key

    def _from_middle(self, point: Point, level: UInts) -> Array:
        """Compute the vector along the surface from the middle of a point's cube to the point."""
        size = dr.gather(Float, self._size, level)
        parts = [part / size + dr.gather(Float, shift, level) for part, shift in zip(point.p, self._shift, strict=True)]
        off = mi.Vector3f(*(part - dr.floor(part) - 0.5 for part in parts)) * size
        return off - point.n * dr.dot(point.n, off)

    def _row(self, key: UInts, active: Masks) -> tuple[Array, Array]:
        """Return the number of a region, and whether there is one."""
        found = dr.binary_search(0, self._searched - 1, lambda i: dr.gather(UInt64, self._keys, i, active) < key)
        return found, active & (dr.gather(UInt64, self._keys, found, active) == key)

    def count_paths(self, points: Point, weight: Floats) -> Array:
        """Return one more path for the regions of each point that reflects; returns their numbers, levels x points.

        A pixel's paths count UNIT_WEIGHT together, however many they are: a region's light is the mean over its pixels.
        """
        number, level = _each(dr.width(points.path), self.filter_octaves.size * HASH_GRIDS)
        point = _gathered(points, number)
        row, known = self._row(self._key(point, level), point.reflectance > 0)
        row = dr.select(known, row, dr.opaque(UInt32, self._nowhere))
        dr.scatter_add(self.paths, UInt64(dr.gather(UInt32, weight, number)), row, known, mode=dr.ReduceMode.Direct)
        return row

    def add(self, point: Point, rows: UInts, light: ArrivingLight, active: Masks) -> Array:
        """Add light that comes to points, to the regions `rows` of `count_paths`.

        Returns where it is still to add: where it came too early for any region, or left by no diffuse lobe. Late light
        in a region that no pixel reads is dropped.
        """
        late_m, towards, diffuse, batch, path_m, radiance, weight = light
        excess_m = path_m - late_m + self.from_m
        late = active & diffuse & (path_m >= late_m) & (point.reflectance > 0)
        number = Int32(dr.floor(dr.log2(dr.maximum(excess_m, self.from_m) / self.from_m)))
        octave = UInt32(dr.clip(number, 0, Int32(self._last)))
        lit = late & (radiance > 0) & dr.isfinite(radiance)
        value = radiance / point.reflectance * self._per_quantum * (Float(weight) / UNIT_WEIGHT)
        lanes = dr.width(point.path)
        lane = dr.arange(UInt32, lanes)
        for grid in range(HASH_GRIDS):
            level = octave * HASH_GRIDS + grid
            row = dr.gather(UInt32, rows, level * dr.opaque(UInt32, lanes) + lane, lit)
            known = lit & (row != dr.opaque(UInt32, self._nowhere))
            # the path grows away from x2
            grown_m = path_m + dr.dot(towards, self._from_middle(point, level))
            x = dr.maximum(grown_m - dr.gather(Float, self._base, row, known), 0) / dr.gather(Float, self._width, level)
            last = dr.gather(UInt32, self._cells, row, known) - 1
            cell = dr.minimum(UInt32(dr.log(1 + GROWTH * x) / GROWTH), last)
            index = dr.gather(UInt32, self._first, row, known) + cell
            scatter_add_fixed_point(self.energy, value, index * self.batches + batch, known)
            dr.scatter_reduce(dr.ReduceOp.Max, self.filled, cell + 1, row, known, mode=dr.ReduceMode.Direct)
            for axis, part in enumerate(-towards):
                scatter_add_fixed_point(
                    self.path_gradient, value * dr.clip(0.5 + 0.5 * part, 0, 1), 3 * index + axis, known
                )
        return active & ~late

    def evaluate(self) -> None:
        """Run what was added so far."""
        dr.eval(self.energy, self.path_gradient, self.paths, self.filled)

    def read(self, sums: IndirectAccumulator) -> None:
        """Add every region's light to the pixels that have points there."""
        if dr.width(self.place) == 0:
            return
        place, level, row, weight, point = self._readings()
        weight = (
            weight
            * self._quantum
            / (GATHER_POINTS * HASH_GRIDS / UNIT_WEIGHT * Float(dr.gather(UInt64, self.paths, row)))
        )
        base = dr.gather(Float, self._base, row) + point.path
        reading = _Reading(place, level, row, weight, base, self._from_middle(point, level))
        dr.eval(*reading)
        for batch, total in enumerate(self._read(sums, reading, None)):
            sums.add_total(place, dr.opaque(UInt32, batch), total)
        if sums.probed is not None:
            probed = dr.compress(dr.gather(Int32, sums.probe_row, place) >= 0)
            number, batch = _each(dr.width(probed), self.batches)
            if dr.width(number):
                self._read(sums, _gathered(reading, dr.gather(UInt32, probed, number)), batch)
        sums.evaluate()

    def _readings(self) -> tuple[Array, Array, Array, Array, Point]:
        """List every pair of a place and a region that it reads once, with the summed reflectance of the place's points
        and their mean weighted by reflectance.

        Points of one place lie next to each other.
        """
        reader, level = _each(dr.width(self.place), self.filter_octaves.size * HASH_GRIDS)
        place, row = dr.gather(UInt32, self.place, reader), self._row_of
        first = dr.gather(UInt64, self.paths, row) > 0
        for step in range(1, GATHER_POINTS):
            first &= ~self._reads(Int32(reader) - step, level, place, row)
        chosen = dr.compress(first)
        reader, level, place, row = (dr.gather(UInt32, column, chosen) for column in (reader, level, place, row))
        sums = [Float(0)] * 8
        for step in range(GATHER_POINTS):
            reads = self._reads(Int32(reader) + step, level, place, row)
            point = _gathered(self.points, dr.select(reads, reader + step, 0))
            fraction = dr.select(reads, point.reflectance, 0)
            sums = [a + fraction * b for a, b in zip(sums, (1, *point.p, *point.n, point.path), strict=True)]
        weight, x, y, z, right, up, back, path = sums
        normal = dr.normalize(mi.Vector3f(right, up, back))
        return place, level, row, weight, Point(mi.Point3f(x, y, z) / weight, normal, path / weight, weight)

    def _reads(self, reader: UInts, level: UInts, place: UInts, row: UInts) -> Array:
        """Return whether the point `reader` exists, belongs to `place` and reads the region `row` at this level."""
        readers = dr.opaque(UInt32, dr.width(self.place))
        there = (reader >= 0) & (reader < Int32(readers))
        number = UInt32(dr.select(there, reader, 0))
        there &= dr.gather(UInt32, self.place, number, there) == place
        return there & (dr.gather(UInt32, self._row_of, level * readers + number, there) == row)

    def _energies(self, index: UInts) -> list:
        """Read the energy of every batch in a cell."""
        return [Float(dr.gather(UInt64, self.energy, index * self.batches + b)) for b in range(self.batches)]

    def _growing(self, index: UInts, energies: list) -> Array:
        """Compute the mean direction in which the path of a cell's light grows, over all batches, whose `energies`
        these are."""
        energy = sum(energies[1:], energies[0])
        parts = (2 * Float(dr.gather(UInt64, self.path_gradient, 3 * index + axis)) - energy for axis in range(3))
        return dr.select(energy > 0, mi.Vector3f(*parts) / energy, 0)

    @dr.syntax
    def _read(self, sums: IndirectAccumulator, reading: Array, batch: UInts) -> Array:
        """Read cell by cell; returns each batch's total. Of one `batch` a lane for the probe rows, or of all."""
        place, row, weight, off = reading.place, reading.row, reading.weight, reading.off
        width = dr.gather(Float, self._width, reading.level)
        index, cells = dr.gather(UInt32, self._first, row), dr.gather(UInt32, self.filled, row)
        cell = dr.zeros(UInt32, dr.width(place))
        totals = [dr.zeros(Float, dr.width(place)) for _ in range(self.batches)]
        while cell < cells:
            low, high = reading.base + _edge(cell) * width, reading.base + _edge(cell + 1) * width
            energies = self._energies(index)
            later = dr.dot(self._growing(index, energies), off)
            if dr.hint(batch is None, mode="scalar"):
                totals = _plus(totals, energies, weight)
                energy = sum(energies[1:], energies[0]) * weight
                sums.spread(place, low + later, high + later, energy, energy > 0)
            else:
                energy = Float(dr.gather(UInt64, self.energy, index * self.batches + batch)) * weight
                sums.spread_probed(place, batch, low + later, high + later, energy, energy > 0)
            cell += 1
            index += 1
        return totals


class _Reading(NamedTuple):
    """A place that reads a region: factor of its quanta, path at which the region's cells begin, and how far along the
    surface the place's points are from the middle."""

    place: UInts
    level: UInts
    row: UInts
    weight: Floats
    base: Array
    off: Array


def _numbered(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the distinct keys, sorted, and the number of each key among them. Neighbours mostly have the same key: runs
    are sorted."""
    begins = np.flatnonzero(np.append(True, keys[1:] != keys[:-1])[: len(keys)])
    found, number = np.unique(keys[begins], return_inverse=True)
    return found, np.repeat(number, np.diff(np.append(begins, len(keys))))


def _by_level(of_octaves: np.ndarray) -> Array:
    """Repeat the values of octaves for their levels: one a grid."""
    return upload(Float, np.repeat(of_octaves, HASH_GRIDS))


def _plus(totals: list, energies: list, weight: Floats) -> list:
    return [total + energy * weight for total, energy in zip(totals, energies, strict=True)]


def _edge(cell: UInts) -> Array:
    """Compute where a cell begins, in widths of the first cell."""
    return (dr.exp(GROWTH * Float(cell)) - 1) / GROWTH


def _each(count: int, times: int) -> tuple[Array, Array]:
    """List all pairs of 0 .. `count` and 0 .. `times`, the first running faster. Opaque: counts differ from run to
    run."""
    lane, number = dr.arange(UInt32, count * times), dr.opaque(UInt32, max(count, 1))
    return lane % number, lane // number


def _gathered(columns: NamedTuple, index: UInts) -> Array:
    return type(columns)(*(dr.gather(type(column), column, index) for column in columns))


def _points(world: TracedScene, pixels: np.ndarray, key: UInts) -> tuple[Array, Point]:
    """Sample GATHER_POINTS points of every pixel, spread evenly, where they reflect diffusely, and their places in
    `pixels`."""
    lane = dr.arange(UInt32, len(pixels) * GATHER_POINTS)
    place, number = lane // GATHER_POINTS, lane % GATHER_POINTS
    pixel = dr.gather(UInt32, upload(UInt32, pixels.astype(np.int64) & 0xFFFFFFFF), place)
    valid = pixel != 0xFFFFFFFF
    pixel = dr.select(valid, pixel, 0)
    first, second = mi.sample_tea_32(pixel, key)
    x, y = mi.radical_inverse_2(number, first), mi.sobol_2(number, second)
    ray, _ = camera_rays(world, Float(pixel % world.width) + x, Float(pixel // world.width) + y)
    si, transmission, path, _ = first_opaque(world, ray, valid)
    hit = valid & si.is_valid()
    point = point_of(si, ray, path, transmission, hit)
    lit = hit & (point.reflectance > 0)
    dr.eval(lit, place, *point)
    chosen = dr.compress(lit)
    return dr.gather(UInt32, place, chosen), _gathered(point, chosen)
