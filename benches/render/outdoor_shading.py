"""Colour of points outdoors: sun, sky with baked occlusion, light from the ground."""

import math

import numpy as np

from .materials import BARK, BOARD, LEAF, PAINT, PLASTER, ROCK, ROOF, STONE, TERRAIN, WATER, WINDOW, WOOD
from .noise import clamp01, fbm2, kernel, noise2, noise3, octave_weight, polyline_distance, rnd3, shading, step01, worley2
from .textures import grass_colour, gravel_colour, rock_colour, sky


@kernel
def gravel_share(x, y, e1, e2, site):
    """1 on the path; with a soft, winding edge where it is not paved."""
    if site.paved:
        d = polyline_distance(x, y, site.path) - site.path_half
        return 1.0 if d < 0 else 0.0
    d = polyline_distance(x, y, site.path) - site.path_half + 0.28 * e1 + 0.10 * e2
    return 1 - step01(-0.12, 0.16, d)


@kernel
def mud_share(x, y, e1, e2, site):
    """1 at the shore of the pond."""
    u = abs((x - site.pond_x) / site.mud_along) ** site.pond_power
    v = abs((y - site.pond_y) / site.pond_across) ** site.pond_power
    return 1 - step01(1.02, 1.16, (u + v) ** (1 / site.pond_power) + 0.05 * e1 + 0.02 * e2)


@kernel
def bare_share(x, y, steep, e1, e2, mud, site):
    """1 where nothing grows: worn, around huts, on slopes, in mud."""
    worn = fbm2(x * 0.23 + 11, y * 0.23, 4, site.salt + 60) + 0.12 * e1 + 0.10 * e2
    bare = step01(0.25, 0.40, worn - 0.22 * site.grass + 0.35 * (1 - site.grass))
    for q in range(site.pads.shape[0]):
        pad = site.pads[q]
        a = pad[2] * (x - pad[0]) + pad[3] * (y - pad[1])
        b = -pad[3] * (x - pad[0]) + pad[2] * (y - pad[1])
        d = max(abs(a) - pad[4], abs(b) - pad[5])
        bare = max(bare, 1 - step01(0.35, 0.75, d + 0.15 * e1 + 0.1 * e2))
    bare = max(bare, 1 - step01(0.72, 0.80, steep + 0.05 * e1))
    return max(bare, mud)


@kernel
def slab_light(x, y, e1, e2, foot):
    """Concrete slabs, nearly without texture."""
    jx = abs((0.8 * x + 0.6 * y) / 0.9 % 1.0 - 0.5)
    jy = abs((0.8 * y - 0.6 * x) / 0.9 % 1.0 - 0.5)
    return 0.46 * (1 + 0.03 * e1 + 0.02 * e2) * (0.55 if max(jx, jy) > 0.5 - 0.008 - foot * 0.4 else 1.0)


@kernel
def add_far(x, y, far, salt, c):
    """Woods and meadows around the site."""
    wood = step01(-0.1, 0.05, fbm2(x * 0.02, y * 0.02, 3, salt + 80))
    d1, d2, h, bx, by = worley2(x * 0.3, y * 0.3, salt + 81)
    t = 0.4 + 0.5 * step01(0.0, 0.7, 1 - d1) * (0.8 + 0.2 * noise2(x * 2.1, y * 2.1, salt + 82)) + 0.25 * (((h >> 5) & 255) / 255.0 - 0.5)
    w = far * wood
    c[0] += w * (0.075 * t - c[0])
    c[1] += w * (0.125 * t - c[1])
    c[2] += w * (0.05 * t - c[2])


@kernel
def terrain_colour(p, v, foot, site, c, n, k):
    """Lawn, path, bare ground, and what is far away, each with its share."""
    x = p[0]
    y = p[1]
    salt = site.salt
    far = step01(0.0, 14.0, max(abs(x) - site.half[0] - 5, abs(y) - site.half[1] - 5))
    e1 = noise2(x * 1.1, y * 1.1, salt + 50)
    e2 = noise2(x * 6.3, y * 6.3, salt + 51) * octave_weight(foot, 6.3)
    gravel = gravel_share(x, y, e1, e2, site)
    mud = mud_share(x, y, e1, e2, site)
    bare = bare_share(x, y, n[2], e1, e2, mud, site)
    c[0] = 0.0
    c[1] = 0.0
    c[2] = 0.0
    grass = (1 - gravel) * (1 - bare)
    if grass > 0.01:
        grass_colour(x, y, v[0], v[1], v[2], foot, salt, site.blades[0], site.blades[1], k)
        add_share(c, grass, k)
    if gravel > 0.01:
        if site.paved:
            light = slab_light(x, y, e1, e2, foot)
            c[0] += gravel * light
            c[1] += gravel * light * 0.98
            c[2] += gravel * light * 0.94
        else:
            gravel_colour(x, y, foot, salt, k, n)
            add_share(c, gravel, k)
    soil = (1 - gravel) * bare
    if soil > 0.01:
        gravel_colour(x * 0.8 + 31, y * 0.8, foot, salt + 3, k, n)
        light = 0.55 + 0.9 * (k[0] + k[1] + k[2]) / 3 * (1 + 0.25 * e2)
        wet = 1 - 0.5 * mud
        c[0] += soil * light * 0.34 * wet
        c[1] += soil * light * 0.27 * wet
        c[2] += soil * light * 0.19 * wet
    if far > 0:
        add_far(x, y, far, salt, c)


