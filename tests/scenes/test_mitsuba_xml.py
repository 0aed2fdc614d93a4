"""scenes.mitsuba_xml: what is read from a Mitsuba scene file, against Mitsuba itself and against closed forms."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from scenes import Ambient, InputError, Scene, Surface, Texture, shapes
from scenes.mitsuba_xml import load_mitsuba_xml
from scenes.textures import srgb_to_linear

DATA = Path(os.environ.get("SCENE2SPAD_DATA") or Path(__file__).parents[2].parent / "shared" / "data")
LIVING_ROOM = DATA / "scenes" / "living-room" / "scene.xml"
SENSOR = (
    '<sensor type="perspective"><float name="fov" value="60"/>'
    '<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film></sensor>'
)
RECTANGLE = '<shape type="rectangle"/>'

# Mitsuba answers from a process of its own: importing it here would fix the LLVM library for all other tests.
ORACLE = """
import json, sys
import mitsuba as mi
import numpy as np
mi.set_variant("scalar_rgb")
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


@pytest.fixture(scope="module")
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
    process.wait(timeout=30)


def write(folder: Path, body: str, *, version: str = "3.0.0", sensor: str = SENSOR, name: str = "a.xml") -> Path:
    path = folder / name
    path.write_text(f'<scene version="{version}">\n{body}\n{sensor}\n</scene>\n')
    return path


def load(folder: Path, body: str, **options: str) -> Scene:
    return load_mitsuba_xml(write(folder, body, **options))


def material(folder: Path, bsdf: str, **options: str) -> object:
    return load(folder, f'<shape type="rectangle">{bsdf}</shape>', **options).surfaces[0].material


