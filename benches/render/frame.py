"""The scene at the moment of one image: its picture and its depth."""

import math

import numpy as np

from .camera import sensed
from .indoor_shading import shade_indoors
from .materials import LEAF, MIRRORS, ROCK, WALL, WATER, WINDOW
from .noise import noise3_grid
from .outdoor_shading import shade_outdoors
from .rays import Moving, Rays, static_part, surface_at

# Rays that are cast at a time, four to a pixel.
PIXELS_AT_ONCE = 180_000
# Depth beyond this many metres is that of the sky.
FARTHEST = 190


class Frame:
    def __init__(self, scene, seed, index, of):
        self.scene = scene
        self.rng = rng = np.random.default_rng([seed, 77, index])
        surface = scene.surface
        self.static, self.moving = static_part(surface), swayed(scene.leaves, rng)
        self.rays = Rays(surface.vertices, surface.faces, self.moving.triangles)
        self.shadow_rays = self.casting_shadow() if scene.indoors else self.rays
        azimuth, move, elevation = scene.layout.sun
        az, el = math.radians(azimuth + move * index / max(1, of)), math.radians(elevation)
        self.sun = np.array([math.cos(el) * math.sin(az), math.cos(el) * math.cos(az), math.sin(el)])
        blades = rng.normal(0, 1, 2)
        self.texture = scene.texture if scene.indoors else scene.texture._replace(blades=blades)
        self.ripple = rng.uniform(0, 1000, 2)
        self.exposure = 0.42 * (1 + 0.06 * float(np.clip(rng.normal(), -2, 2)))
        self.white = 1 + 0.012 * rng.normal(0, 1, 3)

    def casting_shadow(self):
        """Furniture up to 3 m; the lamp shines through the walls."""
        surface = self.scene.surface
        low = surface.vertices[surface.faces, 2].max(1) < 3
        return Rays(surface.vertices, surface.faces[(surface.materials < WALL) & low])

    def colour(self, origins, directions, spacing, travelled=0.0, mirrored=False):
        """Linear colour that comes along rays; what mirrors is followed once."""
        hits = self.rays.hits(origins, directions)
        found = surface_at(hits, origins, directions, self.static, self.moving)
        distances = np.where(found.material >= 0, hits["tfar"], 0).astype(np.float32) + np.float32(travelled)
        mirrors = np.nonzero(np.isin(found.material, MIRRORS))[0]
        self.add_ripples(found)
        light = np.zeros((len(directions), 3), np.float32)
        shade = shade_indoors if self.scene.indoors else shade_outdoors
        shade(found, directions, distances, self.sun_seen(found), spacing, self.sun, self.texture, light)
        if len(mirrors) and not mirrored:
            self.add_mirrored(light, found, mirrors, directions, distances, spacing)
        return light

    def add_ripples(self, found):
        """On water, other ones in each image."""
        wet = found.material == WATER
        if not wet.any():
            return
        q = found.place[wet] + np.array([self.ripple[0], self.ripple[1], 0], np.float32)
        slope = np.zeros((len(q), 2))
        for frequency, salt in ((1.7, 0), (4.1, 1), (9.7, 2)):
            slope[:, 0] += noise3_grid(q, frequency, salt)
            slope[:, 1] += noise3_grid(q, frequency, salt + 9)
        found.normal[wet, :2] += 0.011 * slope
        found.normal[wet] /= np.linalg.norm(found.normal[wet], axis=1, keepdims=True)

    def sun_seen(self, found):
        """1 where the sun is visible; its disc is a little larger than the real one."""
        seen, hit = np.zeros(len(found.material), np.float32), np.nonzero(found.material >= 0)[0]
        towards = (self.sun + self.rng.normal(0, 0.004, (len(hit), 3))).astype(np.float32)
        normal, material = found.normal[hit], found.material[hit]
        side = np.sign((normal * self.sun.astype(np.float32)).sum(1, keepdims=True))
        lift = (0.004 + 0.006 * (material <= ROCK))[:, None].astype(np.float32)
        # Leaves are lit from both sides.
        start = found.place[hit] + lift * normal * np.where(material == LEAF, side[:, 0], 1)[:, None].astype(np.float32)
        seen[hit] = self.shadow_rays.free(start, towards)
        return seen

    def add_mirrored(self, light, found, mirrors, directions, distances, spacing):
        """By Schlick's approximation of Fresnel's equations, with a highlight where the sun is."""
        d, normal, material = directions[mirrors], found.normal[mirrors], found.material[mirrors]
        cosine = np.abs((d * normal).sum(1))
        away = d + 2 * cosine[:, None] * normal
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        away = away.astype(np.float32)
        start = found.place[mirrors] + np.float32(0.01) * normal
        seen = self.colour(start, away, spacing, distances[mirrors], mirrored=True)
        straight = np.where(material == WATER, 0.02, np.where(material == WINDOW, 0.07, 0.045))
        share = (straight + (1 - straight) * (1 - cosine) ** 5)[:, None]
        seen += (20 * ((away * self.sun).sum(1) > 0.9994))[:, None] * (np.sum(seen, 1) > 1)[:, None]
        light[mirrors] = light[mirrors] * (1 - share) + (share * seen).astype(np.float32)

    def picture(self, camera, view):
        """8-bit RGB, four rays to a pixel."""
        light = np.zeros((camera.height, camera.width, 3), np.float32)
        rows = max(1, PIXELS_AT_ONCE // camera.width)
        for top in range(0, camera.height, rows):
            bottom = min(camera.height, top + rows)
            light[top:bottom] = self.rows(camera, view, top, bottom)
        return sensed(light, camera, self.exposure, self.white, self.rng)

    def rows(self, camera, view, top, bottom):
        Y, X, half_y, half_x = np.meshgrid(np.arange(top, bottom), np.arange(camera.width), (0, 1), (0, 1), indexing="ij")
        x = X + (half_x + self.rng.random(X.shape)) * 0.5
        y = Y + (half_y + self.rng.random(X.shape)) * 0.5
        d = camera.directions(x, y) @ view.rotation
        d = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
        origins = np.broadcast_to(view.centre.astype(np.float32), d.shape).copy()
        return self.colour(origins, d, 0.5 / camera.focal).reshape(bottom - top, camera.width, 4, 3).mean(2)

    def depth(self, camera, view):
        """z-depth and class (see depth_file) at half the size, one ray through the centre of each pixel."""
        # Not of unit length: the ray parameter is the z-depth.
        hits = self.rays.from_point(view.centre, (camera.half_size_directions() @ view.rotation).astype(np.float32))
        face, static = hits["primID"], hits["geomID"] == 0
        material = np.where(static, self.static.materials[np.maximum(face, 0) * static], LEAF)
        of = np.where(face < 0, 0, np.where(material == LEAF, 2, np.where(material == WATER, 3, 1))).astype(np.uint8)
        z = np.where((of == 1) | (of == 3), hits["tfar"], 0)
        far = z > FARTHEST
        of[far] = 0
        z[far] = 0
        shape = camera.height // 2, camera.width // 2
        return z.reshape(shape), of.reshape(shape)


def swayed(leaves, rng):
    """Plants sway as a whole, and each leaf moves and bends a little."""
    sway = rng.normal(0, 0.035, (int(leaves.plant.max()) + 1, 3)) * [1, 1, 0.25]
    tri = leaves.triangles + (sway[leaves.plant] * leaves.height[:, None])[:, None].astype(np.float32)
    moved = rng.normal(0, 0.010, (len(tri), 1, 3)).astype(np.float32)
    tri = tri + moved + rng.normal(0, 0.006, tri.shape).astype(np.float32)
    n = np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0])
    n /= np.linalg.norm(n, axis=1, keepdims=True) + 1e-12
    same_side = np.sign((n * leaves.normals).sum(1, keepdims=True) + 1e-9)
    normals = (0.6 * n * same_side + 0.4 * leaves.normals).astype(np.float32)
    texture = np.stack([leaves.plant, np.arange(len(tri))], 1).astype(np.float32)
    return Moving(tri, normals, texture, leaves.shade)
