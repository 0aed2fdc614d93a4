"""Arrays by row: what a lane reads of one entry lies in one place in memory.

A kernel that gathers columns one by one reads memory once for each; eight numbers side by side are read at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from render.backend.drjit_types import Array, Masks, UInts
from render.scene.traced_scene import Bool, Float, UInt32, dr, mi

WIDTH = 8  # numbers a row: half a line of a processor's cache
# kinds of `render.scene.rays.parts_of` an interaction, the last left out: of one that is to be seen from elsewhere
PLACE_ON_SURFACE = (mi.Point3f, mi.Normal3f, mi.Point2f, mi.Frame3f, mi.ShapePtr, UInt32)
INTERACTION = (*PLACE_ON_SURFACE, mi.Vector3f)


def packed(columns: Sequence[Array], index: UInts | None = None) -> tuple[Array, ...]:
    """Return columns by row, those of the entries `index` if it is given: one flat array for every WIDTH numbers.

    A column is a number, a mask, a shape, a vector or a frame for each entry.
    """
    numbers = [_as_float(part) for column in columns for part in _parts(column)]
    if index is not None:
        numbers = [dr.gather(Float, number, index) for number in numbers]
    count = max(dr.width(number) for number in numbers)
    lane, rows = dr.arange(UInt32, count), []
    for first in range(0, len(numbers), WIDTH):
        some = numbers[first : first + WIDTH]
        row = dr.empty(Float, WIDTH * count)
        dr.scatter(row, mi.ArrayXf(*some, *[Float(0)] * (WIDTH - len(some))), lane)
        rows.append(row)
    dr.eval(rows)
    return tuple(rows)


def gather_rows(rows: Sequence[Array], kinds: Sequence[type], index: UInts, active: Masks) -> list[Array]:
    """Return the columns, of these kinds, of the entries `index`; zeros where not `active`."""
    halves = (dr.gather(mi.Vector4f, row, 2 * index + half, active) for row in rows for half in range(2))
    numbers = (number for half in halves for number in half)
    return [_from_floats(kind, numbers) for kind in kinds]


def _parts(column: Array) -> Iterator[Array]:
    """Yield the numbers of a column."""
    if isinstance(column, mi.Frame3f):  # the third axis is the cross product of the others
        yield from column.s
        yield from column.n
    elif dr.depth_v(column) > 1:
        yield from column
    else:
        yield column


def _as_float(number: Array) -> Array:
    if isinstance(number, Bool):
        return dr.select(number, Float(1), Float(0))
    return number if isinstance(number, Float) else dr.reinterpret_array(Float, dr.reinterpret_array(UInt32, number))


def _from_floats(kind: type, numbers: Iterator[Array]) -> Array:
    if kind is mi.Frame3f:
        s, n = (_from_floats(vector, numbers) for vector in (mi.Vector3f, mi.Normal3f))
        return mi.Frame3f(s, dr.cross(n, s), n)
    if kind is Bool:
        return next(numbers) > 0
    if kind is Float:
        return next(numbers)
    if kind in (UInt32, mi.ShapePtr):
        return dr.reinterpret_array(kind, dr.reinterpret_array(UInt32, next(numbers)))
    return kind(*(next(numbers) for _ in range(dr.size_v(kind))))