def refusal(folder: Path, body: str, **options: str) -> str:
    """The message a scene is refused with: one line that begins with the file."""
    path = write(folder, body, **options)
    with pytest.raises(InputError) as error:
        load_mitsuba_xml(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    return message


def image(folder: Path, name: str, values: np.ndarray) -> None:
    from PIL import Image

    Image.fromarray(np.asarray(values, np.uint8)).save(folder / name)


def first_hit(surface: Surface, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, ...]:
    """Point, shading normal, face normal and uv of the nearest hit, by solving every triangle."""
    origin, direction = np.asarray(origin, float), np.asarray(direction, float)
    a, b, c = (surface.vertices[surface.faces[:, i]] for i in range(3))
    system = np.stack((b - a, c - a, np.broadcast_to(-direction, a.shape)), axis=-1)
    solvable = abs(np.linalg.det(system)) > 1e-14
    solution = np.full_like(a, np.nan)
    solution[solvable] = np.linalg.solve(system[solvable], (origin - a)[solvable][..., None])[..., 0]
    u, v, t = solution.T
    t = np.where((u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 1e-6), t, np.inf)
    i = int(np.argmin(t))
    assert np.isfinite(t[i])
    weights = np.array([1 - u[i] - v[i], u[i], v[i]])
    face = np.cross(b[i] - a[i], c[i] - a[i])
    face /= np.linalg.norm(face)
    normal = face if surface.normals is None else weights @ surface.normals[surface.faces[i]]
    uv = np.zeros(2) if surface.uv is None else weights @ surface.uv[surface.faces[i]]
    return origin + t[i] * direction, normal / np.linalg.norm(normal), face, uv


def texel(texture: Texture, uv: np.ndarray) -> float:
    height, width = texture.image.shape
    return float(texture.image[int((1 - uv[1]) % 1 * height) % height, int(uv[0] % 1 * width) % width])


# --- the camera ---------------------------------------------------------------------------------------------------

TO_WORLD = {
    "identity": "",
    "lookat": '<lookat origin="1, 2, 3" target="-1 0.5 9" up="0.1 1 0"/>',
    "chain": '<scale value="2"/><rotate y="1" angle="35"/><rotate x="1" z="0.5" angle="-20"/><translate x="1" z="-4"/>',
    "matrix": '<matrix value="0 0 1 5  0 1 0 6  -1 0 0 7  0 0 0 1"/>',
    "small matrix": '<matrix value="0 0 1  0 1 0  -1 0 0"/><translate value="1 2 3"/>',
}
FOV = [
    '<float name="fov" value="70"/>',
    *(
        f'<float name="fov" value="50"/><string name="fov_axis" value="{axis}"/>'
        for axis in ("x", "y", "diagonal", "smaller", "larger")
    ),
    '<string name="focal_length" value="28mm"/>',
    "",
]


def camera_xml(to_world: str, fov: str, width: int = 40, height: int = 24, kind: str = "perspective") -> str:
    film = f'<integer name="width" value="{width}"/><integer name="height" value="{height}"/>'
    return (
        f'<sensor type="{kind}">{fov}<transform name="to_world">{to_world}</transform>'
        f'<film type="hdrfilm">{film}</film></sensor>'
    )


@pytest.mark.parametrize("to_world", [v for k, v in TO_WORLD.items() if k != "chain"], ids=lambda v: v[:10])
@pytest.mark.parametrize("size", [(40, 24), (20, 32)])
def test_camera_rays_are_mitsubas(tmp_path: Path, mitsuba: object, to_world: str, size: tuple[int, int]) -> None:
    raster = [(0.1, 0.2), (0.9, 0.3), (0.5, 0.5), (0.25, 0.85)]
    for fov in FOV:
        path = write(tmp_path, RECTANGLE, sensor=camera_xml(to_world, fov, *size))
        camera = load_mitsuba_xml(path).camera
        expected = np.array(mitsuba(path, raster=raster)["camera"])
        rays = camera.rays(*(np.array(raster) * size).T)
        np.testing.assert_allclose(rays, expected[:, 3:], atol=2e-6)
        # Mitsuba's rays start on the near plane: the camera lies on them.
        off_axis = np.cross(expected[:, :3] - camera.origin, rays)
        np.testing.assert_allclose(off_axis, 0, atol=2e-5)


def test_steps_of_a_transform_apply_in_order(tmp_path: Path) -> None:
    sensor = camera_xml(TO_WORLD["chain"], FOV[0])
    scene = load(tmp_path, RECTANGLE, sensor=sensor)
    yaw, pitch = math.radians(35), math.radians(-20)
    axis = np.array([1, 0, 0.5]) / math.hypot(1, 0.5)
    forward = np.array([math.sin(yaw), 0, math.cos(yaw)])
    forward = (
        forward * math.cos(pitch)
        + np.cross(axis, forward) * math.sin(pitch)
        + axis * (axis @ forward) * (1 - math.cos(pitch))
    )
    np.testing.assert_allclose(scene.camera.rotation[:, 2], forward, atol=1e-12)
    np.testing.assert_allclose(scene.camera.origin, (1, 0, -4))
    assert scene.notes == ()


def test_left_in_mitsuba_is_left_here(tmp_path: Path) -> None:
    """Mitsuba's camera without a transform looks along +z with +x to its left and +y up."""
    camera = load(tmp_path, RECTANGLE).camera
    rays = camera.rays()
    assert rays[0, 0, 0] > 0 > rays[0, -1, 0] and rays[0, 0, 1] > 0 > rays[-1, 0, 1]
    assert (rays[..., 2] > 0).all()
    np.testing.assert_allclose(
        rays[2, 0], np.array([3.5, 0.5, 4 / math.tan(math.pi / 6)]) / np.linalg.norm([3.5, 0.5, 4 * 3**0.5])
    )


def test_another_size_keeps_the_horizontal_angle(tmp_path: Path) -> None:
    path = write(tmp_path, RECTANGLE)
    assert (load_mitsuba_xml(path, width=64).camera.width, load_mitsuba_xml(path, width=64).camera.height) == (64, 48)
    camera = load_mitsuba_xml(path, width=30, height=90).camera
    assert (camera.width, camera.height, camera.fov_deg) == (30, 90, 60)


@pytest.mark.parametrize(
    ("to_world", "note"),
    [
        ('<scale x="1" y="2" z="3"/>', "stretches"),
        ('<scale x="-1"/>', "mirrors"),
        ('<matrix value="1.0001 0 0 0  0 1 2e-4 0  0 0 1 0  0 0 0 1"/>', ""),
        ('<scale value="3"/>', ""),
    ],
)
def test_camera_transform_is_made_rigid(tmp_path: Path, to_world: str, note: str) -> None:
    scene = load(tmp_path, RECTANGLE, sensor=camera_xml(to_world, FOV[0]))
    np.testing.assert_allclose(scene.camera.rotation, np.diag((-1, -1, 1)), atol=3e-4)
    assert [note in line for line in scene.notes] == ([True] if note else [])


def test_sensor_variants_are_noted(tmp_path: Path) -> None:
    lens = camera_xml("", '<float name="aperture_radius" value="0.1"/>' + FOV[0], kind="thinlens")
    scene = load(tmp_path, RECTANGLE, sensor=lens + SENSOR)
    assert scene.camera.fov_deg == 70
    assert any("pinhole" in line for line in scene.notes) and any("2 sensors" in line for line in scene.notes)
    legacy = camera_xml("", '<float name="fov" value="50"/><string name="fovAxis" value="y"/>').replace("to_w", "toW")
    fov = load(tmp_path, RECTANGLE, sensor=legacy, version="0.6.0").camera.fov_deg
    assert fov == pytest.approx(math.degrees(2 * math.atan(math.tan(math.radians(25)) * 40 / 24)))


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        ("", "no sensor"),
        ('<sensor type="orthographic"/>', "orthographic"),
        (camera_xml("", '<float name="fov" value="200"/>'), "outside 0 to 180"),
        (camera_xml("", '<float name="fov" value="175"/>'), "outside 0.01 to 170"),
        (camera_xml("", '<float name="fov" value="abc"/>'), "abc"),
        (camera_xml("", '<float name="fov" value="nan"/>'), "finite"),
        (camera_xml("", FOV[0] + '<string name="fov_axis" value="z"/>'), "fov_axis 'z'"),
        (camera_xml("", '<string name="focal_length" value="long"/>'), "millimetres"),
        (camera_xml('<matrix value="1 0 0"/>', FOV[0]), "3 values, expected 16 or 9"),
        (camera_xml('<scale value="0"/>', FOV[0]), "determinant"),
        (camera_xml('<matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 1 0 1"/>', FOV[0]), "last row"),
        (camera_xml('<twist value="0"/>', FOV[0]), "<twist>"),
        (camera_xml('<lookat origin="0 0 0" target="0 0 0" up="0 1 0"/>', FOV[0]), "same point"),
        (camera_xml('<lookat origin="0 0 0" target="0 2 0" up="0 1 0"/>', FOV[0]), "viewing direction"),
        (camera_xml('<lookat origin="0 0 0" up="0 1 0"/>', FOV[0]), 'lacks target="..."'),
        (camera_xml('<rotate angle="3"/>', FOV[0]), "no axis"),
        (camera_xml("", FOV[0], width=0), "0 x 24"),
    ],
)
def test_bad_sensors_are_refused(tmp_path: Path, sensor: str, words: str) -> None:
    assert words in refusal(tmp_path, RECTANGLE, sensor=sensor)


# --- shapes -------------------------------------------------------------------------------------------------------

OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0.5\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
OBJ_NORMALS = "vn 0 0 1\nvn 0.6 0 0.8\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "property float nx\nproperty float ny\nproperty float nz\nproperty float u\nproperty float v\n"
    "element face 2\nproperty list uchar int vertex_index\nend_header\n"
    "0 0 0 0 0 1 0 0\n1 0 0 0 0 1 1 0\n1 1 0.5 0.6 0 0.8 1 1\n0 1 0 0 0 1 0 1\n3 0 1 2\n3 0 2 3\n"
)


def meshes(folder: Path) -> None:
    (folder / "flat.obj").write_text(OBJ + "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    (folder / "quad.obj").write_text(OBJ + OBJ_NORMALS + "usemtl none\nmtllib ../none.mtl\nf 1/1/1 2/2/1 3/3/2 4/4/1\n")
    (folder / "bare.obj").write_bytes("# für alle\n".encode("latin-1") + (OBJ + "f 1 2 3\nf 1 3 4\n").encode())
    (folder / "mesh.ply").write_text(PLY)


DOWN = [((0.3, 0.2, 5), (0, 0, -1)), ((0.2, 0.35, 5), (0, 0, -1)), ((0.6, 0.3, 5), (0, 0, -1))]
SIDES = [((-0.3, 0.2, 5), (0, 0, -1)), ((5, 0.3, 0.4), (-1, 0, 0)), ((-0.3, -5, 0.4), (0, 1, 0))]
SIDES += [((0.2, 0.3, -5), (0, 0, 1)), ((-5, 0.3, 0.4), (1, 0, 0)), ((0.3, 5, -0.4), (0, -1, 0))]
MIRROR = '<transform name="to_world"><scale x="-1"/></transform>'
SHAPES = [
    ("rectangle", "", SIDES[:1]),
    ("cube", "", SIDES),
    ("sphere", "", SIDES),
    ("disk", "", SIDES[:1]),
    ("cylinder", "", SIDES[1:3]),
    ("sphere", '<point name="center" x="0.1" y="0.2" z="0"/><float name="radius" value="1.5"/>', SIDES),
    (
        "cylinder",
        '<point name="p0" value="0 -1 0"/><point name="p1" x="0.2" y="2" z="0"/><float name="radius" value="0.7"/>',
        SIDES[:2],
    ),
    ("obj", '<string name="filename" value="flat.obj"/>', DOWN),
    ("obj", '<string name="filename" value="quad.obj"/>', DOWN),
    ("obj", '<string name="filename" value="quad.obj"/><boolean name="flip_tex_coords" value="false"/>', DOWN),
    ("obj", '<string name="filename" value="quad.obj"/><boolean name="face_normals" value="true"/>', DOWN),
    ("ply", '<string name="filename" value="mesh.ply"/>', DOWN),
    ("ply", '<string name="filename" value="mesh.ply"/><boolean name="flip_tex_coords" value="true"/>', DOWN),
]
TURN = '<transform name="to_world"><rotate y="1" angle="20"/><scale value="1 1.1 0.9"/><translate z="0.1"/></transform>'


@pytest.mark.parametrize("change", ["", MIRROR, '<boolean name="flip_normals" value="true"/>', TURN])
@pytest.mark.parametrize(("kind", "values", "rays"), SHAPES)
def test_shapes_are_mitsubas(tmp_path: Path, mitsuba: object, kind: str, values: str, rays: list, change: str) -> None:
    """Box, points, shading normals, the lit side and the texture's place, all where Mitsuba has them."""
    if change == TURN and kind in ("sphere", "cylinder", "disk"):
        change = change.replace("1 1.1 0.9", "1.1")
    if change == MIRROR:
        rays = [((-o[0], *o[1:]), (-d[0], *d[1:])) for o, d in rays]
    meshes(tmp_path)
    image(tmp_path, "t.png", np.arange(0, 240, 2.5).reshape(8, 12))
    bitmap = '<texture type="bitmap" name="reflectance"><string name="filename" value="t.png"/>{}</texture>'
    bitmap = bitmap.format('<boolean name="raw" value="true"/><string name="filter_type" value="nearest"/>')
    body = (
        f'<shape type="{kind}">{values}{change}<bsdf type="twosided"><bsdf type="diffuse">{bitmap}</bsdf></bsdf>'
        '<emitter type="area"><rgb name="radiance" value="3"/></emitter></shape>'
    )
    path = write(tmp_path, body)
    surface = load_mitsuba_xml(path).surfaces[0]
    answer = mitsuba(path, rays=rays)
    box = [surface.vertices.min(axis=0), surface.vertices.max(axis=0)]
    np.testing.assert_allclose(box, answer["bbox"], atol=4e-4 * 1.5 if surface.normals is not None else 1e-6)
    for (origin, direction), (point, normal, albedo, light) in zip(rays, answer["hits"], strict=True):
        ours, shading, face, uv = first_hit(surface, origin, direction)
        np.testing.assert_allclose(ours, point, atol=1e-3)
        np.testing.assert_allclose(shading, normal, atol=2e-3)
        assert texel(surface.material.albedo, uv) == pytest.approx(albedo[0], abs=1e-4)
        assert surface.emission * (face @ direction < 0) == pytest.approx(light)


def test_bare_obj_gets_smooth_normals_unless_asked(tmp_path: Path, mitsuba: object) -> None:
    meshes(tmp_path)
    body = '<shape type="obj"><string name="filename" value="bare.obj"/>{}</shape>'
    path = write(tmp_path, body.format(""))
    surface = load_mitsuba_xml(path).surfaces[0]
    assert surface.uv is None
    for ray, hit in zip(DOWN, mitsuba(path, rays=DOWN)["hits"], strict=True):
        np.testing.assert_allclose(first_hit(surface, *ray)[1], hit[1], atol=1e-5)
    flat = load(tmp_path, body.format('<boolean name="faceNormals" value="true"/>'), version="0.6.0")
    assert flat.surfaces[0].normals is None


def test_a_mesh_file_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import trimesh

    meshes(tmp_path)
    reads = []
    read = trimesh.load_scene
    monkeypatch.setattr(trimesh, "load_scene", lambda *a, **k: reads.append(1) or read(*a, **k))
    shape = '<shape type="ply"><string name="filename" value="mesh.ply"/></shape>'
    assert len(load(tmp_path, 3 * shape).surfaces) == 3 and len(reads) == 1


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ('<shape type="serialized"/>', "'serialized'"),
        ('<shape type="shapegroup"/>', "'shapegroup'"),
        ('<shape type="instance"/>', "'instance'"),
        ('<shape type="hair"/>', "'hair'"),
        ("<shape/>", 'lacks type="..."'),
        ('<shape type="obj"/>', 'lacks <string name="filename"'),
        ('<shape type="obj"><string name="filename" value="none.obj"/></shape>', "'none.obj' not found"),
        ('<shape type="obj"><string name="filename" value="/etc/none.obj"/></shape>', "outside the scene's folder"),
        ('<shape type="obj"><string name="filename" value="../none.obj"/></shape>', "outside the scene's folder"),
        ('<shape type="obj"><string name="filename" value="link.obj"/></shape>', "outside the scene's folder"),
        (f'<shape type="obj"><string name="filename" value="{"x" * 400}"/></shape>', "cannot be looked up"),
        ('<shape type="obj"><string name="filename" value="nan.obj"/></shape>', "nan.obj: mesh nan: 1 of 3 vertices"),
        ('<shape type="obj"><string name="filename" value="empty.obj"/></shape>', "empty.obj: holds no triangles"),
        ('<shape type="obj"><string name="filename" value="bad.obj"/></shape>', "bad.obj: broken .obj file"),
        ('<shape type="ply"><string name="filename" value="bad.ply"/></shape>', "bad.ply: broken .ply file"),
        ('<shape type="ply"><string name="filename" value="cut.ply"/></shape>', "cut.ply: "),
        ('<shape type="sphere"><float name="radius" value="0"/></shape>', "radius 0"),
        ('<shape type="cylinder"><point name="p1" value="0 0 0"/></shape>', "same point"),
        ('<shape type="sphere"><medium type="homogeneous" name="interior"/></shape>', "homogeneous"),
        ('<shape type="sphere"><subsurface type="dipole"/></shape>', "dipole"),
        ('<shape type="sphere"><emitter type="point"/></shape>', "'point'"),
        ('<shape type="sphere"><bsdf type="diffuse"/><bsdf type="diffuse"/></shape>', "2 bsdfs"),
        ('<shape type="sphere"><ref id="none"/></shape>', "unknown id 'none'"),
        ('<shape type="sphere"><colour name="x"/></shape>', "<colour>"),
        ('<shape type="sphere"><float value="3"/></shape>', 'lacks name="..."'),
        ('<shape type="sphere"><float name="radius"/></shape>', 'lacks value="..."'),
        ('<shape type="sphere"><string name="radius" value="1"/></shape>', "is a <string>"),
        ('<shape type="sphere"><boolean name="flip_normals" value="1"/></shape>', "true or false"),
        ('<shape type="sphere"><float name="radius" value="1"/><float name="radius" value="2"/></shape>', "twice"),
        (
            '<shape type="rectangle"><emitter type="area"><rgb name="radiance" value="-1"/></emitter></shape>',
            "emission -1",
        ),
        ("", "holds no shapes"),
        ('<medium type="homogeneous" id="m"/>', "is not supported"),
        ("<shapes/>", "unknown element"),
        ('<ref id="x"/>', "unknown element"),
    ],
)
def test_bad_shapes_are_refused(tmp_path: Path, shape: str, words: str) -> None:
    folder = tmp_path / "scene"
    folder.mkdir()
    (tmp_path / "none.obj").write_text(OBJ + "f 1 2 3\n")
    (folder / "link.obj").symlink_to(tmp_path / "none.obj")
    (folder / "nan.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "empty.obj").write_text("v 0 0 0\n")
    (folder / "bad.obj").write_text("v 0 0 0\nv 1 0 0\nf 1 2 9\n")
    (folder / "bad.ply").write_text("no ply")
    (folder / "cut.ply").write_text(PLY[:-20])
    assert words in refusal(folder, shape)


@pytest.mark.parametrize("name", ["box", "sphere", "cylinder"])
def test_closed_shapes_face_outwards_and_keep_their_volume(name: str) -> None:
    vertices, faces, uv = {
        "box": lambda: shapes.box((1, 2, 3)),
        "sphere": lambda: shapes.sphere(0.5),
        "cylinder": lambda: shapes.cylinder((1, 0, 0), (1, 2, 2), 0.5, segments=128, caps=True),
    }[name]()
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    exact = {"box": 6, "sphere": math.pi / 6, "cylinder": math.pi * 0.25 * math.sqrt(8)}[name]
    assert volume == pytest.approx(exact, rel=6e-4) and len(uv) == len(vertices)
    # Vertices are doubled where uv jumps, so no triangle runs across the image.
    assert np.ptp(uv[faces], axis=1)[:, 0].max() < (1.01 if name == "box" else 0.5 if name == "sphere" else 1.01)


def test_sphere_area_is_within_its_stated_share() -> None:
    vertices, faces, _ = shapes.sphere(2.0)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert 2.9e-4 < 1 - area / (16 * math.pi) < 3.1e-4
    # A half-lit sphere: the projected area decides the energy that comes back.
    shadow = np.cross(b - a, c - a)[:, 2]
    assert 1 - shadow[shadow > 0].sum() / 2 / (4 * math.pi) < 1e-3


# --- materials ----------------------------------------------------------------------------------------------------

GREY = '<rgb name="reflectance" value="0.2 0.4 0.6"/>'
LUMINANCE = 0.2126 * 0.2 + 0.7152 * 0.4 + 0.0722 * 0.6
AIR = 1.000277


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (GREY, LUMINANCE),
        ('<rgb name="reflectance" value="0.2, 0.4, 0.6"/>', LUMINANCE),
        ('<rgb name="reflectance" value="0.3"/>', 0.3),
        ('<rgb name="reflectance" value="#808080"/>', float(srgb_to_linear(128 / 255))),
        ('<srgb name="reflectance" value="0.5 0.5 0.5"/>', float(srgb_to_linear(0.5))),
        ('<spectrum name="reflectance" value="0.25"/>', 0.25),
        ('<spectrum name="reflectance" value="400:0.1, 500:0.2 600:0.6"/>', 0.275),
        ('<float name="reflectance" value="0.7"/>', 0.7),
        ("", 0.5),
    ],
)
def test_colours_become_one_number(tmp_path: Path, value: str, expected: float) -> None:
    assert material(tmp_path, f'<bsdf type="diffuse">{value}</bsdf>').albedo == pytest.approx(expected)


