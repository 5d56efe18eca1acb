"""Colours of sky, lawn, gravel and rock. `foot` is the distance between samples on the surface in metres: what is finer fades out.

Colours are linear and go to `c`; what tilts the surface changes the normal `n`. Numbers after `salt` tell one pattern from the next.
"""

import math

from .noise import fbm2, kernel, noise2, noise3, octave_weight, step01, clamp01, worley2


@kernel
def sky(dx, dy, dz, salt, c):
    """Clear sky with some clouds; direction of unit length."""
    t = clamp01(dz)
    h = (1 - t) ** 4
    r = 0.23 + 0.55 * h
    g = 0.42 + 0.42 * h
    b = 0.80 + 0.10 * h
    if dz > 0.03:
        cloud = step01(0.02, 0.45, fbm2(1.7 * dx / (dz + 0.15) + 5, 1.7 * dy / (dz + 0.15), 5, salt)) * 0.8
        r += (0.95 - r) * cloud
        g += (0.95 - g) * cloud
        b += (0.97 - b) * cloud
    c[0] = r
    c[1] = g
    c[2] = b


@kernel
def blade(x, y, layer, w1, w2, w3, foot, salt):
    """Brightness of one layer of the lawn: tufts, each with its own direction of blades."""
    d1, d2, h, bx, by = worley2(x * 4.6, y * 4.6, salt + 330 + layer)
    a = 6.2832 * ((h >> 4) & 1023) / 1023.0
    ca = math.cos(a)
    sa = math.sin(a)
    u = (ca * bx + sa * by) / 4.6 + (h & 63)
    v = (ca * by - sa * bx) / 4.6
    b = 0.45 * w1 * noise2(u * 26, v * 13, salt + 340 + layer)
    if w2 > 0:
        b += 0.55 * w2 * noise2(u * 66, v * 25, salt + 350 + layer)
    if w3 > 0:
        b += 0.5 * w3 * noise2(u * 150, v * 48, salt + 360 + layer)
    return b + 0.10 * (((h >> 14) & 255) / 255.0 - 0.5) * octave_weight(foot, 4.6)


@kernel
def lawn(x, y, vx, vy, vz, foot, salt, sway_x, sway_y):
    """Brightness of three layers of blades within 1.5 cm of the surface, which gives a small parallax and sways a little."""
    w1 = octave_weight(foot, 24)
    w2 = octave_weight(foot, 62)
    w3 = octave_weight(foot, 150)
    light = 0.60
    for layer in range(3):
        height = 0.015 * (layer - 1)
        px = x - vx / vz * height + layer * sway_x * 0.006
        py = y - vy / vz * height + layer * sway_y * 0.006
        b = blade(px, py, layer, w1, w2, w3, foot, salt)
        if b > -0.05 + 0.12 * layer:
            light = 0.42 + 0.24 * layer + 0.45 * b
        elif layer == 0:
            light = 0.36 + 0.3 * b
    return light


@kernel
def grass_colour(x, y, vx, vy, vz, foot, salt, sway_x, sway_y, c):
    vz = max(-vz, 0.3)
    patch = fbm2(x * 0.35, y * 0.35, 3, salt + 300)
    fine = noise2(x * 8.5 + 3, y * 8.5, salt + 311) * 0.5 * octave_weight(foot, 8.5)
    clump = noise2(x * 2.7, y * 2.7, salt + 310) * 0.5 + fine
    dry = step01(0.05, 0.55, fbm2(x * 0.6 + 40, y * 0.6, 4, salt + 320) + 0.25 * clump)
    light = lawn(x, y, vx, vy, vz, foot, salt, sway_x, sway_y)
    light *= 1 + 0.28 * clump + 0.25 * patch
    r = 0.150 + 0.17 * dry + 0.02 * patch
    g = 0.235 + 0.08 * dry
    b = 0.055 + 0.06 * dry
    d1, d2, h, bx, by = worley2(x * 3.3, y * 3.3, salt + 370)
    # Small flowers.
    if (h & 1023) < 120 and d1 < 0.09 and foot < 0.02:
        if h & 1024:
            r, g, b = 0.75, 0.75, 0.70
        else:
            r, g, b = 0.70, 0.60, 0.08
        light = 1.0
    c[0] = r * light
    c[1] = g * light
    c[2] = b * light


@kernel
def gravel_colour(x, y, foot, salt, c, n):
    """Pebbles at two sizes."""
    red = 0.0
    light = 0.0
    for k in range(2):
        f = 17.0 if k == 0 else 43.0
        w = octave_weight(foot, f * 0.6)
        if w <= 0:
            light += 0.5 * 0.42
            continue
        d1, d2, h, bx, by = worley2(x * f, y * f, salt + 400 + k)
        e = step01(0.02, 0.22, d2 - d1)
        light += 0.5 * (0.42 + w * (e * (0.30 + 0.42 * ((h >> 3) & 255) / 255.0) - 0.42))
        red += 0.5 * w * (((h >> 12) & 255) / 255.0 - 0.5)
        if k == 0:
            n[0] -= 0.5 * w * bx * e
            n[1] -= 0.5 * w * by * e
    light *= 1 + 0.18 * noise2(x * 1.3, y * 1.3, salt + 410) + 0.15 * noise2(x * 5.1, y * 5.1, salt + 411)
    c[0] = light * (0.86 + 0.14 * red)
    c[1] = light * (0.81 + 0.03 * red)
    c[2] = light * (0.74 - 0.10 * red)


