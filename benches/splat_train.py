"""A small trainer of Gaussian splats on one CPU core, for benches/splats.py.

3D Gaussians with colours in spherical harmonics of degree 1 start at the sparse points which at least two training images observe (random places in the scene's box
where there are fewer than 500). Each iteration renders one image, scanline by scanline and Gaussian after Gaussian from front to back, and follows the gradient of
0.8 L1 + 0.2 (1 - SSIM) by Adam. Gaussians whose image moves most are doubled until there are as many as allowed; transparent ones are removed.
"""

import math
from typing import NamedTuple

import cv2
import numba
import numpy as np

SH0, SH1 = 0.28209479177387814, 0.4886025119029199
# Of an image's Gaussian: variance added in pixels squared, largest alpha, smallest alpha that is drawn.
BLUR, MOST, LEAST = 0.3, 0.99, 1 / 255
cv2.setNumThreads(1)
jit = numba.njit(cache=True, fastmath=True, boundscheck=False)


class Scene(NamedTuple):
    names: list
    images: np.ndarray  # n, 3, h, w of 0..1
    inside: np.ndarray  # n, h, w: where the photograph has pixels
    intrinsics: np.ndarray  # n, 4: fx, fy, cx, cy
    rotations: np.ndarray
    translations: np.ndarray
    held_out: np.ndarray
    points: np.ndarray
    colours: np.ndarray
    tracks: np.ndarray  # m, 2: image, point
    background: np.ndarray


# ---------------------------------------------------------------- rendering


@jit
def project(means, scales, quaternions, opacities, harmonics, rotation, translation, camera, width, height, near):
    """Mean, conic, extent, depth and colour of each Gaussian in an image; depth 0 where it isn't seen."""
    count = means.shape[0]
    flat = np.zeros((count, 12), np.float32)  # x, y, a, b, c, reach, depth, opacity, half width, half height, -, -
    colours = np.zeros((count, 3), np.float32)
    fx, fy, cx, cy = camera
    cover = np.zeros((3, 3), np.float32)
    for g in range(count):
        x = rotation[0, 0] * means[g, 0] + rotation[0, 1] * means[g, 1] + rotation[0, 2] * means[g, 2] + translation[0]
        y = rotation[1, 0] * means[g, 0] + rotation[1, 1] * means[g, 1] + rotation[1, 2] * means[g, 2] + translation[1]
        z = rotation[2, 0] * means[g, 0] + rotation[2, 1] * means[g, 1] + rotation[2, 2] * means[g, 2] + translation[2]
        if z < near:
            continue
        opacity = 1 / (1 + math.exp(-opacities[g]))
        if opacity <= LEAST:
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        if u < -0.3 * width or u > 1.3 * width or v < -0.3 * height or v > 1.3 * height:
            continue
        covariance(scales[g], quaternions[g], cover)
        t0, t1 = jacobian(x, y, z, fx, fy, rotation)
        sxx = quadratic(t0, cover, t0) + BLUR
        sxy = quadratic(t0, cover, t1)
        syy = quadratic(t1, cover, t1) + BLUR
        determinant = sxx * syy - sxy * sxy
        if determinant <= 0:
            continue
        reach = 2 * math.log(opacity / LEAST)
        flat[g, 0], flat[g, 1] = u, v
        flat[g, 2], flat[g, 3], flat[g, 4] = syy / determinant, -sxy / determinant, sxx / determinant
        flat[g, 5], flat[g, 6], flat[g, 7] = reach, z, opacity
        flat[g, 8], flat[g, 9] = math.sqrt(reach * sxx), math.sqrt(reach * syy)
        dx, dy, dz = direction(means[g], rotation, translation)
        for k in range(3):
            c = harmonics[g, 0, k] * SH0 + SH1 * (-dy * harmonics[g, 1, k] + dz * harmonics[g, 2, k] - dx * harmonics[g, 3, k])
            colours[g, k] = max(c + 0.5, 0.0)
    return flat, colours


