"""Triangle meshes and the bodies that scenes are put together from. Texture coordinates are in metres."""

import math

import numpy as np

from .materials import STONE
from .noise import noise3_grid

UP = np.array([0, 0, 1.0])


class Mesh:
    """Triangles collected in parts, each with a material and the number of an object (which colours it)."""

    def __init__(self):
        self.vertices, self.faces, self.normals, self.texture, self.materials, self.objects = [], [], [], [], [], []
        self.count = 0
        self.object_count = 0

    def new_object(self):
        self.object_count += 1
        return self.object_count - 1

    def add(self, vertices, faces, material, normals=None, texture=None, obj=None):
        """Without normals the faces are flat and share no vertices."""
        vertices, faces = np.asarray(vertices, float), np.asarray(faces, np.int64)
        if normals is None:
            if texture is not None:
                texture = np.asarray(texture, float)[faces].reshape(-1, 2)
            vertices = vertices[faces].reshape(-1, 3)
            faces = np.arange(len(vertices)).reshape(-1, 3)
            normals = flat_normals(vertices)
        texture = vertices[:, :2] if texture is None else np.asarray(texture, float)
        obj = self.new_object() if obj is None else obj
        self.vertices.append(vertices)
        self.faces.append(faces + self.count)
        self.normals.append(normals)
        self.texture.append(texture)
        self.materials.append(np.full(len(faces), material, np.int32))
        self.objects.append(np.broadcast_to(np.asarray(obj, np.int64), (len(faces),)).astype(np.int32))
        self.count += len(vertices)

    def whole(self):
        return Surface(self)


class Surface:
    """The static mesh as arrays. `sky` (share of the sky that each vertex sees) is filled in by rays.bake_sky."""

    def __init__(self, mesh):
        self.vertices = np.concatenate(mesh.vertices).astype(np.float32)
        self.faces = np.concatenate(mesh.faces).astype(np.int32)
        self.normals = np.concatenate(mesh.normals).astype(np.float32)
        self.texture = np.concatenate(mesh.texture).astype(np.float32)
        self.materials = np.concatenate(mesh.materials)
        self.objects = np.concatenate(mesh.objects)
        self.sky = None


def flat_normals(vertices):
    """Of triangles that share no vertices, once for each vertex."""
    n = np.cross(vertices[1::3] - vertices[0::3], vertices[2::3] - vertices[0::3])
    n /= np.linalg.norm(n, axis=1, keepdims=True) + 1e-20
    return np.repeat(n, 3, 0)


def smooth_normals(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    n = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], n)
    return normals / (np.linalg.norm(normals, axis=1, keepdims=True) + 1e-20)


def grid_faces(rows, columns):
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def heading(angle):
    """Unit vectors along and to the left of a direction in the plane, radians from x."""
    return np.array([math.cos(angle), math.sin(angle), 0]), np.array([-math.sin(angle), math.cos(angle), 0])


ICOSAHEDRON = (
    (0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6), (7, 1, 8),
    (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1),
)  # fmt: skip


def icosphere(divisions):
    """Unit sphere from an icosahedron whose faces are cut into four, `divisions` times."""
    t = (1 + 5**0.5) / 2
    corners = [(-1, t, 0), (1, t, 0), (-1, -t, 0), (1, -t, 0), (0, -1, t), (0, 1, t)]
    corners += [(0, -1, -t), (0, 1, -t), (t, 0, -1), (t, 0, 1), (-t, 0, -1), (-t, 0, 1)]
    vertices = [np.array(v) / np.linalg.norm(v) for v in corners]
    faces = list(ICOSAHEDRON)
    for _ in range(divisions):
        faces = quartered(vertices, faces)
    return np.array(vertices), np.array(faces)


def quartered(vertices, faces):
    """Each face as four; the new vertices are appended."""
    middles = {}

    def middle(a, b):
        key = (min(a, b), max(a, b))
        if key not in middles:
            p = vertices[a] + vertices[b]
            vertices.append(p / np.linalg.norm(p))
            middles[key] = len(vertices) - 1
        return middles[key]

    cut = []
    for a, b, c in faces:
        x, y, z = middle(a, b), middle(b, c), middle(c, a)
        cut += [(a, x, z), (b, y, x), (c, z, y), (x, y, z)]
    return cut


def add_boulder(mesh, place, size, salt, rng):
    sphere, faces = icosphere(3)
    body = sphere * np.array([rng.uniform(0.8, 1.3), rng.uniform(0.7, 1.1), rng.uniform(0.5, 0.85)])
    bumps = 0.35 * noise3_grid(sphere * 1.0 + 7 * salt, 1.1, salt)
    bumps = 1 + bumps + 0.12 * noise3_grid(sphere, 3.0, salt + 1) + 0.05 * noise3_grid(sphere, 7.0, salt + 2)
    body = body * bumps[:, None] * size
    a = rng.uniform(0, 6.3)
    turn = np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
    body = body @ turn.T + place
    mesh.add(body, faces, STONE, smooth_normals(body, faces))


