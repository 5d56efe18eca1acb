"""Value noise, cellular noise and smooth steps, from which all textures and reliefs are made. The same input gives the same value."""

import math

import numpy as np
from numba import njit

# Compiled by Numba; `exact` keeps to the order of floating-point operations, `shading` lets other threads run.
exact = njit(cache=True, error_model="numpy")
kernel = njit(cache=True, fastmath=True, error_model="numpy")
shading = njit(cache=True, fastmath=True, nogil=True, error_model="numpy")


@exact
def hash3(i, j, k):
    h = (i * 374761393 + j * 668265263 + k * 1442695041) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return h ^ (h >> 16)


@exact
def rnd3(i, j, k):
    return hash3(i, j, k) * (1.0 / 4294967296.0)


@kernel
def noise2(x, y, s):
    """Value noise in [-1, 1] on the unit lattice."""
    fx = math.floor(x)
    fy = math.floor(y)
    i = int(fx)
    j = int(fy)
    u = x - fx
    v = y - fy
    a = rnd3(i, j, s)
    b = rnd3(i + 1, j, s)
    c = rnd3(i, j + 1, s)
    d = rnd3(i + 1, j + 1, s)
    u = u * u * u * (u * (u * 6 - 15) + 10)
    v = v * v * v * (v * (v * 6 - 15) + 10)
    return 2 * (a + (b - a) * u + (c - a) * v + (a - b - c + d) * u * v) - 1


@kernel
def noise3(x, y, z, s):
    """Value noise in [-1, 1] and its gradient."""
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    i, j, k = int(fx), int(fy), int(fz)
    u, v, w = x - fx, y - fy, z - fz
    du = 30 * u * u * (u - 1) * (u - 1)
    dv = 30 * v * v * (v - 1) * (v - 1)
    dw = 30 * w * w * (w - 1) * (w - 1)
    u = u * u * u * (u * (u * 6 - 15) + 10)
    v = v * v * v * (v * (v * 6 - 15) + 10)
    w = w * w * w * (w * (w * 6 - 15) + 10)
    k0 = k * 7919 + s * 104729
    k1 = k0 + 7919
    a = rnd3(i, j, k0)
    b = rnd3(i + 1, j, k0)
    c = rnd3(i, j + 1, k0)
    d = rnd3(i + 1, j + 1, k0)
    e = rnd3(i, j, k1)
    f = rnd3(i + 1, j, k1)
    g = rnd3(i, j + 1, k1)
    h = rnd3(i + 1, j + 1, k1)
    p0 = a
    p1 = b - a
    p2 = c - a
    p3 = e - a
    p4 = a - b - c + d
    p5 = a - c - e + g
    p6 = a - b - e + f
    p7 = -a + b + c - d + e - f - g + h
    val = p0 + p1 * u + p2 * v + p3 * w + p4 * u * v + p5 * v * w + p6 * w * u + p7 * u * v * w
    return (
        2 * val - 1,
        2 * du * (p1 + p4 * v + p6 * w + p7 * v * w),
        2 * dv * (p2 + p5 * w + p4 * u + p7 * w * u),
        2 * dw * (p3 + p6 * u + p5 * v + p7 * u * v),
    )


@kernel
def fbm2(x, y, octaves, s):
    a = 0.5
    t = 0.0
    for o in range(octaves):
        t += a * noise2(x, y, s + o)
        x, y = 1.63 * x - 1.21 * y + 3.1, 1.21 * x + 1.63 * y - 7.7
        a *= 0.5
    return t


@exact
def fbm2_grid(X, Y, freq, octaves, s):
    out = np.empty(X.size)
    x = X.ravel()
    y = Y.ravel()
    for i in range(x.size):
        out[i] = fbm2(x[i] * freq, y[i] * freq, octaves, s)
    return out.reshape(X.shape)


@exact
def noise3_grid(P, freq, s):
    out = np.empty(len(P))
    for i in range(len(P)):
        out[i] = noise3(P[i, 0] * freq, P[i, 1] * freq, P[i, 2] * freq, s)[0]
    return out


@kernel
def worley2(x, y, s):
    """Distances to the two nearest feature points, the number of the nearest cell, and the direction to it."""
    fx = math.floor(x)
    fy = math.floor(y)
    i = int(fx)
    j = int(fy)
    d1 = 9.0
    d2 = 9.0
    best = 0
    bx = 0.0
    by = 0.0
    for di in range(-1, 2):
        for dj in range(-1, 2):
            h = hash3(i + di, j + dj, s)
            px = fx + di + (h & 0xFFFF) / 65536.0 - x
            py = fy + dj + ((h >> 16) & 0xFFFF) / 65536.0 - y
            d = px * px + py * py
            if d < d1:
                d2 = d1
                d1 = d
                best = h
                bx = px
                by = py
            elif d < d2:
                d2 = d
    return math.sqrt(d1), math.sqrt(d2), best, bx, by


@kernel
def clamp01(x):
    return 0.0 if x < 0 else (1.0 if x > 1 else x)


@kernel
def step01(a, b, x):
    t = clamp01((x - a) / (b - a))
    return t * t * (3 - 2 * t)


@kernel
def polyline_distance(x, y, path):
    best = 1e9
    for i in range(path.shape[0] - 1):
        ax = path[i, 0]
        ay = path[i, 1]
        dx = path[i + 1, 0] - ax
        dy = path[i + 1, 1] - ay
        t = clamp01(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy + 1e-12))
        ex = x - ax - t * dx
        ey = y - ay - t * dy
        d = ex * ex + ey * ey
        if d < best:
            best = d
    return math.sqrt(best)


@kernel
def octave_weight(foot, freq):
    """Fade an octave out when its lattice gets finer than the distance between samples."""
    w = 2 - 2 * foot * freq
    return 0.0 if w < 0 else (1.0 if w > 1 else w)