@jit
def direction(mean, rotation, translation):
    """Unit vector from the camera to a place."""
    dx = mean[0] + rotation[0, 0] * translation[0] + rotation[1, 0] * translation[1] + rotation[2, 0] * translation[2]
    dy = mean[1] + rotation[0, 1] * translation[0] + rotation[1, 1] * translation[1] + rotation[2, 1] * translation[2]
    dz = mean[2] + rotation[0, 2] * translation[0] + rotation[1, 2] * translation[1] + rotation[2, 2] * translation[2]
    n = 1 / math.sqrt(dx * dx + dy * dy + dz * dz + 1e-12)
    return dx * n, dy * n, dz * n


@jit
def turn(quaternion):
    """Rotation matrix of a quaternion of any length, by rows."""
    n = 1 / math.sqrt(quaternion[0] ** 2 + quaternion[1] ** 2 + quaternion[2] ** 2 + quaternion[3] ** 2 + 1e-12)
    w, x, y, z = quaternion[0] * n, quaternion[1] * n, quaternion[2] * n, quaternion[3] * n
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@jit
def covariance(scale, quaternion, out):
    r = turn(quaternion)
    s = (math.exp(2 * scale[0]), math.exp(2 * scale[1]), math.exp(2 * scale[2]))
    for i in range(3):
        for j in range(3):
            out[i, j] = r[i][0] * r[j][0] * s[0] + r[i][1] * r[j][1] * s[1] + r[i][2] * r[j][2] * s[2]


@jit
def jacobian(x, y, z, fx, fy, rotation):
    """Rows of the projection's derivative by places of the world."""
    a, b = fx / z, -fx * x / (z * z)
    c, d = fy / z, -fy * y / (z * z)
    t0 = (a * rotation[0, 0] + b * rotation[2, 0], a * rotation[0, 1] + b * rotation[2, 1], a * rotation[0, 2] + b * rotation[2, 2])
    t1 = (c * rotation[1, 0] + d * rotation[2, 0], c * rotation[1, 1] + d * rotation[2, 1], c * rotation[1, 2] + d * rotation[2, 2])
    return t0, t1


@jit
def quadratic(a, m, b):
    s = 0.0
    for i in range(3):
        s += a[i] * (m[i, 0] * b[0] + m[i, 1] * b[1] + m[i, 2] * b[2])
    return s


@jit
def decay(q):
    """exp(-q / 2) for 0 <= q <= 12, in steps that the compiler makes vectors of."""
    u = q * np.float32(-1 / 32)
    p = np.float32(1) + u * (np.float32(1) + u * (np.float32(1 / 2) + u * (np.float32(1 / 6) + u * (np.float32(1 / 24) + u * np.float32(1 / 120)))))
    p *= p
    p *= p
    p *= p
    return p * p


@jit
def span(flat, y, width):
    """First and past the last column that a Gaussian reaches in a row."""
    a, b, c = flat[2], flat[3], flat[4]
    dy = y - flat[1]
    inner = (b * dy) ** 2 - a * (c * dy * dy - flat[5])
    if inner <= 0:
        return 0, 0
    half = math.sqrt(inner) / a
    middle = flat[0] - b * dy / a
    return max(0, int(math.ceil(middle - half))), min(width, int(math.floor(middle + half)) + 1)


@jit
def draw(flat, colours, order, image, clear):
    """Adds the Gaussians from front to back; clear becomes what shines through."""
    height, width = clear.shape
    clear[:] = 1
    image[:] = 0
    for g in order:
        f = flat[g]
        red, green, blue, opacity = colours[g, 0], colours[g, 1], colours[g, 2], f[7]
        for y in range(max(0, int(math.ceil(f[1] - f[9]))), min(height, int(math.floor(f[1] + f[9])) + 1)):
            first, end = span(f, y, width)
            dy = np.float32(y) - f[1]
            across, down = np.float32(2) * f[3] * dy, f[4] * dy * dy
            for x in range(first, end):
                dx = np.float32(x) - f[0]
                alpha = min(np.float32(MOST), opacity * decay((f[2] * dx + across) * dx + down))
                weight = alpha * clear[y, x]
                image[0, y, x] += weight * red
                image[1, y, x] += weight * green
                image[2, y, x] += weight * blue
                clear[y, x] -= weight


