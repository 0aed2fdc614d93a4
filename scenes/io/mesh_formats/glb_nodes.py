"""Put the nodes of a GLB as trimesh reads them rightly: primitives, skins, and nodes that are invisible, or scaled to
nothing."""

from __future__ import annotations

import numpy as np

from scenes.errors import InputError, listed, require
from scenes.io.mesh_formats import NotReadError
from scenes.io.mesh_formats.glb_coordinates import FLOAT, accessor_numbers
from scenes.json_types import JsonObject

VISIBILITY = "KHR_node_visibility"
LIGHTS = "KHR_lights_punctual"
_FLAT = 1e-9  # shortest to longest axis of a unit sphere under a transform, below which a body is squashed flat
_ALIKE = 1e-5  # relative difference of joints' transforms: inverse bind matrices are in single precision


def plain_nodes(header: JsonObject, binary: bytes) -> list[str]:
    """Change the nodes of a GLB to what trimesh reads rightly; return notes on what is left out.

    - Every primitive has a node of its own, named by its number: trimesh names it by chance.
    - Cameras go: trimesh drops the mesh of a node that has one, and what hangs below it.
    - A mesh with a skin stands where its joints place it, not where its own node does (glTF 2.0, 3.7.3.3).
    - A mesh that is scaled to nothing, as files hide one, is left out, and one of a node that is invisible or hangs
      below an invisible one.

    Raises NotReadError where nothing is left then.
    """
    nodes, meshes = header.get("nodes", []), header.get("meshes", [])
    shown, worlds = _worlds(header)
    invisible = _invisible(nodes)
    hidden, unseen, posed, morphed = [], [], [], []
    cameras, lights = list[str](), list[str]()
    parts: dict[int, list[int]] = {}
    for number in shown:
        node = nodes[number]
        label = str(node.get("name", number))
        cameras += [label] * (node.pop("camera", None) is not None)
        lights += [label] * (LIGHTS in node.get("extensions", {}) and number not in invisible)
        if "mesh" not in node:
            continue
        mesh = meshes[node["mesh"]]
        if number in invisible:
            unseen.append(label)
            del node["mesh"]
            continue
        world = worlds[number]
        if "skin" in node:
            world, alike = _skin(header, binary, node["skin"], worlds)
            posed += [] if alike else [label]
        if _is_flat(world):
            hidden.append(label)
            del node["mesh"]
            continue
        weights = node.get("weights", mesh.get("weights", []))
        if any(weights) and any(one.get("targets") for one in mesh["primitives"]):
            morphed.append(label)
        if "skin" in node:
            node = _lifted(header, node, label, world)
        _split(header, node, label, parts)
    if (hidden or unseen) and not parts:
        how = " or ".join(["scaled to nothing by their nodes"] * bool(hidden) + ["invisible"] * bool(unseen))
        raise NotReadError(f"all its meshes are {how}: {listed(hidden + unseen)}")
    lines = (
        (f"invisible by {VISIBILITY} and left out", unseen),
        ("scaled to nothing by their nodes and left out", hidden),
        ("the pose of a skin is left out, the first joint alone places the mesh", posed),
        ("morph targets are left out, meshes are as without", morphed),
        ("cameras are left out, a view is stated beside the file (--from, --look-at, --fov)", cameras),
        (f"lights of {LIGHTS} are left out", lights),
    )
    return [f"{words}: {listed(names)}" for words, names in lines if names]


def _invisible(nodes: list[JsonObject]) -> set[int]:
    """Return the numbers of the nodes that are invisible: those that say so, and all that hang below them."""
    pending = [number for number, node in enumerate(nodes) if _says_invisible(node)]
    found: set[int] = set()
    while pending:
        number = pending.pop()
        if number not in found:
            found.add(number)
            pending += nodes[number].get("children", [])
    return found


def _says_invisible(node: JsonObject) -> bool:
    return node.get("extensions", {}).get(VISIBILITY, {}).get("visible", True) is False