@pytest.mark.parametrize(
    ("bsdf", "expected"),
    [
        (f'<bsdf type="twosided"><bsdf type="diffuse">{GREY}</bsdf></bsdf>', {"kind": "diffuse", "albedo": LUMINANCE}),
        (
            f'<bsdf type="roughdiffuse">{GREY}<float name="alpha" value="0.3"/></bsdf>',
            {"kind": "roughdiffuse", "roughness": 0.3, "albedo": LUMINANCE},
        ),
        ('<bsdf type="plastic"/>', {"kind": "plastic", "albedo": 0.5, "ior": 1.49 / AIR, "specular": 1}),
        (
            '<bsdf type="roughplastic"><float name="intIOR" value="1.5"/><float name="extIOR" value="1"/>'
            '<float name="alpha" value="0.2"/><rgb name="diffuseReflectance" value="0.1"/></bsdf>',
            {"kind": "roughplastic", "ior": 1.5, "roughness": 0.2, "albedo": 0.1},
        ),
        ('<bsdf type="conductor"/>', {"kind": "conductor", "eta": 0, "k": 1}),
        (
            '<bsdf type="roughconductor"><string name="material" value="Au"/><float name="alpha" value="0"/></bsdf>',
            {"kind": "conductor", "eta": 0.156, "k": 3.602},
        ),
        (
            '<bsdf type="roughconductor"><rgb name="eta" value="2"/><rgb name="k" value="4"/><float name="extEta" '
            'value="2"/><float name="alpha_u" value="0.1"/><float name="alpha_v" value="0.3"/></bsdf>',
            {"kind": "roughconductor", "eta": 1, "k": 2, "roughness": 0.2},
        ),
        ('<bsdf type="dielectric"/>', {"kind": "dielectric", "ior": 1.5046 / AIR}),
        (
            '<bsdf type="thindielectric"><string name="int_ior" value="diamond"/><string name="ext_ior" value="water"/>'
            "</bsdf>",
            {"kind": "thindielectric", "ior": 2.419 / 1.333},
        ),
        (
            '<bsdf type="mask"><float name="opacity" value="0.3"/><bsdf type="dielectric"/></bsdf>',
            {"kind": "dielectric", "opacity": 0.3},
        ),
    ],
)
def test_bsdfs(tmp_path: Path, bsdf: str, expected: dict) -> None:
    made = material(tmp_path, bsdf)
    assert {key: getattr(made, key) for key in expected} == pytest.approx(expected)