@kernel
def add_share(c, share, k):
    c[0] += share * k[0]
    c[1] += share * k[1]
    c[2] += share * k[2]


@kernel
def add_figures(x, y, z, foot, site, c):
    """Figures pecked into the rock."""
    for q in range(site.figures.shape[0]):
        figure = site.figures[q]
        if (x - figure[0]) ** 2 + (y - figure[1]) ** 2 < figure[2] ** 2:
            d = 1e9
            for w in range(int(figure[3]), int(figure[4])):
                d = min(d, polyline_distance(x, y, site.segments[w : w + 1].reshape(2, 2)))
            pecks = noise3(x * 75, y * 75, z * 75, site.salt + 95)[0]
            m = (1 - step01(0.018, 0.030, d)) * clamp01(0.80 + 0.6 * pecks * octave_weight(foot, 75.0))
            for a in range(3):
                c[a] += (0.66 - c[a]) * 0.8 * m


@kernel
def outcrop_colour(p, foot, sky_seen, site, c, n):
    """Rock with figures, and moss and soil in hollows."""
    x = p[0]
    y = p[1]
    z = p[2]
    rock_colour(x, y, z, foot, site.salt, site.rock[0], site.rock[1], site.rock[2], c, n)
    add_figures(x, y, z, foot, site, c)
    if n[2] > 0:
        moss = step01(0.15, 0.5, fbm2(x * 1.1, y * 1.1, 4, site.salt + 97) - 0.55 + 0.75 * (1 - sky_seen))
        c[0] += (0.10 - c[0]) * moss
        c[1] += (0.13 - c[1]) * moss
        c[2] += (0.03 - c[2]) * moss


@kernel
def stone_colour(p, foot, obj, site, c, n):
    q = 0.85 + 0.4 * rnd3(obj, 3, site.salt)
    r, g, b = site.rock[0] * q, site.rock[1] * q, site.rock[2] * q * 1.03
    rock_colour(p[0] + obj * 3.1, p[1], p[2], foot, site.salt + 11, r, g, b, c, n)


@kernel
def plaster_colour(u, v, obj, salt, c):
    light = 0.80 * (1 + 0.006 * noise2(u * 14 + obj * 9, v * 14, salt + 100) + 0.012 * noise2(u * 0.9 + obj * 9, v * 0.9, salt + 101))
    dirt = step01(0.0, 0.7, 0.7 - v + 0.15 * noise2(u * 2, v * 3, salt + 102))
    c[0] = light * (1 - 0.16 * dirt)
    c[1] = light * (0.985 - 0.18 * dirt)
    c[2] = light * (0.94 - 0.22 * dirt)


@kernel
def roof_colour(u, v, foot, obj, salt, c):
    """Tiles in rows."""
    row = math.floor(v / 0.33)
    place = u / 0.24 + 0.5 * (row % 2)
    column = math.floor(place)
    fv = v / 0.33 - row
    fu = place - column
    light = 0.75 + 0.45 * rnd3(int(row), int(column), salt + obj)
    light *= 0.45 + 0.55 * step01(0.0, 0.10 + foot * 2, fv)
    light *= 0.75 + 0.25 * step01(0.0, 0.08 + foot * 2, min(fu, 1 - fu))
    light *= 1 + 0.25 * noise2(u * 3.1, v * 3.1, salt + 110) + 0.15 * noise2(u * 21, v * 21, salt + 111) * octave_weight(foot, 21.0)
    c[0] = 0.40 * light
    c[1] = 0.19 * light
    c[2] = 0.13 * light


@kernel
def wood_colour(u, v, foot, obj, salt, c):
    w = octave_weight(foot, 60.0)
    coarse = 0.25 * noise2(u * 18, v * 1.7 + obj * 5, salt + 120)
    fine = 0.25 * w * noise2(u * 60, v * 4 + obj * 5, salt + 121)
    light = 1 + coarse + fine + 0.2 * (rnd3(obj, 5, salt) - 0.5)
    c[0] = 0.37 * light
    c[1] = 0.27 * light
    c[2] = 0.18 * light


@kernel
def bark_colour(u, v, foot, obj, salt, c):
    w = octave_weight(foot, 40.0)
    light = 0.9 + 0.3 * noise2(u * 9, v * 3 + obj, salt + 130) + 0.35 * w * noise2(u * 40, v * 9 + obj, salt + 131)
    c[0] = 0.20 * light
    c[1] = 0.155 * light
    c[2] = 0.115 * light


