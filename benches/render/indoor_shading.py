"""Colour of points indoors: a large lamp, light from all sides with baked occlusion. h1, h2 and h3 are the looks of an object."""

import math

import numpy as np

from .materials import BOARD, BOOK, CLOTH, FLOOR, GLOSS, MARBLE, PAINT, PANE, PICTURE, STONE, WINDOW, WOOD
from .noise import clamp01, fbm2, kernel, noise2, octave_weight, rnd3, shading, step01, worley2
from .textures import rock_colour


@kernel
def stone_colour(p, scale, h1, foot, obj, room, c, n):
    """The rock of the outdoor scenes at a smaller scale."""
    q = 0.8 + 0.4 * h1
    r, g, b = room.stone[0] * q, room.stone[1] * q, room.stone[2] * q
    rock_colour(p[0] * scale + obj * 3.1, p[1] * scale, p[2] * scale, foot * scale, room.salt + 11, r, g, b, c, n)


@kernel
def wood_colour(u, v, h1, foot, obj, salt, c):
    coarse = 0.22 * noise2(u * 18, v * 1.7 + obj * 5, salt + 120)
    fine = 0.2 * octave_weight(foot, 60.0) * noise2(u * 60, v * 4 + obj * 5, salt + 121)
    finest = 0.15 * octave_weight(foot, 180.0) * noise2(u * 180, v * 9 + obj * 5, salt + 122)
    light = (0.55 + 0.6 * h1) * (1 + coarse + fine + finest)
    c[0] = 0.40 * light
    c[1] = 0.27 * light
    c[2] = 0.16 * light


@kernel
def board_colour(u, v, foot, salt, c):
    """Lines of something written."""
    row = v / 0.022
    ink = rnd3(int(math.floor(u / 0.05)), int(math.floor(row)), salt + 140)
    blank = ink > 0.6 or row - math.floor(row) > 0.6
    light = 0.8 if blank else 0.8 - 0.6 * octave_weight(foot, 45.0) - 0.2 * ink
    c[0] = light
    c[1] = light * 0.98
    c[2] = light * 0.92


@kernel
def picture_colour(u, v, h1, h2, foot, obj, salt, c):
    """Patches of colour with strokes, other ones in each picture."""
    k = 3 + 6 * h1
    wu = u + 0.12 * noise2(u * 4, v * 4 + obj, salt + 150)
    wv = v + 0.12 * noise2(u * 4 + 9, v * 4 + obj, salt + 151)
    d1, d2, h, bx, by = worley2(wu * k + obj * 3, wv * k * (0.6 + 0.8 * h2), salt + 152)
    e1 = ((h >> 3) & 255) / 255.0
    e2 = ((h >> 11) & 255) / 255.0
    e3 = ((h >> 19) & 255) / 255.0
    coarse = 0.3 * noise2(u * 23 + obj, v * 9, salt + 153)
    fine = 0.3 * octave_weight(foot, 70.0) * noise2(u * 70, v * 70 + obj, salt + 154)
    finest = 0.25 * octave_weight(foot, 190.0) * noise2(u * 190, v * 150 + obj, salt + 155)
    light = 0.75 + coarse + fine + finest
    light *= 0.35 + 0.65 * step01(0.02, 0.06 + foot * k, d2 - d1)
    c[0] = (0.08 + 0.7 * e1) * light
    c[1] = (0.08 + 0.6 * (0.5 * e2 + 0.5 * e1)) * light
    c[2] = (0.06 + 0.6 * e3) * light


@kernel
def book_colour(u, v, foot, obj, salt, c):
    """Backs of books with lettering."""
    place = u / 0.031 + 0.35 * noise2(u * 9, obj, salt + 160)
    book = int(math.floor(place))
    f = place - book
    e1 = rnd3(book, obj, salt + 161)
    e2 = rnd3(book, obj, salt + 162)
    e3 = rnd3(book, obj, salt + 163)
    grain = 0.1 * octave_weight(foot, 90.0) * noise2(u * 90, v * 90 + obj, salt + 164)
    light = (0.45 + 0.55 * step01(0, 0.12 + foot * 20, min(f, 1 - f))) * (1 + grain)
    r = 0.08 + 0.6 * e1 * e1
    g = 0.07 + 0.45 * e2 * e2
    b = 0.07 + 0.45 * e3 * e3
    letter = rnd3(int(math.floor(v / 0.006)), book, salt + 165)
    if abs(f - 0.5) < 0.22 and letter < 0.45 and abs(v - 0.03 * (e2 - 0.5)) < 0.05:
        light *= 1 + 1.6 * octave_weight(foot, 110.0)
    if abs(abs(v) - 0.06 - 0.03 * e3) < 0.006:
        r, g, b = 0.6, 0.5, 0.25
    c[0] = r * light
    c[1] = g * light
    c[2] = b * light