def test_conductor_defaults_differ_by_version(tmp_path: Path) -> None:
    """0.6 takes copper where nothing is said, 3 a perfect mirror; 0.6 also knows air outside."""
    copper = material(tmp_path, '<bsdf type="conductor"/>', version="0.6.0")
    assert (copper.eta, copper.k) == pytest.approx((0.238 / AIR, 3.626 / AIR))


@pytest.mark.parametrize(
    ("metal", "reflectance"), [("Au", 0.95), ("Ag", 0.98), ("Cu", 0.93), ("Al", 0.905), ("Cr", 0.55)]
)
def test_metals_reflect_as_metals_do(tmp_path: Path, metal: str, reflectance: float) -> None:
    made = material(tmp_path, f'<bsdf type="conductor"><string name="material" value="{metal}"/></bsdf>')
    fresnel = ((made.eta - 1) ** 2 + made.k**2) / ((made.eta + 1) ** 2 + made.k**2)
    assert fresnel == pytest.approx(reflectance, abs=0.025)


def test_one_material_object_for_all_its_shapes(tmp_path: Path) -> None:
    body = f'<bsdf type="diffuse" id="m">{GREY}</bsdf><alias id="m" as="n"/><rgb id="white" name="x" value="0.9"/>'
    body += '<shape type="sphere"><ref id="m"/></shape><shape type="cube"><ref name="bsdf" id="n"/></shape>'
    body += "<shape type='cube'/><shape type='disk'/>"
    body += '<shape type="cube"><bsdf type="diffuse"><ref name="reflectance" id="white"/></bsdf></shape>'
    found = [surface.material for surface in load(tmp_path, body).surfaces]
    assert found[0] is found[1] and found[2] is found[3] and found[0].name == "m"
    assert found[4].albedo == pytest.approx(0.9)