SQUARE = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def add_box(mesh, centre, axes, half, material, obj=None):
    """A box along three unit axes with half sizes along them."""
    centre = np.asarray(centre, float)
    axes = [np.asarray(axis, float) for axis in axes]
    obj = mesh.new_object() if obj is None else obj
    for a in range(3):
        b, d = (a + 1) % 3, (a + 2) % 3
        # The second texture axis is the up axis where there is one.
        if a < 2 and d != 2:
            b, d = d, b
        for side in (-1, 1):
            corners = [centre + side * half[a] * axes[a] + x * half[b] * axes[b] + y * half[d] * axes[d] for x, y in SQUARE]
            faces = np.array([(0, 1, 2), (0, 2, 3)])
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            if np.dot(normal, side * axes[a]) < 0:
                faces = faces[:, ::-1]
            mesh.add(corners, faces, material, texture=[(x * half[b], y * half[d]) for x, y in SQUARE], obj=obj)


def add_tube(mesh, points, radii, sides, material, caps=True):
    """A tube along points with a radius at each; `caps` closes its end."""
    points = np.asarray(points, float)
    radii = np.broadcast_to(radii, (len(points),))
    vertices, normals, texture, length = [], [], [], 0
    for i in range(len(points)):
        a, b = across(points, i)
        if i:
            length += np.linalg.norm(points[i] - points[i - 1])
        for k in range(sides + 1):
            w = 2 * math.pi * k / sides
            n = math.cos(w) * a + math.sin(w) * b
            vertices.append(points[i] + radii[i] * n)
            normals.append(n)
            texture.append((w * radii[0], length))
    obj = mesh.new_object()
    mesh.add(vertices, tube_faces(len(points), sides), material, normals=np.array(normals), texture=texture, obj=obj)
    if caps:
        end = slice((len(points) - 1) * (sides + 1), (len(points) - 1) * (sides + 1) + sides)
        fan = [(0, k, k + 1) for k in range(1, sides - 1)]
        mesh.add(np.array(vertices[end]), fan, material, texture=np.array(texture[end]) * [1, 0], obj=obj)


def across(points, i):
    """Two unit vectors across a line through points, at one of them."""
    t = points[min(i + 1, len(points) - 1)] - points[max(i - 1, 0)]
    t /= np.linalg.norm(t)
    a = np.cross(t, np.array([0.31, 0.17, 0.93]) if abs(t[2]) < 0.9 else np.array([1.0, 0.2, 0.1]))
    a /= np.linalg.norm(a)
    return a, np.cross(t, a)


def tube_faces(rings, sides):
    faces = []
    for i in range(rings - 1):
        for k in range(sides):
            a = i * (sides + 1) + k
            b = a + sides + 1
            faces += [(a, a + 1, b + 1), (a, b + 1, b)]
    return faces


def add_panel(mesh, corner, along, up, size, material, step):
    """A flat rectangle of a grid of triangles with edges of about `step` metres."""
    along, up = np.asarray(along, float), np.asarray(up, float)
    u, v = (np.linspace(0, length, max(2, int(round(length / step)) + 1)) for length in size)
    U, V = np.meshgrid(u, v)
    vertices = np.asarray(corner, float) + U.reshape(-1, 1) * along + V.reshape(-1, 1) * up
    normals = np.tile(np.cross(along, up), (len(vertices), 1))
    texture = np.stack([U.ravel(), V.ravel()], 1)
    mesh.add(vertices, grid_faces(len(v), len(u)), material, normals=normals, texture=texture)


def add_turned(mesh, place, heights, radii, material, rings=30, sides=40):
    """A body turned on a lathe: heights and radii of its outline."""
    from scipy.interpolate import PchipInterpolator

    z = np.linspace(heights[0], heights[-1], rings)
    r = PchipInterpolator(heights, radii)(z)
    w = np.linspace(0, 2 * math.pi, sides + 1)
    ring = np.broadcast_to(z[:, None], (rings, sides + 1))
    vertices = np.stack([r[:, None] * np.cos(w), r[:, None] * np.sin(w), ring], -1).reshape(-1, 3) + place
    faces = grid_faces(rings, sides + 1)
    texture = np.stack([np.tile(w * max(radii), rings), np.repeat(z, sides + 1)], 1)
    mesh.add(vertices, faces, material, smooth_normals(vertices, faces), texture=texture)