@kernel
def cloth_colour(u, v, h1, h2, h3, foot, obj, salt, c):
    """A woven pattern, or nearly plain."""
    w = octave_weight(foot, 160.0)
    across = 0.15 * w * noise2(u * 160, v * 40, salt + 170)
    along = 0.15 * w * noise2(u * 40, v * 160, salt + 171)
    light = 0.8 + across + along + 0.08 * noise2(u * 7 + obj, v * 7, salt + 172)
    c[0] = 0.12 + 0.5 * h1
    c[1] = 0.10 + 0.4 * h2
    c[2] = 0.10 + 0.45 * h3
    if h1 + h3 > 0.8:
        p = 7 + 9 * h2
        a = abs((u * p) % 1.0 - 0.5) + abs((v * p) % 1.0 - 0.5)
        d1, d2, h, bx, by = worley2(u * p * 2.3, v * p * 2.3, salt + 173)
        q = ((h >> 5) & 255) / 255.0
        if a < 0.28:
            c[0] = 0.55 * q + 0.1
            c[1] = 0.12 + 0.3 * (1 - q)
            c[2] = 0.1 + 0.1 * q
        elif d2 - d1 < 0.12:
            c[0] = 0.6
            c[1] = 0.52
            c[2] = 0.36
    c[0] *= light
    c[1] *= light
    c[2] *= light


@kernel
def gloss_colour(h1, h2, c):
    """Table tops and lacquer, blank."""
    light = 0.72 if h1 < 0.6 else 0.06 + 0.3 * h2
    c[0] = light
    c[1] = light * (0.99 if h1 < 0.6 else 0.8)
    c[2] = light * (0.97 if h1 < 0.6 else 0.6)


@kernel
def tile_colour(x, y, foot, salt, c):
    """Stone tiles, veined."""
    iu = math.floor(x / 0.8)
    iv = math.floor(y / 0.8)
    fu = x / 0.8 - iu
    fv = y / 0.8 - iv
    q = rnd3(int(iu), int(iv), salt + 180)
    edge = min(min(fu, 1 - fu), min(fv, 1 - fv)) * 0.8
    coarse = 0.10 * fbm2(x * 2.3 + 9 * q, y * 2.3, 4, salt + 181)
    fine = 0.05 * octave_weight(foot, 50.0) * noise2(x * 50, y * 50, salt + 182)
    light = (0.50 if (int(iu) + int(iv)) % 2 == 0 else 0.30) * (0.93 + 0.14 * q) * (1 + coarse + fine)
    vein = abs(noise2(x * 3.1 + 7 * q, y * 3.1, salt + 183) + 0.4 * noise2(x * 9, y * 9, salt + 184))
    light *= 1 - 0.25 * (1 - step01(0.01, 0.05 + foot * 4, vein)) * min(1.0, 0.03 / (0.03 + foot))
    light *= 0.6 + 0.4 * step01(0.001, 0.004 + foot, edge)
    c[0] = light
    c[1] = light * 0.96
    c[2] = light * 0.89


@kernel
def plank_colour(x, y, foot, salt, c):
    row = int(math.floor(y / 0.11))
    place = x / 1.1 + rnd3(row, 3, salt)
    column = int(math.floor(place))
    q = rnd3(row, column, salt + 190)
    edge = min(y / 0.11 - row, 1 - y / 0.11 + row) * 0.11
    coarse = 0.16 * noise2(x * 3 + 9 * q, y * 60, salt + 191)
    fine = 0.12 * octave_weight(foot, 140.0) * noise2(x * 12 + 9 * q, y * 140, salt + 192)
    light = (0.75 + 0.4 * q) * (1 + coarse + fine)
    light *= 0.55 + 0.45 * step01(0.0005, 0.0025 + foot, min(edge, min(place - column, 1 - place + column) * 1.1))
    c[0] = 0.42 * light
    c[1] = 0.28 * light
    c[2] = 0.165 * light