def test_textures_are_shared_scaled_and_masked(tmp_path: Path) -> None:
    rgba = np.zeros((2, 2, 4))
    rgba[..., :3], rgba[0, 0, 3], rgba[1, 1, 3] = 128, 255, 51
    image(tmp_path, "leaf.png", rgba)
    file = (
        '<string name="filename" value="leaf.png"/><float name="uscale" value="3"/><float name="voffset" value="0.5"/>'
    )
    leaf = f'<bsdf type="diffuse"><texture type="bitmap" name="reflectance">{file}</texture></bsdf>'
    mask = f'<bsdf type="mask"><texture type="bitmap" name="opacity">{file}</texture>{leaf}</bsdf>'
    scene = load(tmp_path, f'<shape type="rectangle">{mask}</shape><shape type="rectangle">{leaf}</shape>')
    one, two = scene.surfaces
    np.testing.assert_allclose(one.material.opacity.image, [[1, 0], [0, 0.2]], atol=1e-6)
    np.testing.assert_allclose(one.material.albedo.image, srgb_to_linear(128 / 255), rtol=1e-6)
    assert one.material.albedo is two.material.albedo and scene.notes == ()
    # The rectangle's own v runs downwards in Mitsuba's images: v -> 1 - (v + 0.5).
    np.testing.assert_allclose(one.uv, [(0, 0.5), (3, 0.5), (3, -0.5), (0, -0.5)])


def test_an_opacity_image_without_alpha_is_linear(tmp_path: Path) -> None:
    image(tmp_path, "t.png", np.full((2, 2), 128))
    texture = '<texture type="bitmap" name="opacity"><string name="filename" value="t.png"/></texture>'
    opacity = material(tmp_path, f'<bsdf type="mask">{texture}<bsdf type="diffuse"/></bsdf>').opacity
    np.testing.assert_allclose(opacity.image, 128 / 255, rtol=1e-6)


def test_to_uv_and_checkerboard_are_mitsubas(tmp_path: Path, mitsuba: object) -> None:
    texture = (
        '<texture type="checkerboard" name="reflectance"><rgb name="color0" value="0.1"/>'
        '<rgb name="color1" value="0.8"/><transform name="to_uv"><rotate z="1" angle="30"/><scale x="2" y="3"/>'
        '<translate x="0.2"/></transform></texture>'
    )
    path = write(tmp_path, f'<shape type="rectangle"><bsdf type="diffuse">{texture}</bsdf></shape>')
    surface = load_mitsuba_xml(path).surfaces[0]
    rays = [((x, y, 3), (0, 0, -1)) for x in np.linspace(-0.9, 0.95, 6) for y in np.linspace(-0.95, 0.9, 6)]
    for ray, hit in zip(rays, mitsuba(path, rays=rays)["hits"], strict=True):
        assert texel(surface.material.albedo, first_hit(surface, *ray)[3]) == pytest.approx(hit[2][0])


def test_what_is_changed_or_left_out_is_noted(tmp_path: Path) -> None:
    image(tmp_path, "t.png", np.full((2, 2), 255))
    texture = '<texture type="bitmap" name="{}"><string name="filename" value="t.png"/>{}</texture>'
    clamp = '<string name="wrap_mode" value="clamp"/>'
    bsdfs = [
        '<bsdf type="diffuse" id="white"><rgb name="reflectance" value="1.5"/></bsdf>',
        f'<bsdf type="bumpmap" id="bumpy">{texture.format("", clamp)}<bsdf type="diffuse"/></bsdf>',
        '<bsdf type="roughplastic" id="beck"><boolean name="nonlinear" value="true"/></bsdf>',
        f'<bsdf type="plastic" id="mean">{texture.format("specular_reflectance", clamp)}</bsdf>',
        '<bsdf type="twosided" id="two"><bsdf type="diffuse"/><bsdf type="plastic"/></bsdf>',
        '<bsdf type="diffuse" id="typo"><rgb name="reflectence" value="0.1"/></bsdf>',
        '<bsdf type="dielectric" id="tint"><rgb name="specular_transmittance" value="0.5"/></bsdf>',
    ]
    body = '<path value="x"/>' + "".join(f'<shape type="rectangle">{bsdf}</shape>' for bsdf in bsdfs)
    scene = load(tmp_path, body)
    assert scene.surfaces[0].material.albedo == 1
    expected = ["over 1 is clipped to 1: white", "bumpmap is left out", "as ggx with the same alpha: beck", "nonlinear"]
    expected += ["its mean is used: mean", "taken as repeat: mean", "back side", "reflectence is not used: typo"]
    expected += ["specular_transmittance is left out", "<path>"]
    for words in expected:
        assert sum(words in note for note in scene.notes) == 1, words
    assert len(scene.notes) == len(expected) and all("\n" not in note for note in scene.notes)


