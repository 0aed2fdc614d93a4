"""Names of Dr.Jit's and Mitsuba's types for signatures; imports neither.

Which classes these are is decided when a variant is set, so that no type checker can know them: every name is an
alias of Any, and says to a reader what an argument holds. All are arrays with one entry a lane.
"""

from __future__ import annotations

from typing import Any, TypeAlias

Array: TypeAlias = Any  # any of those below, or several kinds
Floats: TypeAlias = Any  # mi.Float
UInts: TypeAlias = Any  # mi.UInt32
Ints: TypeAlias = Any  # mi.Int32
Masks: TypeAlias = Any  # mi.Bool
Vectors: TypeAlias = Any  # mi.Vector3f, mi.Point3f or mi.Normal3f
Rays: TypeAlias = Any  # mi.Ray3f
Interactions: TypeAlias = Any  # mi.SurfaceInteraction3f
LobeSamples: TypeAlias = Any  # mi.BSDFSample3f
Generators: TypeAlias = Any  # mi.PCG32
Tensors: TypeAlias = Any  # mi.TensorXf