@kernel
def rock_grain(x, y, z, foot, salt):
    """Brightness and its slope, in up to seven octaves."""
    light = 1.0
    gx = 0.0
    gy = 0.0
    gz = 0.0
    frequency = 1.7
    amplitude = 0.22
    for octave in range(7):
        w = octave_weight(foot, frequency)
        if w <= 0:
            break
        v, dx, dy, dz = noise3(x * frequency, y * frequency, z * frequency, salt + 500 + octave)
        light += amplitude * w * v
        b = 0.16 * w if octave > 0 else 0.05
        gx += b * dx
        gy += b * dy
        gz += b * dz
        frequency *= 2.17
        amplitude *= 0.90
        x, y = 0.8 * x - 0.6 * y + 1.7, 0.6 * x + 0.8 * y
    return light, gx, gy, gz


@kernel
def rock_bands(x, y, z, wave, foot, salt):
    u = 0.55 * x + 0.3 * y + 0.75 * z
    coarse = 0.14 * octave_weight(foot, 7.0) * noise2(u * 7 + 0.9 * wave, 0.37, salt + 521)
    return 1 + coarse + 0.10 * octave_weight(foot, 23.0) * noise2(u * 23 + 2 * wave, 1.7, salt + 522)


@kernel
def rock_cracks(x, y, z, wave, foot, salt):
    coarse = noise3(x * 1.9 + 0.5 * wave, y * 1.9, z * 1.9, salt + 530)[0]
    fine = noise3(x * 4.3, y * 4.3 + 0.4 * wave, z * 4.3, salt + 531)[0]
    width = 0.022 + foot * 1.2
    light = 1 - 0.65 * (1 - step01(0.3 * width, width, abs(coarse))) * min(1.0, 0.03 / width)
    width = 0.030 + foot * 2.5
    return light, 1 - 0.40 * (1 - step01(0.3 * width, width, abs(fine))) * min(1.0, 0.03 / width)


@kernel
def lichen(x, y, z, wave, foot, salt, c):
    """Pale and yellow lichen and a dark crust over a colour."""
    l1 = noise3(x * 2.3 + 9, y * 2.3, z * 2.3, salt + 540)[0]
    l2 = noise3(x * 9.1, y * 9.1, z * 9.1, salt + 541)[0]
    l3 = noise3(x * 31, y * 31, z * 31, salt + 542)[0]
    l3 *= octave_weight(foot, 31.0)
    m = step01(0.16, 0.30, 0.45 * l1 + 0.45 * l2 + 0.3 * l3)
    c[0] += (0.50 * (1 + 0.3 * l3) - c[0]) * 0.75 * m
    c[1] += (0.52 * (1 + 0.3 * l3) - c[1]) * 0.75 * m
    c[2] += (0.44 * (1 + 0.3 * l3) - c[2]) * 0.75 * m
    m = step01(0.30, 0.42, -0.5 * l1 + 0.4 * l2 - 0.3 * l3)
    c[0] += (0.42 - c[0]) * 0.7 * m
    c[1] += (0.36 - c[1]) * 0.7 * m
    c[2] += (0.09 - c[2]) * 0.7 * m
    m = step01(0.22, 0.40, -0.6 * l2 + 0.4 * l3 - 0.25 * wave)
    c[0] *= 1 - 0.55 * m
    c[1] *= 1 - 0.55 * m
    c[2] *= 1 - 0.53 * m


@kernel
def rock_colour(x, y, z, foot, salt, r, g, b, c, n):
    """Banded rock with cracks and lichen; tilts the normal by the slope of the grain."""
    light, gx, gy, gz = rock_grain(x, y, z, foot, salt)
    wave = noise3(x * 0.7, y * 0.7, z * 0.7, salt + 520)[0]
    light *= rock_bands(x, y, z, wave, foot, salt)
    coarse, fine = rock_cracks(x, y, z, wave, foot, salt)
    light *= coarse
    light *= fine
    c[0] = r * light * (1 + 0.10 * wave)
    c[1] = g * light
    c[2] = b * light * (1 - 0.08 * wave)
    lichen(x, y, z, wave, foot, salt, c)
    c[0] = max(c[0], 0.01)
    c[1] = max(c[1], 0.01)
    c[2] = max(c[2], 0.01)
    n[0] -= gx
    n[1] -= gy
    n[2] -= gz