@kernel
def wall_colour(u, v, h2, h3, foot, obj, salt, c):
    """Nearly blank."""
    fine = 0.003 * octave_weight(foot, 60.0) * noise2(u * 60, v * 60 + obj, salt + 101)
    light = 0.80 * (1 + fine + 0.005 * noise2(u * 1.1 + obj * 9, v * 1.1, salt + 102))
    c[0] = light
    c[1] = light * (0.985 - 0.02 * h2)
    c[2] = light * (0.95 - 0.05 * h3)


@kernel
def furniture_colour(material, u, v, foot, obj, salt, c):
    """Of everything that is neither stone nor floor."""
    h1 = rnd3(obj, 17, salt)
    h2 = rnd3(obj, 18, salt)
    h3 = rnd3(obj, 19, salt)
    if material == WINDOW:
        c[0] = 0.015
        c[1] = 0.015
        c[2] = 0.017
    elif material == WOOD:
        wood_colour(u, v, h1, foot, obj, salt, c)
    elif material == PAINT:
        c[0] = 0.08 + 0.6 * h1
        c[1] = 0.08 + 0.5 * h2
        c[2] = 0.08 + 0.5 * h3
    elif material == BOARD:
        board_colour(u, v, foot, salt, c)
    elif material == PICTURE:
        picture_colour(u, v, h1, h2, foot, obj, salt, c)
    elif material == BOOK:
        book_colour(u, v, foot, obj, salt, c)
    elif material == CLOTH:
        cloth_colour(u, v, h1, h2, h3, foot, obj, salt, c)
    elif material == GLOSS:
        gloss_colour(h1, h2, c)
    else:
        wall_colour(u, v, h2, h3, foot, obj, salt, c)


@kernel
def surface_colour(material, p, u, v, foot, obj, room, c, n):
    if material == STONE or material == MARBLE:
        scale = 13.0 if material == MARBLE else 4.5
        stone_colour(p, scale, rnd3(obj, 17, room.salt), foot, obj, room, c, n)
    elif material == FLOOR and room.planks:
        plank_colour(p[0], p[1], foot, room.salt, c)
    elif material == FLOOR:
        tile_colour(p[0], p[1], foot, room.salt, c)
    else:
        furniture_colour(material, u, v, foot, obj, room.salt, c)


@kernel
def light_indoors(flat, n, sky_seen, lamp_seen, lamp, c, out):
    q = 1 / math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2] + 1e-12)
    facing = (n[0] * lamp[0] + n[1] * lamp[1] + n[2] * lamp[2]) * q
    lit = max(facing, 0.0) * lamp_seen * step01(-0.02, 0.08, flat[0] * lamp[0] + flat[1] * lamp[1] + flat[2] * lamp[2])
    ambient = (0.45 + 0.55 * sky_seen) * (0.82 + 0.18 * n[2] * q)
    out[0] = c[0] * (1.30 * lit + 1.45 * ambient)
    out[1] = c[1] * (1.25 * lit + 1.45 * ambient)
    out[2] = c[2] * (1.16 * lit + 1.45 * ambient)


@shading
def shade_indoors(hits, directions, distances, lamp_seen, spacing, lamp, room, out):
    """As shade_outdoors; windows are too bright to see much through them."""
    c = np.zeros(3)
    n = np.zeros(3)
    for i in range(directions.shape[0]):
        material = hits.material[i]
        obj = hits.obj[i]
        u = hits.texture[i, 0]
        v = hits.texture[i, 1]
        if material < 0 or material == PANE:
            light = 2.2 + 0.5 * clamp01(v / 3) + 0.25 * noise2(u * 1.3 + obj, v * 1.1, room.salt + 600)
            out[i, 0] = light
            out[i, 1] = light * 1.02
            out[i, 2] = light * 1.06
            continue
        d = directions[i]
        flat = hits.normal[i]
        n[0] = flat[0]
        n[1] = flat[1]
        n[2] = flat[2]
        cosine = abs(n[0] * d[0] + n[1] * d[1] + n[2] * d[2])
        foot = distances[i] * spacing / math.sqrt(max(cosine, 0.12))
        surface_colour(material, hits.place[i], u, v, foot, obj, room, c, n)
        light_indoors(flat, n, hits.sky[i], lamp_seen[i], lamp, c, out[i])