@pytest.mark.parametrize(
    ("bsdf", "words"),
    [
        ('<bsdf type="principled"/>', "'principled'"),
        ('<bsdf type="blendbsdf"/>', "'blendbsdf'"),
        ('<bsdf type="roughdielectric"/>', "'roughdielectric'"),
        ('<bsdf type="twosided"/>', "0 bsdfs"),
        (16 * '<bsdf type="twosided">' + '<bsdf type="diffuse"/>' + 16 * "</bsdf>", "nested more than"),
        ('<bsdf type="twosided" id="me"><ref id="me"/></bsdf>', "nested more than"),
        ('<bsdf type="mask"><bsdf type="mask"><bsdf type="diffuse"/></bsdf></bsdf>', "mask inside a mask"),
        ('<bsdf type="diffuse"><rgb name="reflectance" value="1 2"/></bsdf>', "2 values, expected 1 or 3"),
        ('<bsdf type="diffuse"><rgb name="reflectance" value="-1"/></bsdf>', "albedo"),
        ('<bsdf type="diffuse"><rgb name="reflectance" value="#12"/></bsdf>', "#rrggbb"),
        ('<bsdf type="diffuse"><spectrum name="reflectance" filename="a.spd"/></bsdf>', "plugin or file"),
        ('<bsdf type="diffuse"><spectrum name="reflectance" value="400:0.1 500"/></bsdf>', "expected 2"),
        ('<bsdf type="diffuse"><texture name="reflectance" type="noise"/></bsdf>', "'noise'"),
        ('<bsdf type="diffuse"><texture name="reflectance" type="bitmap"/></bsdf>', "filename"),
        (
            '<bsdf type="diffuse"><texture name="reflectance" type="bitmap"><string name="filename" value="n.png"/>'
            "</texture></bsdf>",
            "texture 'n.png' not found",
        ),
        (
            '<bsdf type="diffuse"><texture name="reflectance" type="bitmap"><string name="filename" value="bad.png"/>'
            "</texture></bsdf>",
            "not an image",
        ),
        ('<bsdf type="conductor"><string name="material" value="Unobtainium"/></bsdf>', "'Unobtainium'"),
        ('<bsdf type="conductor"><float name="eta" value="1"/></bsdf>', "both eta and k"),
        ('<bsdf type="dielectric"><float name="int_ior" value="1"/></bsdf>', "not above 1"),
        ('<bsdf type="dielectric"><string name="int_ior" value="jelly"/></bsdf>', "'jelly'"),
        ('<bsdf type="roughplastic"><float name="alpha" value="3"/></bsdf>', "roughness 3"),
    ],
)
def test_bad_materials_are_refused(tmp_path: Path, bsdf: str, words: str) -> None:
    (tmp_path / "bad.png").write_text("no image")
    assert words in refusal(tmp_path, f'<shape type="rectangle">{bsdf}</shape>')


def test_two_uv_transforms_and_missing_uv_are_refused(tmp_path: Path) -> None:
    meshes(tmp_path)
    checks = '<texture type="checkerboard" name="{}">{}</texture>'
    inner = f'<bsdf type="diffuse">{checks.format("reflectance", "")}</bsdf>'
    scaled = checks.format("opacity", '<float name="uscale" value="2"/>')
    masked = f'<shape type="rectangle"><bsdf type="mask">{scaled}{inner}</bsdf></shape>'
    assert "different to_uv" in refusal(tmp_path, masked)
    bare = f'<shape type="obj"><string name="filename" value="bare.obj"/>{inner}</shape>'
    assert "bare.obj: mesh bare: its material has a texture" in refusal(tmp_path, bare)


# --- light --------------------------------------------------------------------------------------------------------


def exr(path: Path, values: np.ndarray) -> None:
    import OpenEXR

    rgb = np.repeat(values[..., None], 3, axis=-1).astype(np.float32)
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    with OpenEXR.File(header, {"RGB": OpenEXR.Channel(rgb)}) as file:
        file.write(str(path))


def around(ambient: Ambient, direction: np.ndarray) -> float:
    """The map's value where Mitsuba's envmap has it: u from atan2(x, -z), v from the angle to +y."""
    x, y, z = ambient.pose[:3, :3].T @ direction
    return texel(ambient.environment, np.array([math.atan2(x, -z) / (2 * math.pi), 1 - math.acos(y) / math.pi]))


@pytest.mark.parametrize("turn", ["", '<rotate y="1" angle="90"/>', '<rotate x="1" angle="30"/>', '<scale x="-1"/>'])
def test_envmap_is_mitsubas(tmp_path: Path, mitsuba: object, turn: str) -> None:
    values = np.kron(np.arange(1, 19).reshape(3, 6), np.ones((20, 20)))
    exr(tmp_path / "sky.exr", values)
    body = '<emitter type="envmap"><string name="filename" value="sky.exr"/><float name="scale" value="0.5"/>'
    body += f'<transform name="to_world">{turn}</transform></emitter>'
    path = write(tmp_path, RECTANGLE + body)
    scene = load_mitsuba_xml(path)
    directions = np.random.default_rng(3).normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = np.array(mitsuba(path, around=directions)["around"])
    ours = np.array([around(scene.ambient, d) for d in directions])
    # Mitsuba interpolates: only directions inside a block of equal pixels compare.
    inside = abs(expected * 2 - np.round(expected * 2)) < 1e-3
    assert inside.sum() > 45
    np.testing.assert_allclose(ours[inside], expected[inside], rtol=1e-3)
    assert any("mirrors" in note for note in scene.notes) == ("scale" in turn)


def test_lights(tmp_path: Path) -> None:
    body = RECTANGLE + '<emitter type="constant"><rgb name="radiance" value="0.2 0.4 0.6"/></emitter>'
    body += '<emitter type="point" id="lamp"/><emitter type="sunsky"/>'
    scene = load(tmp_path, body)
    assert scene.ambient.radiance == pytest.approx(LUMINANCE) and scene.laser.is_colocated
    assert [note for note in scene.notes if note.endswith(": lamp, sunsky")]
    checks = (
        '<texture type="checkerboard" name="radiance"><float name="color0" value="4"/><float name="color1" value="2"/>'
    )
    lamp = load(tmp_path, f'<shape type="cube"><emitter type="area">{checks}</texture></emitter></shape>')
    assert lamp.surfaces[0].emission == pytest.approx(3) and any("mean" in note for note in lamp.notes)