def _worlds(header: JsonObject) -> tuple[list[int], dict[int, np.ndarray]]:
    """Return the numbers of the nodes that the scene shows, and the transforms of all nodes to the world."""
    nodes, scenes = header.get("nodes", []), header.get("scenes", [])
    roots = scenes[header.get("scene", 0)].get("nodes", []) if scenes else []
    children = {child for node in nodes for child in node.get("children", [])}
    others = [number for number in range(len(nodes)) if number not in children]
    worlds: dict[int, np.ndarray] = {}
    shown = 0
    for starts in (roots, others):
        pending = [(number, np.eye(4)) for number in reversed(starts)]
        while pending:
            number, above = pending.pop()
            if number not in worlds:
                worlds[number] = above @ _local(nodes[number])
                pending += [(child, worlds[number]) for child in reversed(nodes[number].get("children", []))]
        shown = len(worlds) if starts is roots else shown
    return [*worlds][:shown], worlds


def _local(node: JsonObject) -> np.ndarray:
    """Return a node's own transform: its matrix, else translation, rotation and scale."""
    if "matrix" in node:
        return np.reshape(np.array(node["matrix"], np.float64), (4, 4)).T
    matrix = np.eye(4)
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    length = x * x + y * y + z * z + w * w
    if length > 0:
        cross = np.array([(0, -z, y), (z, 0, -x), (-y, x, 0)])
        matrix[:3, :3] += 2 / length * (w * cross + cross @ cross)
    matrix[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _is_flat(matrix: np.ndarray) -> bool:
    """Return whether a transform squashes bodies to a sheet, a line or a point."""
    if not np.isfinite(matrix).all():
        return False  # is refused elsewhere
    axes = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    return bool(axes[2] <= _FLAT * axes[0])


def _skin(header: JsonObject, binary: bytes, number: int, worlds: dict[int, np.ndarray]) -> tuple[np.ndarray, bool]:
    """Return where a skin's first joint places a mesh, and whether all of its joints do so alike.

    Where they do, as in the pose that the mesh was bound in, that is the whole of skinning: weights add up to 1.
    """
    skin = header["skins"][number]
    joints = np.array([worlds[joint] for joint in skin["joints"]])
    if "inverseBindMatrices" in skin:
        inverse = _matrices(header, binary, skin["inverseBindMatrices"], len(joints))
        if inverse is None:
            return joints[0], False
        joints = joints @ inverse
    size = np.abs(joints[0]).max()
    return joints[0], bool(np.abs(joints - joints[0]).max() <= _ALIKE * size)


def _matrices(header: JsonObject, binary: bytes, number: int, count: int) -> np.ndarray | None:
    """Read `count` matrices of an accessor; None where they are not plain numbers of the file itself."""
    accessor = header["accessors"][number]
    kind = accessor["componentType"], accessor["type"]
    require(
        kind == (FLOAT, "MAT4"),
        f"inverse bind matrices are {kind[1]} of component type {kind[0]}, expected MAT4 of {FLOAT}",
    )
    require(count <= accessor["count"], "inverse bind matrices are cut short")
    try:
        rows = accessor_numbers(header, binary, number)
    except InputError as error:
        raise InputError(f"inverse bind matrices are cut short ({error})") from None
    return None if rows is None else rows[:count].reshape(-1, 4, 4).transpose(0, 2, 1)


def _lifted(header: JsonObject, node: JsonObject, label: str, world: np.ndarray) -> JsonObject:
    """Move a node's mesh to a new root node, which is returned; the node stays for what hangs below it."""
    root = {"name": label, "mesh": node.pop("mesh"), "matrix": world.T.ravel().tolist()}
    node["name"] = f"{label} without its skin"
    header["nodes"].append(root)
    header["scenes"][header.get("scene", 0)]["nodes"].append(len(header["nodes"]) - 1)
    return root


def _split(header: JsonObject, node: JsonObject, label: str, parts: dict[int, list[int]]) -> None:
    """Give each of the several primitives of a node's mesh a node and a mesh of its own; `parts` of those done."""
    meshes, nodes, number = header["meshes"], header["nodes"], node["mesh"]
    mesh = meshes[number]
    if number not in parts:
        first = len(meshes)
        meshes += [{**mesh, "primitives": [primitive]} for primitive in mesh["primitives"][1:]]
        parts[number] = [number, *range(first, len(meshes))]
        mesh["primitives"] = mesh["primitives"][:1]
    if len(parts[number]) > 1:
        del node["mesh"]
        first = len(nodes)
        nodes += [{"name": f"{label}_{i}", "mesh": part} for i, part in enumerate(parts[number])]
        node["children"] = [*node.get("children", []), *range(first, len(nodes))]