@jit
def undraw(flat, colours, order, behind, clear, slope, by_flat, by_colours):
    """Derivatives from back to front. behind starts as the background and clear as what draw left; slope is the loss by the image."""
    height, width = clear.shape
    for at in range(order.size - 1, -1, -1):
        g = order[at]
        f = flat[g]
        red, green, blue, opacity = colours[g, 0], colours[g, 1], colours[g, 2], f[7]
        s, sx, sy, sxx, sxy, syy = np.float32(0), np.float32(0), np.float32(0), np.float32(0), np.float32(0), np.float32(0)
        sr, sg, sb = np.float32(0), np.float32(0), np.float32(0)
        for y in range(max(0, int(math.ceil(f[1] - f[9]))), min(height, int(math.floor(f[1] + f[9])) + 1)):
            first, end = span(f, y, width)
            dy = np.float32(y) - f[1]
            across, down = np.float32(2) * f[3] * dy, f[4] * dy * dy
            r0, r1, r2 = np.float32(0), np.float32(0), np.float32(0)
            for x in range(first, end):
                dx = np.float32(x) - f[0]
                full = opacity * decay((f[2] * dx + across) * dx + down)
                alpha = min(np.float32(MOST), full)
                rest = np.float32(1) - alpha
                before = clear[y, x] / rest
                clear[y, x] = before
                d0, d1, d2 = slope[0, y, x], slope[1, y, x], slope[2, y, x]
                weight = alpha * before
                sr += weight * d0
                sg += weight * d1
                sb += weight * d2
                b0, b1, b2 = behind[0, y, x], behind[1, y, x], behind[2, y, x]
                by_alpha = before * ((red - b0) * d0 + (green - b1) * d1 + (blue - b2) * d2)
                behind[0, y, x] = b0 * rest + alpha * red
                behind[1, y, x] = b1 * rest + alpha * green
                behind[2, y, x] = b2 * rest + alpha * blue
                pull = by_alpha * full if full < np.float32(MOST) else np.float32(0)
                r0 += pull
                r1 += pull * dx
                r2 += pull * dx * dx
            s += r0
            sx += r1
            sy += r0 * dy
            sxx += r2
            sxy += r1 * dy
            syy += r0 * dy * dy
        # The loss by the exponent q is -pull / 2; q = a dx² + 2 b dx dy + c dy².
        by_flat[g, 0] = f[2] * sx + f[3] * sy
        by_flat[g, 1] = f[3] * sx + f[4] * sy
        by_flat[g, 2], by_flat[g, 3], by_flat[g, 4] = -0.5 * sxx, -0.5 * sxy, -0.5 * syy
        by_flat[g, 5] = s / opacity
        by_colours[g, 0], by_colours[g, 1], by_colours[g, 2] = sr, sg, sb


