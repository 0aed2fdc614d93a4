"""Mitsuba as an oracle of what its scene files mean."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

# Mitsuba answers from a process of its own: importing it here would fix the LLVM library for all other tests.
ORACLE = """
import json, sys
import drjit as dr
import mitsuba as mi
import numpy as np
dr.set_thread_count(2)  # with one (1 CPU) Mitsuba waits for ever for an EXR file
mi.set_variant("scalar_rgb")
mi.set_log_level(mi.LogLevel.Error)  # warnings would stand before an answer
numbers = lambda v: np.array(v, float).ravel().tolist()
for line in sys.stdin:
    job = json.loads(line)
    scene = mi.load_file(job["xml"])
    box = scene.shapes()[0].bbox()
    answer = {"bbox": [numbers(box.min), numbers(box.max)], "camera": [], "hits": [], "around": []}
    for x, y in job["raster"]:
        ray, _ = scene.sensors()[0].sample_ray_differential(0, 0.5, [x, y], [0.5, 0.5])
        answer["camera"].append(numbers(ray.o) + numbers(ray.d))
    for origin, direction in job["rays"]:
        si = scene.ray_intersect(mi.Ray3f(origin, direction))
        albedo = si.bsdf().eval_diffuse_reflectance(si)
        light = si.emitter(scene)
        seen = numbers(light.eval(si))[0] if light is not None else 0.0
        answer["hits"].append([numbers(si.p), numbers(si.sh_frame.n), numbers(albedo), seen])
    for direction in job["around"]:
        si = mi.SurfaceInteraction3f()
        si.wi = -mi.Vector3f(direction)
        answer["around"].append(numbers(scene.environment().eval(si))[0])
    print(json.dumps(answer), flush=True)
"""


@pytest.fixture(scope="session")
def mitsuba() -> Iterator[object]:
    """A function that asks Mitsuba about a scene file."""
    process = subprocess.Popen([sys.executable, "-c", ORACLE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def ask(xml: Path, *, raster: object = (), rays: object = (), around: object = ()) -> dict:
        job = {"xml": str(xml), "raster": raster, "rays": rays, "around": around}
        process.stdin.write(json.dumps(job, default=lambda a: a.tolist()) + "\n")
        process.stdin.flush()
        return json.loads(process.stdout.readline())

    yield ask
    process.stdin.close()
    process.wait()
