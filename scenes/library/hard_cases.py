"""Scenes that break renderers, by name: near, far, grazing, thin, closed, specular, odd and huge. Numpy only.

`scene2spad.bench.hard` holds each against a closed form or a quadrature; the numbers they share are constants here.
Unless a scene says otherwise the camera is at the origin, looks along -z, and carries the laser.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from scenes.geometry import shapes
from scenes.model import Ambient, Camera, Laser, Material, Scene, Surface, Texture

ALBEDO = 0.5
WALL_M = 3.0
GROOVE_ALBEDO, GROOVE_M, GROOVE_SIZE_M = 0.6, 3.0, 1.0
BALL_M, BALL_RADIUS_M = 3.0, 0.5
GLINT_M, GLINT_RADIUS_M, GLINT_ROUGHNESS, GLINT_ETA, GLINT_K = 2.0, 0.05, 0.02, 2.9, 3.1
WIRE_M, WIRE_RADIUS_M, WIRE_X_M = 2.0, 1e-3, 0.011
FURNACE_EMISSION = 0.3
SPHERE_RADIUS_M, SPHERE_OFFSET_M = 1.0, 0.3
MIRROR_M, MIRROR_REFLECTANCE, MIRROR_TILT_DEG = 2.0, 0.8, 3.0
CAUSTIC_WALL_M, CAUSTIC_PANEL_M, CAUSTIC_DEPTHS_M, CAUSTIC_ROUGHNESS = 4.0, 1.0, (1.2, 3.5), 0.003
CUBE_M, CUBE_SIZE_M = 2.0, 0.05
CUBE_APEX_M = (0.03, -0.05, -CUBE_M)
PANE_M, GLASS_IOR, SLAB_M, SLAB_THICKNESS_M = 1.0, 1.5, 1.0, 0.3
LEAF_M, LEAF_RADIUS_M, LEAF_SIZE_M = 2.0, 0.35, 1.0
BASELINE_M = (0.1, 0.0, 0.0)
BASELINE_WALL_M, POST_M, POST_X_M = 2.0, 1.0, (-0.1, 0.0)
MILLION_SIDE = 708  # cells a side of a square: 1,002,528 triangles


def quad(corners: list[tuple[float, float, float]], material: Material, name: str = "quad") -> Surface:
    return Surface(np.array(corners, float), np.array([[0, 1, 2], [0, 2, 3]]), material, name=name)


def wall(distance_m: float, albedo: float, *, tilt_deg: float = 0.0, half_size_m: float = 1.0) -> Surface:
    """Return a square through (0, 0, -distance), facing +z, turned about the vertical by `tilt_deg`."""
    c, s = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    h = half_size_m
    corners = [(-h * c, -h, -distance_m + h * s), (h * c, -h, -distance_m - h * s)]
    corners += [(h * c, h, -distance_m - h * s), (-h * c, h, -distance_m + h * s)]
    return quad(corners, Material(albedo=albedo), "wall")


def camera(width: int = 32, height: int = 24, fov_deg: float = 34.0) -> Camera:
    """Return at the origin, looking along -z."""
    return Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=fov_deg, width=width, height=height)


def plane(distance_m: float, *, albedo: float = ALBEDO, fov_deg: float = 34.0) -> Scene:
    """Return a frontal wall that fills the image."""
    return Scene("plane", (wall(distance_m, albedo, half_size_m=2 * distance_m),), camera(16, 12, fov_deg))


def grazing(incidence_deg: float) -> Scene:
    """Return a wall 3 m away that every pixel sees near grazing: the image spans half the angle left to 90 on each
    side."""
    left = 90 - incidence_deg
    return Scene(
        "grazing", (wall(WALL_M, ALBEDO, tilt_deg=incidence_deg, half_size_m=20),), camera(16, 12, fov_deg=left)
    )


def horizon() -> Scene:
    """Return a wall at 89 degrees seen past its far edge, 5 m on: its last pixels look along it."""
    return Scene("horizon", (wall(WALL_M, ALBEDO, tilt_deg=89, half_size_m=5),), camera(16, 12, 10.0))


def ball() -> Scene:
    """Return a ball of 330,000 triangles before nothing: its silhouette."""
    vertices, faces, _ = shapes.sphere(BALL_RADIUS_M, 7)
    surface = Surface(vertices + (0, 0, -BALL_M), faces, Material(albedo=0.7), name="ball")
    return Scene("ball", (surface,), camera(48, 36, 30.0))


def glint() -> Scene:
    """Return a polished steel ball before nothing: its highlight is a fortieth of a pixel wide and most of its
    light."""
    vertices, faces, _ = shapes.sphere(GLINT_RADIUS_M, 6)
    steel = Material("roughconductor", roughness=GLINT_ROUGHNESS, eta=GLINT_ETA, k=GLINT_K)
    normals = vertices / GLINT_RADIUS_M
    surface = Surface(vertices + (0, 0, -GLINT_M), faces, steel, normals=normals, name="ball")
    return Scene("glint", (surface,), camera(16, 12))


def wire() -> Scene:
    """Return an upright wire, 2 mm thick, in pixels 38 mm wide at its distance, before a wall."""
    ends = ((WIRE_X_M, -3, -WIRE_M), (WIRE_X_M, 3, -WIRE_M))
    vertices, faces, _ = shapes.cylinder(*ends, WIRE_RADIUS_M, segments=64)
    thin = Surface(vertices, faces, Material(albedo=0.8), name="wire")
    return Scene("wire", (wall(WALL_M, ALBEDO, half_size_m=20), thin), camera())


def groove(opening_deg: float = 90.0, *, scale: float = 1.0) -> Scene:
    """Return two squares that meet in an upright edge, open toward the camera and all in view."""
    return groove_of(16, 12, albedo=GROOVE_ALBEDO, opening_deg=opening_deg, scale=scale)


def groove_of(
    width: int,
    height: int,
    *,
    albedo: float,
    size_m: float = GROOVE_SIZE_M,
    opening_deg: float = 90.0,
    scale: float = 1.0,
    laser: Laser | None = None,
) -> Scene:
    """Return two squares of that size at the opening angle, meeting in the line x = 0, z = -3 m, everything times
    `scale`."""
    half = math.radians(opening_deg) / 2
    x, z = size_m * math.sin(half), size_m * math.cos(half) - GROOVE_M
    e = -GROOVE_M
    left = [(-x, -0.5, z), (0, -0.5, e), (0, 0.5, e), (-x, 0.5, z)]
    right = [(0, -0.5, e), (x, -0.5, z), (x, 0.5, z), (0, 0.5, e)]
    material = Material(albedo=albedo)
    walls = [quad(corners, material, name) for corners, name in ((left, "left"), (right, "right"))]
    scaled = tuple(replace(one, vertices=scale * one.vertices) for one in walls)
    return Scene("groove", scaled, camera(width, height, 36.0), laser or Laser("flood"))


def furnace(albedo: float) -> Scene:
    """Return the inside of a cube whose walls emit and reflect: the same radiance everywhere."""
    vertices, faces, uv = shapes.box((4, 4, 4))
    walls = Surface(vertices, faces[:, ::-1], Material(albedo=albedo), uv=uv, emission=FURNACE_EMISSION, name="walls")
    return Scene("furnace", (walls,), camera(16, 12, 60.0))


def integrating_sphere(albedo: float, *, width: int = 16, height: int = 12) -> Scene:
    """Return the inside of a diffuse sphere, an isotropic laser at its centre, the camera off it: even light."""
    vertices, faces, _ = shapes.sphere(SPHERE_RADIUS_M, 6)
    shell = Surface(vertices - (0, 0, SPHERE_OFFSET_M), faces[:, ::-1], Material(albedo=albedo), name="shell")
    laser = Laser("flood", (0.0, 0.0, SPHERE_OFFSET_M), 360.0)
    return Scene("integrating sphere", (shell,), camera(width, height, 60.0), laser)


def mirror() -> Scene:
    """Return a flat mirror turned by 3 degrees: one pixel, off the centre, sees the laser in it."""
    material = Material("conductor", eta=0.0, k=1.0, specular=MIRROR_REFLECTANCE, name="mirror")
    square = wall(MIRROR_M, ALBEDO, tilt_deg=MIRROR_TILT_DEG, half_size_m=1.0)
    return Scene("mirror", (replace(square, material=material),), camera(15, 11, 20.0))


def caustic() -> Scene:
    """Return a wall, and beside it a polished panel, at a right angle to it, that mirrors the flash onto it."""
    near, far = CAUSTIC_DEPTHS_M
    corners = [(CAUSTIC_PANEL_M, float(y), -z) for y, z in ((-2, near), (-2, far), (2, far), (2, near))]
    panel = Material(
        "roughconductor", roughness=CAUSTIC_ROUGHNESS, eta=0.0, k=1.0, specular=MIRROR_REFLECTANCE, name="panel"
    )
    back = wall(CAUSTIC_WALL_M, ALBEDO, half_size_m=3)
    return Scene("caustic", (back, quad(corners, panel, "panel")), camera(24, 16, 60.0))


def corner_cube() -> Scene:
    """Return three mirrors at right angles, 5 cm large, their apex 2 m away, turned a little out of symmetry."""
    material = Material("conductor", eta=0.0, k=1.0, specular=MIRROR_REFLECTANCE, name="mirror")
    diagonal = shapes.axis_frame(np.ones(3) / math.sqrt(3))
    turn = math.radians(5)
    tilt = np.array([(1, 0, 0), (0, math.cos(turn), -math.sin(turn)), (0, math.sin(turn), math.cos(turn))])
    edges = CUBE_SIZE_M * tilt @ diagonal.T  # its columns are the cube's three edges, their sum looks along +z
    apex = np.array(CUBE_APEX_M)
    faces = []
    for i in range(3):
        a, b = edges[:, i], edges[:, (i + 1) % 3]
        corners = [(float(x), float(y), float(z)) for x, y, z in (apex, apex + a, apex + a + b, apex + b)]
        faces.append(quad(corners, material, f"mirror {i}"))
    return Scene("corner cube", tuple(faces), camera(15, 11, 10.0))


def window() -> Scene:
    """Return a thin pane of glass before a wall."""
    pane = replace(wall(PANE_M, 0.0, half_size_m=3), material=Material("thindielectric", ior=GLASS_IOR), name="pane")
    return Scene("window", (wall(WALL_M, ALBEDO, half_size_m=20), pane), camera(15, 11, 34.0))


def slab() -> Scene:
    """Return a thick slab of glass before a wall, seen head on."""
    vertices, faces, uv = shapes.box((2, 2, SLAB_THICKNESS_M))
    glass = Surface(vertices - (0, 0, SLAB_M), faces, Material("dielectric", ior=GLASS_IOR), uv=uv, name="slab")
    return Scene("slab", (wall(WALL_M, ALBEDO, half_size_m=20), glass), camera(9, 7, 2.0))


def leaf() -> Scene:
    """Return a round leaf cut out of a square by its opacity, before a wall."""
    side = 512
    texel = np.abs((np.arange(side) + 0.5) / side - 0.5) * LEAF_SIZE_M
    radius = np.hypot(texel[:, None], texel)
    # grey across the rim: bilinear interpolation then crosses 1/2 on the circle itself
    opacity = Texture(np.clip(0.5 + (LEAF_RADIUS_M - radius) * side / LEAF_SIZE_M, 0, 1), "leaf")
    square, faces, uv = shapes.rectangle()
    sheet = Surface(
        square * LEAF_SIZE_M / 2 - (0, 0, LEAF_M), faces, Material(albedo=0.3, opacity=opacity), uv=uv, name="leaf"
    )
    return Scene("leaf", (wall(WALL_M, ALBEDO, half_size_m=20), sheet), camera())


def baseline_shadow() -> Scene:
    """Return a laser 10 cm to the right of the camera, and a post that throws its shadow on a wall."""
    (low, high), z = POST_X_M, -POST_M
    post = quad([(low, -1, z), (high, -1, z), (high, 1, z), (low, 1, z)], Material(albedo=0.8), "post")
    laser = Laser("flood", BASELINE_M, 100.0)
    return Scene("baseline", (wall(BASELINE_WALL_M, ALBEDO, half_size_m=20), post), camera(), laser)


def clean_groove() -> Scene:
    """Return the groove under a displaced laser, so that shadow rays are traced: what the odd meshes below must
    equal."""
    return groove_of(16, 12, albedo=GROOVE_ALBEDO, laser=Laser("flood", BASELINE_M, 60.0))


def _altered(name: str, alter: Callable[[Surface], Surface]) -> Scene:
    scene = clean_groove()
    return replace(scene, name=name, surfaces=tuple(map(alter, scene.surfaces)))


def duplicated_faces() -> Scene:
    """Return every triangle twice, the second time with its back to the front."""
    return _altered("duplicated", lambda s: replace(s, faces=np.concatenate((s.faces, s.faces[:, ::-1]))))


def coplanar_faces() -> Scene:
    """Return every square once more, cut along its other diagonal and a little smaller, in the same plane."""

    def with_patch(surface: Surface) -> Surface:
        middle = surface.vertices.mean(axis=0)
        patch = middle + 0.75 * (surface.vertices - middle)
        faces = np.concatenate((surface.faces, [[5, 6, 7], [5, 7, 4]]))
        return replace(surface, vertices=np.concatenate((surface.vertices, patch)), faces=faces)

    return _altered("coplanar", with_patch)


def degenerate_triangles() -> Scene:
    """Return triangles without area among the others: points, doubled corners and three corners in a line."""

    def with_slivers(surface: Surface) -> Surface:
        middle = surface.vertices[[0, 2]].mean(axis=0, keepdims=True)
        faces = np.concatenate((surface.faces, [[0, 0, 0], [1, 1, 2], [0, 4, 2], [2, 4, 0]]))
        return replace(surface, vertices=np.concatenate((surface.vertices, middle)), faces=faces)

    return _altered("degenerate", with_slivers)


def inverted_normals() -> Scene:
    """Return the second wall's triangles, and half of the first one's, wound the other way round."""

    def turned(surface: Surface) -> Surface:
        faces = surface.faces[:, ::-1].copy() if surface.name == "right" else surface.faces.copy()
        if surface.name == "left":
            faces[1] = faces[1, ::-1]
        return replace(surface, faces=faces)

    return _altered("inverted", turned)


def million_triangles(side: int = MILLION_SIDE) -> Scene:
    """Return a flat wall of side x side x 2 triangles."""
    line = np.linspace(-2, 2, side + 1)
    x, y = np.meshgrid(line, line)
    corner = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    right, up = corner + 1, corner + side + 1
    faces = np.concatenate((np.column_stack((corner, right, up + 1)), np.column_stack((corner, up + 1, up))))
    vertices = np.column_stack((x.ravel(), y.ravel(), np.full(x.size, -WALL_M)))
    return Scene("million", (Surface(vertices, faces, Material(albedo=ALBEDO), name="wall"),), camera(32, 32))


def nothing_in_view() -> Scene:
    """Return a wall behind the camera."""
    return Scene("nothing", (wall(-WALL_M, ALBEDO),), camera(16, 12))


def empty_sky() -> Scene:
    """Return nothing in view but ambient light."""
    return replace(nothing_in_view(), name="sky", ambient=Ambient(0.7))


SCENES: dict[str, Callable[[], Scene]] = {
    "near": lambda: plane(0.05),
    "far": lambda: plane(14.90, fov_deg=2.0),
    "wraps": lambda: plane(14.995, fov_deg=2.0),
    "kilometre": lambda: plane(500.0, fov_deg=2.0),
    "grazing-80": lambda: grazing(80),
    "grazing-89": lambda: grazing(89),
    "grazing-89.9": lambda: grazing(89.9),
    "horizon": horizon,
    "silhouette": ball,
    "glint": glint,
    "wire": wire,
    "groove-60": lambda: groove(60),
    "groove-90": lambda: groove(90),
    "groove-small": lambda: groove(90, scale=1e-3),
    "groove-large": lambda: groove(90, scale=1e3),
    "one-pixel": lambda: integrating_sphere(0.5, width=1, height=1),
    "furnace-0.5": lambda: furnace(0.5),
    "furnace-0.99": lambda: furnace(0.99),
    "sphere-0.001": lambda: integrating_sphere(0.001),
    "sphere-0.5": lambda: integrating_sphere(0.5),
    "sphere-0.99": lambda: integrating_sphere(0.99),
    "mirror": mirror,
    "caustic": caustic,
    "corner-cube": corner_cube,
    "window": window,
    "slab": slab,
    "leaf": leaf,
    "baseline": baseline_shadow,
    "clean-groove": clean_groove,
    "duplicated": duplicated_faces,
    "coplanar": coplanar_faces,
    "degenerate": degenerate_triangles,
    "inverted": inverted_normals,
    "million": million_triangles,
    "nothing": nothing_in_view,
    "sky": empty_sky,
}


def hard_case(name: str) -> Scene:
    """Return the scene of that name, called `hard-cases/NAME`."""
    return replace(SCENES[name](), name=f"hard-cases/{name}")
