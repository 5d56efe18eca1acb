"""Matches one pair: semi-global matching on the common canvas, then a least-squares step per pixel, back to the key view."""

import cv2
import numpy as np

from rectify import canvas_pixels, key_on_canvas

BLOCK = 5
SMALL_JUMP, LARGE_JUMP = 6, 64  # penalties of a disparity change by one and by more, times the area of the block
UNIQUENESS = 10  # percent by which the best cost must beat the next
WINDOW = 9  # of the least-squares step, pixels
MIN_CORRELATION = 0.4  # of the two windows; below it a match is dropped
SPECKLE_PIXELS, SPECKLE_JUMP = 60, 1  # connected patches smaller than this are dropped; neighbours differ by at most this disparity


def match(pair, key_image, key_mask, partner_image, partner_mask):
    """Inverse z-depth in the key view (float32, nan where unknown). Masks are true where the image may be matched, or None."""
    left, in_key, right, in_partner = canvases(pair, key_image, key_mask, partner_image, partner_mask)
    disparity = semi_global(left, right, pair.canvas.low, pair.canvas.count)
    disparity[~in_key | ~shown(disparity, in_partner)] = np.nan
    disparity, correlation = least_squares(left, right, disparity)
    disparity[correlation < MIN_CORRELATION] = np.nan
    drop_patches(disparity, SPECKLE_PIXELS, SPECKLE_JUMP)
    inverse = to_key_view(pair, disparity, key_image.shape[::-1])
    if key_mask is not None:
        inverse[~key_mask] = np.nan  # its edge is sharper than the canvas
    return inverse


def canvases(pair, key_image, key_mask, partner_image, partner_mask):
    """Both images on the canvas, and where they are inside their pictures and masks."""
    key, partner, front = canvas_pixels(pair)
    if pair.scale > 4 / 3:  # the partner is finer: take its detail away that the canvas can't hold
        partner_image = cv2.GaussianBlur(partner_image, (0, 0), 0.5 * (pair.scale**2 - 1) ** 0.5)
    return *on_canvas(key_image, key_mask, *key), *on_canvas(partner_image, partner_mask, *partner, front)


def on_canvas(image, mask, x, y, front=True):
    h, w = image.shape
    inside = (x > -0.5) & (x < w - 0.5) & (y > -0.5) & (y < h - 0.5) & front
    x, y = x.astype(np.float32), y.astype(np.float32)
    if mask is not None:
        inside &= cv2.remap(mask.astype(np.uint8), x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT) > 0
    return cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), inside


def semi_global(left, right, low, count):
    """Disparity of the left canvas in pixels. OpenCV drops what the right canvas matches elsewhere by more than a pixel."""
    area = BLOCK * BLOCK
    matcher = cv2.StereoSGBM_create(
        minDisparity=low, numDisparities=count, blockSize=BLOCK, P1=SMALL_JUMP * area, P2=LARGE_JUMP * area, disp12MaxDiff=1,
        preFilterCap=31, uniquenessRatio=UNIQUENESS, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    sixteenths = matcher.compute(left, right)
    return np.where(sixteenths > (low - 1) * 16, sixteenths.astype(np.float32) / 16, np.float32(np.nan))


def shown(disparity, in_partner):
    """True where the match is inside the partner's image."""
    h, w = disparity.shape
    column = np.arange(w)[None, :] - np.rint(np.nan_to_num(disparity)).astype(np.int32)
    return np.take_along_axis(in_partner, column.clip(0, w - 1), 1) & (column >= 0) & (column < w) & np.isfinite(disparity)


def least_squares(left, right, disparity):
    """One Gauss-Newton step on the windows' squared difference, brightness and contrast removed, and the windows' correlation.

    Semi-global matching alone prefers whole and half pixels; this halves its error where it was right, and the correlation tells where it wasn't.
    """
    known = np.isfinite(disparity)
    mask = known.astype(np.float32)
    d = np.where(known, disparity, 0).astype(np.float32)
    left, right = left.astype(np.float32), right.astype(np.float32)
    x, y = np.meshgrid(np.arange(d.shape[1], dtype=np.float32), np.arange(d.shape[0], dtype=np.float32))
    slope = cv2.Sobel(right, cv2.CV_32F, 1, 0, scale=1 / 8)
    a = left * mask
    b, g = (cv2.remap(image, x - d, y, cv2.INTER_LINEAR) * mask for image in (right, slope))
    count = np.maximum(window_sum(mask), 1)
    mean_a, mean_b, mean_g = (window_sum(i) / count for i in (a, b, g))
    product = lambda i, mean_i, j, mean_j: window_sum(i * j) / count - mean_i * mean_j
    var_a = np.maximum(product(a, mean_a, a, mean_a), 1e-3)
    var_b = np.maximum(product(b, mean_b, b, mean_b), 1e-3)
    contrast = np.sqrt(var_b / var_a)
    step = (product(g, mean_g, b, mean_b) - contrast * product(g, mean_g, a, mean_a)) / (product(g, mean_g, g, mean_g) + 1)
    correlation = product(a, mean_a, b, mean_b) / np.sqrt(var_a * var_b)
    return disparity + step.clip(-1, 1), correlation


def window_sum(image):
    return cv2.boxFilter(image, -1, (WINDOW, WINDOW), normalize=False, borderType=cv2.BORDER_CONSTANT)


def drop_patches(values, pixels, jump):
    """Sets connected patches of fewer than `pixels` to nan, in place; neighbours belong together up to `jump` apart."""
    known = np.isfinite(values)
    if not known.any():
        return
    levels = np.zeros(values.shape, np.int16)
    fine = 16 / jump
    levels[known] = 1 + ((values[known] - values[known].min()) * fine).clip(0, 32000)
    cv2.filterSpeckles(levels, 0, pixels, 16)
    values[levels == 0] = np.nan


def to_key_view(pair, disparity, size):
    """Inverse depth at the key view's pixels: between canvas pixels where these agree, else the nearest."""
    column, row = key_on_canvas(pair, size)
    read = lambda how: cv2.remap(disparity, column, row, how, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
    nearest, smooth = read(cv2.INTER_NEAREST), read(cv2.INTER_LINEAR)
    with np.errstate(invalid="ignore", divide="ignore"):
        d = np.where(np.abs(smooth - nearest) < 0.75, smooth, nearest)
        inverse = pair.parallax.inverse_depth(np.arange(size[0])[None, :], np.arange(size[1])[:, None], d)
        return np.where(inverse > 0, inverse, np.nan).astype(np.float32)