@jit
def unproject(means, scales, quaternions, harmonics, rotation, translation, camera, order, flat, colours, by_flat, by_colours, by):
    """Carries the derivatives from the image to the parameters: by[g] = mean 3, scale 3, quaternion 4, opacity, harmonics 12."""
    fx, fy, cx, cy = camera
    cover = np.zeros((3, 3), np.float32)
    m = np.zeros((3, 3), np.float32)
    by_r = np.zeros((3, 3), np.float32)
    for g in order:
        f = flat[g]
        x = rotation[0, 0] * means[g, 0] + rotation[0, 1] * means[g, 1] + rotation[0, 2] * means[g, 2] + translation[0]
        y = rotation[1, 0] * means[g, 0] + rotation[1, 1] * means[g, 1] + rotation[1, 2] * means[g, 2] + translation[1]
        z = f[6]
        # Covariance in the image: minus conic · derivative by the conic · conic.
        a, b, c = f[2], f[3], f[4]
        ga, gb, gc = by_flat[g, 2], by_flat[g, 3], by_flat[g, 4]
        k00, k01 = a * ga + b * gb, a * gb + b * gc
        k10, k11 = b * ga + c * gb, b * gb + c * gc
        v00, v01, v11 = -(k00 * a + k01 * b), -(k00 * b + k01 * c), -(k10 * b + k11 * c)
        covariance(scales[g], quaternions[g], cover)
        t0, t1 = jacobian(x, y, z, fx, fy, rotation)
        # Covariance in the world (symmetric): t' v t.
        for i in range(3):
            for j in range(3):
                m[i, j] = t0[i] * (v00 * t0[j] + v01 * t1[j]) + t1[i] * (v01 * t0[j] + v11 * t1[j])
        r = turn(quaternions[g])
        for k in range(3):
            variance = math.exp(2 * scales[g, k])
            c0 = m[0, 0] * r[0][k] + m[0, 1] * r[1][k] + m[0, 2] * r[2][k]
            c1 = m[1, 0] * r[0][k] + m[1, 1] * r[1][k] + m[1, 2] * r[2][k]
            c2 = m[2, 0] * r[0][k] + m[2, 1] * r[1][k] + m[2, 2] * r[2][k]
            by[g, 3 + k] = 2 * variance * (r[0][k] * c0 + r[1][k] * c1 + r[2][k] * c2)
            by_r[0, k], by_r[1, k], by_r[2, k] = 2 * variance * c0, 2 * variance * c1, 2 * variance * c2
        n = 1 / math.sqrt(quaternions[g, 0] ** 2 + quaternions[g, 1] ** 2 + quaternions[g, 2] ** 2 + quaternions[g, 3] ** 2 + 1e-12)
        qw, qx, qy, qz = quaternions[g, 0] * n, quaternions[g, 1] * n, quaternions[g, 2] * n, quaternions[g, 3] * n
        dw = 2 * (qz * (by_r[1, 0] - by_r[0, 1]) + qy * (by_r[0, 2] - by_r[2, 0]) + qx * (by_r[2, 1] - by_r[1, 2]))
        dx = 2 * (qy * (by_r[0, 1] + by_r[1, 0]) + qz * (by_r[0, 2] + by_r[2, 0]) + qw * (by_r[2, 1] - by_r[1, 2])) - 4 * qx * (by_r[1, 1] + by_r[2, 2])
        dy = 2 * (qx * (by_r[0, 1] + by_r[1, 0]) + qz * (by_r[1, 2] + by_r[2, 1]) + qw * (by_r[0, 2] - by_r[2, 0])) - 4 * qy * (by_r[0, 0] + by_r[2, 2])
        dz = 2 * (qx * (by_r[0, 2] + by_r[2, 0]) + qy * (by_r[1, 2] + by_r[2, 1]) + qw * (by_r[1, 0] - by_r[0, 1])) - 4 * qz * (by_r[0, 0] + by_r[1, 1])
        along = dw * qw + dx * qx + dy * qy + dz * qz
        by[g, 6], by[g, 7], by[g, 8], by[g, 9] = (dw - along * qw) * n, (dx - along * qx) * n, (dy - along * qy) * n, (dz - along * qz) * n
        by[g, 10] = by_flat[g, 5] * f[7] * (1 - f[7])
        # Mean: by its place in the image, and by the projection's derivative.
        w0 = quadratic_row(t0, cover)
        w1 = quadratic_row(t1, cover)
        e0 = (2 * (v00 * w0[0] + v01 * w1[0]), 2 * (v00 * w0[1] + v01 * w1[1]), 2 * (v00 * w0[2] + v01 * w1[2]))
        e1 = (2 * (v01 * w0[0] + v11 * w1[0]), 2 * (v01 * w0[1] + v11 * w1[1]), 2 * (v01 * w0[2] + v11 * w1[2]))
        j00 = e0[0] * rotation[0, 0] + e0[1] * rotation[0, 1] + e0[2] * rotation[0, 2]
        j02 = e0[0] * rotation[2, 0] + e0[1] * rotation[2, 1] + e0[2] * rotation[2, 2]
        j11 = e1[0] * rotation[1, 0] + e1[1] * rotation[1, 1] + e1[2] * rotation[1, 2]
        j12 = e1[0] * rotation[2, 0] + e1[1] * rotation[2, 1] + e1[2] * rotation[2, 2]
        z2, z3 = z * z, z * z * z
        tx = by_flat[g, 0] * fx / z - j02 * fx / z2
        ty = by_flat[g, 1] * fy / z - j12 * fy / z2
        tz = -(by_flat[g, 0] * fx * x + by_flat[g, 1] * fy * y) / z2 - j00 * fx / z2 - j11 * fy / z2 + 2 * (j02 * fx * x + j12 * fy * y) / z3
        for k in range(3):
            by[g, k] = rotation[0, k] * tx + rotation[1, k] * ty + rotation[2, k] * tz
        ex, ey, ez = direction(means[g], rotation, translation)
        for k in range(3):
            d = by_colours[g, k] if colours[g, k] > 0 else np.float32(0)
            by[g, 11 + k] = d * SH0
            by[g, 14 + k] = -d * SH1 * ey
            by[g, 17 + k] = d * SH1 * ez
            by[g, 20 + k] = -d * SH1 * ex


