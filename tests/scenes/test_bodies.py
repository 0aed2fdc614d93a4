"""Which sides of a mesh's faces light from a point may reach."""

from __future__ import annotations

import numpy as np
import pytest

from scenes.geometry.bodies import visible_sides
from scenes.geometry.shapes import box, sphere

OUTSIDE, INSIDE = np.array((3.0, -2.0, 5.0)), np.array((0.1, 0.2, -0.1))


@pytest.mark.parametrize("turned", [False, True])
def test_a_closed_body_shows_its_outer_sides_outside_and_its_inner_ones_inside(turned):
    for vertices, faces, _ in (box((1.0, 2.0, 3.0)), sphere(1.0, 2)):
        faces = faces[:, ::-1] if turned else faces
        corners = vertices[faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        outwards = np.sign((normal * corners.mean(axis=1)).sum(axis=1))
        assert (visible_sides(vertices, faces, OUTSIDE) == outwards).all()
        assert (visible_sides(vertices, faces, INSIDE) == -outwards).all()


def test_open_and_flat_bodies_show_both_sides():
    vertices, faces, _ = box((1.0, 1.0, 1.0))
    assert not visible_sides(vertices, faces[1:], OUTSIDE).any()
    sheet = faces[:2]
    assert not visible_sides(vertices, np.concatenate((sheet, sheet[:, ::-1])), OUTSIDE).any()
    wrong = np.concatenate((faces[:1, ::-1], faces[1:]))
    assert not visible_sides(vertices, wrong, OUTSIDE).any()


def test_a_point_on_a_body_is_neither_outside_nor_inside():
    vertices, faces, _ = box((1.0, 1.0, 1.0))
    for point in ((0.5, 0.1, 0.2), (0.5, 0.5, 0.1), (0.5, 0.5, 0.5)):
        assert not visible_sides(vertices, faces, np.array(point)).any()
    for off in (1e-5, -1e-5):
        assert visible_sides(vertices, faces, np.array((0.5 + off, 0.1, 0.2))).all()


def test_bodies_of_one_mesh_are_told_apart():
    vertices, faces, _ = box((1.0, 1.0, 1.0))
    both = np.concatenate((vertices, vertices + (4, 0, 0)))
    joined = np.concatenate((faces, faces[:, ::-1] + len(vertices)))
    sides = visible_sides(both, joined, np.array((4.0, 0, 0)))
    first, second = sides[: len(faces)], sides[len(faces) :]
    assert (first == first[0]).all() and (second == second[0]).all() and abs(first[0]) == 1 and first[0] == second[0]
    assert not visible_sides(both, np.concatenate((joined[:-1], joined[:1])), OUTSIDE)[len(faces) :].any()