@kernel
def leaf_colour(plant, leaf, salt, c):
    q = rnd3(int(leaf), 2, 5)
    hue = rnd3(int(plant), 11, salt)
    light = 0.75 + 0.55 * q
    c[0] = (0.105 + 0.075 * hue) * light
    c[1] = (0.195 + 0.045 * hue) * light
    c[2] = (0.045 + 0.02 * (1 - hue)) * light


@kernel
def paint_colour(obj, salt, c):
    h = rnd3(obj, 17, salt)
    c[0] = 0.12 + 0.5 * h
    c[1] = 0.13 + 0.35 * (1 - h) * h * 2
    c[2] = 0.16 + 0.5 * (1 - h)


@kernel
def board_colour(u, v, salt, c):
    """Lines of something written."""
    ink = rnd3(int(math.floor(u / 0.13)), int(math.floor(v / 0.085)), salt + 140)
    light = 0.75 if ink > 0.55 else 0.18 + 0.4 * ink
    if abs(u) > 0.58 or abs(v) > 0.38:
        light = 0.6
    c[0] = light
    c[1] = light * (0.9 + 0.1 * ink)
    c[2] = light * (0.75 + 0.2 * ink)


@kernel
def built_colour(material, u, v, foot, obj, salt, c):
    """Of everything that is neither ground nor rock."""
    if material == PLASTER:
        plaster_colour(u, v, obj, salt, c)
    elif material == ROOF:
        roof_colour(u, v, foot, obj, salt, c)
    elif material == WINDOW:
        c[0] = 0.025
        c[1] = 0.03
        c[2] = 0.035
    elif material == WOOD:
        wood_colour(u, v, foot, obj, salt, c)
    elif material == WATER:
        c[0] = 0.018
        c[1] = 0.030
        c[2] = 0.026
    elif material == BARK:
        bark_colour(u, v, foot, obj, salt, c)
    elif material == LEAF:
        leaf_colour(u, v, salt, c)
    elif material == PAINT:
        paint_colour(obj, salt, c)
    elif material == BOARD:
        board_colour(u, v, salt, c)


@kernel
def light_outdoors(material, flat, n, sky_seen, sun_seen, sun, c, out):
    q = 1 / math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2] + 1e-12)
    n[0] *= q
    n[1] *= q
    n[2] *= q
    facing = n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2]
    if material == LEAF:
        # Leaves let some light through.
        lit = (max(facing, 0.0) + 0.45 * max(-facing, 0.0)) * sun_seen
    else:
        flat_facing = flat[0] * sun[0] + flat[1] * sun[1] + flat[2] * sun[2]
        lit = max(facing, 0.0) * sun_seen * step01(-0.02, 0.08, flat_facing)
    up = 0.5 + 0.5 * n[2]
    ambient = sky_seen * (0.30 + 0.70 * up)
    ground = 0.16 * (1 - up) * (0.4 + 0.6 * sky_seen)
    out[0] = c[0] * (2.35 * lit + 0.55 * ambient + ground * 1.05)
    out[1] = c[1] * (2.22 * lit + 0.66 * ambient + ground)
    out[2] = c[2] * (1.98 * lit + 0.88 * ambient + ground * 0.75)


@shading
def shade_outdoors(hits, directions, distances, sun_seen, spacing, sun, site, out):
    """Linear colour of each sample. Directions have unit length; `sun_seen` is 1 where the sun is visible; `spacing` of samples, radians."""
    c = np.zeros(3)
    n = np.zeros(3)
    k = np.zeros(3)
    for i in range(directions.shape[0]):
        material = hits.material[i]
        d = directions[i]
        if material < 0:
            sky(d[0], d[1], d[2], site.salt + 7, c)
            out[i, 0] = c[0]
            out[i, 1] = c[1]
            out[i, 2] = c[2]
            continue
        flat = hits.normal[i]
        n[0] = flat[0]
        n[1] = flat[1]
        n[2] = flat[2]
        cosine = abs(n[0] * d[0] + n[1] * d[1] + n[2] * d[2])
        foot = distances[i] * spacing / math.sqrt(max(cosine, 0.12))
        if material == TERRAIN:
            terrain_colour(hits.place[i], d, foot, site, c, n, k)
        elif material == ROCK:
            outcrop_colour(hits.place[i], foot, hits.sky[i], site, c, n)
        elif material == STONE:
            stone_colour(hits.place[i], foot, hits.obj[i], site, c, n)
        else:
            built_colour(material, hits.texture[i, 0], hits.texture[i, 1], foot, hits.obj[i], site.salt, c)
        light_outdoors(material, flat, n, hits.sky[i], sun_seen[i], sun, c, out[i])