@pytest.mark.parametrize(
    ("emitter", "words"),
    [
        ('<emitter type="constant"/><emitter type="constant"/>', "second light"),
        ('<emitter type="envmap"/>', "filename"),
        ('<emitter type="envmap"><string name="filename" value="sky.hdr"/></emitter>', "convert it to .exr"),
        ('<emitter type="envmap"><string name="filename" value="bad.exr"/></emitter>', "broken EXR"),
        ('<emitter type="area"/>', "inside its <shape>"),
        ('<emitter type="glow"/>', "'glow'"),
        ('<emitter type="constant"><rgb name="radiance" value="-1"/></emitter>', "negative"),
        ('<emitter type="constant"><blackbody name="radiance" value="3000"/></emitter>', "<blackbody>"),
    ],
)
def test_bad_lights_are_refused(tmp_path: Path, emitter: str, words: str) -> None:
    (tmp_path / "bad.exr").write_text("no image")
    assert words in refusal(tmp_path, RECTANGLE + emitter)


# --- the file -----------------------------------------------------------------------------------------------------


def test_defaults_and_includes(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    write(
        tmp_path / "parts",
        '<bsdf type="diffuse" id="m"><float name="reflectance" value="$r"/></bsdf>',
        sensor="",
        name="m.xml",
    )
    body = '<default name="r" value="0.3"/><default name="r" value="0.4"/><default name="dir" value="parts"/>'
    body += '<include filename="$dir/m.xml"/><integrator type="path"><integer name="max_depth" value="3"/></integrator>'
    scene = load(tmp_path, body + '<shape type="sphere" id="ball"><ref id="m"/></shape>')
    assert scene.surfaces[0].material.albedo == 0.3 and scene.surfaces[0].name == "ball" and scene.name == "a"


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ('<include filename="a.xml"/>', "includes itself"),
        ('<include filename="b.xml"/>', "includes itself"),
        ('<include filename="../out.xml"/>', "outside the scene's folder"),
        ('<include filename="link.xml"/>', "outside the scene's folder"),
        ('<include filename="none.xml"/>', "not found"),
        ("<include/>", 'lacks filename="..."'),
        ('<default name="x"/>', 'lacks value="..."'),
        ('<shape type="$kind"/>', "$kind has no value"),
        ('<alias id="none" as="x"/>', "unknown id 'none'"),
        ('<bsdf type="diffuse" id="a"/><bsdf type="diffuse" id="a"/>', "given twice"),
    ],
)
def test_bad_includes_and_names_are_refused(tmp_path: Path, body: str, words: str) -> None:
    folder = tmp_path / "scene"
    folder.mkdir()
    write(tmp_path, RECTANGLE, sensor="", name="out.xml")
    (folder / "link.xml").symlink_to(tmp_path / "out.xml")
    path = write(folder, body)
    write(folder, '<include filename="a.xml"/>', sensor="", name="b.xml")
    with pytest.raises(InputError) as error:
        load_mitsuba_xml(path)
    assert words in str(error.value) and "\n" not in str(error.value) and str(error.value).startswith(str(folder))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<scene version='3.0.0'>\n<shape></scene>", "broken XML, line 2"),
        ("", "broken XML, line 1"),
        ("<?xml version='1.0' encoding='none'?><scene/>", "broken XML"),
        ("<scene/>", "version=None"),
        ("<scene version='9.0.0'/>", "version='9.0.0'"),
        ("<shape version='3.0.0' type='sphere'/>", "outermost element is <shape>"),
        ("<!DOCTYPE scene [<!ENTITY a 'b'>]><scene version='3.0.0'>&a;</scene>", "DOCTYPE"),
        ("<!DOCTYPE scene SYSTEM 'x.dtd'><scene version='3.0.0'/>", "DOCTYPE"),
        ("<scene version='3.0.0'>&a;</scene>", "undefined entity"),
    ],
)
def test_broken_files_are_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "a.xml"
    path.write_text(text)
    for encoding in ("utf-8", "utf-16"):
        path.write_bytes(text.encode(encoding))
        with pytest.raises(InputError) as error:
            load_mitsuba_xml(path)
        assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)
        if encoding == "utf-8":
            assert words in str(error.value)


def test_missing_file_and_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.xml", tmp_path):
        with pytest.raises(InputError, match=r"not found|cannot be read"):
            load_mitsuba_xml(path)


# --- the artist's scene -------------------------------------------------------------------------------------------


def test_artists_living_room() -> None:
    if not LIVING_ROOM.is_file():
        pytest.skip(
            f"{LIVING_ROOM.name} of the artist's living room is not there; set SCENE2SPAD_DATA to its data folder"
        )
    scene = load_mitsuba_xml(LIVING_ROOM)
    camera = scene.camera
    assert (len(scene.surfaces), camera.fov_deg, camera.width, camera.height) == (65, 90, 1280, 720)
    assert scene.name == "living-room"
    # The third column of the file's matrix is the viewing direction, the first its left.
    np.testing.assert_allclose(camera.rotation[:, 2], (-0.961792, 0.074407, 0.263476), atol=1e-5)
    np.testing.assert_allclose(camera.rotation[:, 0], (-0.264209, 0, -0.964465), atol=1e-5)
    leaves = [surface for surface in scene.surfaces if surface.material.name == "Leaves"]
    assert len(leaves) > 1 and len({id(leaf.material) for leaf in leaves}) == 1
    opacity = leaves[0].material.opacity
    assert isinstance(opacity, Texture) and opacity.image.min() == 0 and opacity.image.max() == 1
    assert scene.ambient.environment is not None and scene.ambient.environment.image.shape == (1024, 2048)
    assert {s.material.kind for s in scene.surfaces} >= {"dielectric", "conductor", "roughconductor", "roughplastic"}
    assert all(surface.uv is not None for surface in scene.surfaces)
    assert len(scene.notes) == 1 and "nonlinear" in scene.notes[0]