@jit
def quadratic_row(t, m):
    return (
        t[0] * m[0, 0] + t[1] * m[1, 0] + t[2] * m[2, 0],
        t[0] * m[0, 1] + t[1] * m[1, 1] + t[2] * m[2, 1],
        t[0] * m[0, 2] + t[1] * m[1, 2] + t[2] * m[2, 2],
    )


@jit
def adam(values, slopes, first, second, seen, rates, step):
    """One step for the Gaussians seen."""
    fix1, fix2 = 1 - 0.9**step, 1 - 0.999**step
    for g in seen:
        for k in range(values.shape[1]):
            s = slopes[g, k]
            first[g, k] = 0.9 * first[g, k] + 0.1 * s
            second[g, k] = 0.999 * second[g, k] + 0.001 * s * s
            values[g, k] -= rates[k] * (first[g, k] / fix1) / (math.sqrt(second[g, k] / fix2) + 1e-15)


# ---------------------------------------------------------------- loss


def smooth(planes):
    """Gaussian window of SSIM; its own adjoint, as outside the image is nothing."""
    return np.stack([cv2.GaussianBlur(plane, (11, 11), 1.5, borderType=cv2.BORDER_CONSTANT) for plane in planes])


def ssim(a, b, with_slope=False):
    """Map of SSIM, and the derivative of its sum by a."""
    c1, c2 = np.float32(0.01**2), np.float32(0.03**2)
    ma, mb = smooth(a), smooth(b)
    va, vb, vab = smooth(a * a) - ma * ma, smooth(b * b) - mb * mb, smooth(a * b) - ma * mb
    n1, n2 = 2 * ma * mb + c1, 2 * vab + c2
    d1, d2 = ma * ma + mb * mb + c1, va + vb + c2
    value = n1 * n2 / (d1 * d2)
    if not with_slope:
        return value
    by_va, by_vab = -value / d2, 2 * n1 / (d1 * d2)
    by_ma = 2 * mb * n2 / (d1 * d2) - 2 * ma * value / d1 - 2 * ma * by_va - mb * by_vab
    return value, smooth(by_ma) + 2 * a * smooth(by_va) + b * smooth(by_vab)


# ---------------------------------------------------------------- training

RATES = np.repeat(np.array([0, 0.005, 0.001, 0.05, 0.0025, 0.0025 / 4], np.float32), [3, 3, 4, 1, 3, 9])


