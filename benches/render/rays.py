"""Rays against the meshes by Embree, the surface at their hits, and the share of the sky that each vertex sees."""

import math
from collections import namedtuple

import numpy as np

from .materials import LEAF
from .noise import shading

# The surface at the hits, in arrays over rays; material -1 where a ray hit nothing.
Hits = namedtuple("Hits", "place normal texture material obj sky")
Static = namedtuple("Static", "vertices faces normals texture materials objects sky")
Moving = namedtuple("Moving", "triangles normals texture shade")


class Rays:
    """A static mesh (geometry 0) and leaves (geometry 1)."""

    def __init__(self, vertices, faces, leaves=None):
        from embreex import mesh_construction, rtcore_scene

        self.scene = rtcore_scene.EmbreeScene()
        mesh_construction.TriangleMesh(self.scene, np.ascontiguousarray(vertices), np.ascontiguousarray(faces))
        if leaves is not None:
            mesh_construction.TriangleMesh(self.scene, np.ascontiguousarray(leaves))

    def hits(self, origins, directions):
        """primID (-1: none), geomID, u, v, tfar of each ray."""
        return self.scene.run(origins, directions, output=1)

    def from_point(self, origin, directions):
        return self.hits(np.broadcast_to(origin.astype(np.float32), directions.shape).copy(), directions)

    def free(self, origins, directions):
        return self.scene.run(origins, directions, query="OCCLUDED") < 0

    def free_within(self, origins, directions, reach):
        return self.scene.run(origins, directions, dists=np.full(len(origins), reach, np.float32)) < 0


def static_part(surface):
    return Static(*(getattr(surface, name) for name in Static._fields))


def surface_at(hits, origins, directions, static, moving):
    """The surface where the rays meet it, normals towards the viewer."""
    n = len(directions)
    found = Hits(*(np.zeros((n, k), np.float32) for k in (3, 3, 2)), np.empty(n, np.int32), np.zeros(n, np.int32), np.ones(n, np.float32))
    at = (hits["u"], hits["v"], hits["tfar"])
    gather(hits["primID"], hits["geomID"], at, origins, directions, static, moving, found)
    return found


@shading
def gather(primitive, geometry, at, origins, directions, static, moving, out):
    for i in range(primitive.shape[0]):
        p = primitive[i]
        if p < 0:
            out.material[i] = -1
            continue
        d = directions[i]
        for k in range(3):
            out.place[i, k] = origins[i, k] + at[2][i] * d[k]
        if geometry[i] == 0:
            gather_static(i, p, at[0][i], at[1][i], d, static, out)
        else:
            facing = moving.normals[p, 0] * d[0] + moving.normals[p, 1] * d[1] + moving.normals[p, 2] * d[2]
            side = -1.0 if facing > 0 else 1.0
            for k in range(3):
                out.normal[i, k] = side * moving.normals[p, k]
            out.texture[i, 0] = moving.texture[p, 0]
            out.texture[i, 1] = moving.texture[p, 1]
            out.sky[i] = moving.shade[p]
            out.material[i] = LEAF
            out.obj[i] = 0
        q = 1 / math.sqrt(out.normal[i, 0] ** 2 + out.normal[i, 1] ** 2 + out.normal[i, 2] ** 2 + 1e-20)
        for k in range(3):
            out.normal[i, k] *= q


@shading
def gather_static(i, p, u, v, d, static, out):
    w = 1 - u - v
    a = static.faces[p, 0]
    b = static.faces[p, 1]
    c = static.faces[p, 2]
    V = static.vertices
    e1x = V[b, 0] - V[a, 0]
    e1y = V[b, 1] - V[a, 1]
    e1z = V[b, 2] - V[a, 2]
    e2x = V[c, 0] - V[a, 0]
    e2y = V[c, 1] - V[a, 1]
    e2z = V[c, 2] - V[a, 2]
    facing = (e1y * e2z - e1z * e2y) * d[0] + (e1z * e2x - e1x * e2z) * d[1] + (e1x * e2y - e1y * e2x) * d[2]
    side = -1.0 if facing > 0 else 1.0
    N = static.normals
    T = static.texture
    for k in range(3):
        out.normal[i, k] = side * (w * N[a, k] + u * N[b, k] + v * N[c, k])
    for k in range(2):
        out.texture[i, k] = w * T[a, k] + u * T[b, k] + v * T[c, k]
    out.sky[i] = w * static.sky[a] + u * static.sky[b] + v * static.sky[c]
    out.material[i] = static.materials[p]
    out.obj[i] = static.objects[p]


def bake_sky(surface, leaves, rays, reach):
    """Share of the sky that each vertex sees, weighted by the cosine, where what is farther than `reach` metres hides nothing."""
    scene, rng = Rays(surface.vertices, surface.faces, leaves), np.random.default_rng(5)
    normals = surface.normals.copy()
    seen, origins = np.zeros(len(normals), np.float32), surface.vertices + 0.02 * normals
    for k in range(rays):
        angle = rng.uniform(0, 6.2832, len(normals))
        r2 = (k + rng.random(len(normals))) / rays
        v = np.stack([np.sqrt(r2) * np.cos(angle), np.sqrt(r2) * np.sin(angle), np.sqrt(1 - r2)], 1)
        t = np.cross(normals, [0.3, 0.9, 0.1])
        t /= np.linalg.norm(t, axis=1, keepdims=True) + 1e-9
        b = np.cross(normals, t)
        directions = (v[:, :1] * t + v[:, 1:2] * b + v[:, 2:] * normals).astype(np.float32)
        seen += scene.free_within(origins, directions, reach)
    surface.sky = seen / rays