class Splat:
    """All parameters in one table: mean 3, log scale 3, quaternion 4, logit of opacity, harmonics 12."""

    def __init__(self, table):
        self.table = np.ascontiguousarray(table, np.float32)
        self.first, self.second = np.zeros_like(self.table), np.zeros_like(self.table)

    def parts(self):
        t = self.table
        return t[:, :3], t[:, 3:6], t[:, 6:10], t[:, 10], t[:, 11:23].reshape(-1, 4, 3)

    def keep(self, mask, added=None):
        added = np.zeros((0, self.table.shape[1]), np.float32) if added is None else added
        self.table = np.concatenate([self.table[mask], added])
        self.first = np.concatenate([self.first[mask], np.zeros_like(added)])
        self.second = np.concatenate([self.second[mask], np.zeros_like(added)])


def started(scene, chosen, limit, random):
    """Gaussians at the sparse points that two of the images observe."""
    seen = np.bincount(scene.tracks[np.isin(scene.tracks[:, 0], chosen), 1], minlength=len(scene.points))
    points, colours = scene.points[seen >= 2], scene.colours[seen >= 2]
    if len(points) < 500:
        low, high = np.percentile(scene.points, 1, axis=0), np.percentile(scene.points, 99, axis=0)
        extra = random.uniform(low, high, (2000 - len(points), 3)).astype(np.float32)
        points, colours = np.concatenate([points, extra]), np.concatenate([colours, random.uniform(0, 1, extra.shape).astype(np.float32)])
    if len(points) > limit // 2:
        taken = random.permutation(len(points))[: limit // 2]
        points, colours = points[taken], colours[taken]
    spacing = np.clip(np.sqrt(neighbours(points)), 1e-7, None)
    table = np.zeros((len(points), 23), np.float32)
    table[:, :3] = points
    table[:, 3:6] = np.log(spacing)[:, None]
    table[:, 6] = 1
    table[:, 10] = math.log(0.1 / 0.9)
    table[:, 11:14] = (colours - 0.5) / SH0
    return Splat(table)


@jit
def neighbours(points):
    """Mean squared distance to the three nearest others."""
    out = np.empty(len(points), np.float32)
    for i in range(len(points)):
        a = b = c = np.float32(np.inf)
        for j in range(len(points)):
            if i != j:
                d = (points[i, 0] - points[j, 0]) ** 2 + (points[i, 1] - points[j, 1]) ** 2 + (points[i, 2] - points[j, 2]) ** 2
                if d < a:
                    a, b, c = d, a, b
                elif d < b:
                    b, c = d, b
                elif d < c:
                    c = d
        out[i] = (a + b + c) / 3
    return out


class Renderer:
    def __init__(self, scene):
        self.scene = scene
        height, width = scene.images.shape[2:]
        self.image, self.clear = np.empty((3, height, width), np.float32), np.empty((height, width), np.float32)
        centres = -np.einsum("nji,nj->ni", scene.rotations, scene.translations)
        self.extent = 1.1 * float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
        self.near = 0.01 * self.extent

    def render(self, splat, view):
        s, (height, width) = self.scene, self.clear.shape
        camera = tuple(s.intrinsics[view])
        flat, colours = project(*splat.parts(), s.rotations[view], s.translations[view], camera, width, height, self.near)
        x, y, w, h, depth = flat[:, 0], flat[:, 1], flat[:, 8], flat[:, 9], flat[:, 6]
        seen = np.flatnonzero((depth > 0) & (x + w > 0) & (x - w < width) & (y + h > 0) & (y - h < height))
        order = seen[np.argsort(depth[seen], kind="stable")]
        draw(flat, colours, order, self.image, self.clear)
        return flat, colours, order, self.image + self.clear * s.background[:, None, None]

    def back(self, splat, view, flat, colours, order, slope):
        s, n = self.scene, len(flat)
        behind = np.empty_like(self.image)
        behind[:] = s.background[:, None, None]
        by_flat, by_colours, by = np.zeros((n, 6), np.float32), np.zeros((n, 3), np.float32), np.zeros((n, 23), np.float32)
        undraw(flat, colours, order, behind, self.clear, slope, by_flat, by_colours)
        means, scales, quaternions, _, harmonics = splat.parts()
        unproject(means, scales, quaternions, harmonics, s.rotations[view], s.translations[view], tuple(s.intrinsics[view]), order, flat, colours, by_flat, by_colours, by)
        return by, by_flat


def train(scene, chosen, iterations, limit, seed):
    random = np.random.default_rng(seed)
    renderer = Renderer(scene)
    splat = started(scene, chosen, limit, random)
    moved, counted = np.zeros(len(splat.table)), np.zeros(len(splat.table))
    rates, queue = RATES.copy(), []
    grow_from, grow_to, every = iterations // 10, iterations * 6 // 10, max(1, iterations // 30)
    for step in range(1, iterations + 1):
        if not queue:
            queue = list(random.permutation(chosen))
        view = queue.pop()
        rates[:3] = 4e-4 * renderer.extent * 0.01 ** (step / iterations)
        flat, colours, order, image = renderer.render(splat, view)
        truth, inside = scene.images[view], scene.inside[view]
        structure, structure_slope = ssim(image, truth, True)
        size = np.float32(image.size)
        slope = (np.float32(0.8) * np.sign(image - truth) - np.float32(0.2) * structure_slope) * inside / size
        by, by_flat = renderer.back(splat, view, flat, colours, order, slope)
        adam(splat.table, by, splat.first, splat.second, order, rates, step)
        if step < grow_to:
            moved[order] += np.hypot(by_flat[order, 0], by_flat[order, 1])
            counted[order] += 1
            if step >= grow_from and step % every == 0:
                densify(splat, moved, counted, limit, renderer.extent, random)
                moved, counted = np.zeros(len(splat.table)), np.zeros(len(splat.table))
    return renderer, splat


def densify(splat, moved, counted, limit, extent, random):
    """Removes what can't be seen, and doubles what moves most: at most a fifth more at a time."""
    table = splat.table
    opacity = 1 / (1 + np.exp(-table[:, 10]))
    largest = np.exp(table[:, 3:6]).max(1)
    alive = (opacity > 0.005) & (largest < extent)
    score = np.where(alive, moved / np.maximum(counted, 1), 0)
    room = min(limit - alive.sum(), alive.sum() // 5)
    if room <= 0:
        splat.keep(alive)
        return
    parents = np.argsort(-score, kind="stable")[:room]
    parents = parents[score[parents] > 0]
    children = table[parents].copy()
    scale, (w, x, y, z) = np.exp(children[:, 3:6]), (children[:, 6:10] / np.linalg.norm(children[:, 6:10], axis=1, keepdims=True)).T
    turned = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    shift = np.einsum("nij,nj->ni", turned, scale * random.normal(size=scale.shape) * 0.7).astype(np.float32)
    table[parents, :3] -= shift / 2
    children[:, :3] += shift / 2
    table[parents, 3:6] -= math.log(1.4)
    children[:, 3:6] -= math.log(1.4)
    # Two of them together hide as much as the one did.
    shared = np.clip(1 - np.sqrt(1 - np.clip(opacity[parents], 0, 0.99)), 0.006, 0.99)
    table[parents, 10] = children[:, 10] = np.log(shared / (1 - shared))
    splat.keep(alive, children)


def measure(scene, renderer, splat):
    """Means over the held-out views."""
    psnr, similar = [], []
    for view in np.flatnonzero(scene.held_out):
        image = np.clip(renderer.render(splat, view)[3], 0, 1)
        truth, inside = scene.images[view], scene.inside[view] > 0
        psnr.append(decibels(image, truth, inside))
        similar.append(float(ssim(image, truth)[:, inside].mean()))
    return {"psnr": np.mean(psnr), "ssim": np.mean(similar)}


def decibels(image, truth, inside):
    return float(-10 * np.log10(np.mean((image - truth)[:, inside] ** 2)))
