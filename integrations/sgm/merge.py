"""Merges the pairs of a key view: a pixel gets the depth on which most of its partners agree."""

import numpy as np

from matching import drop_patches

SIGMA_PX = 0.4  # standard deviation of a disparity, pixels of the coarser image
MIN_AGREE = 2
SPECKLE_PIXELS, SPECKLE_SIGMAS = 40, 6
BLOCK_PIXELS = 60_000  # worked on at once, so that memory stays bounded


def merge(inverses, deviations, min_agree=MIN_AGREE):
    """Depth (float32, 0 = none) and number of agreeing partners (uint8) from k maps of inverse depth and their deviations per pixel of error.

    Two hypotheses agree when they are within two standard deviations of their difference. The one that most agree with wins, the finer at a tie.
    """
    shape = inverses[0].shape
    inverse, deviation, count = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32), np.zeros(shape, np.uint8)
    rows = max(1, BLOCK_PIXELS // shape[1])
    for top in range(0, shape[0], rows):
        part = np.s_[top : top + rows]
        inverse[part], deviation[part], count[part] = consensus(
            np.stack([i[part] for i in inverses]), SIGMA_PX * np.stack([d[part] for d in deviations]), min_agree)
    if np.isfinite(inverse).any():
        unit = float(np.nanmedian(deviation))
        drop_patches(inverse, SPECKLE_PIXELS, SPECKLE_SIGMAS * unit)
    known = np.isfinite(inverse)
    depth = np.where(known, 1 / np.where(known, inverse, 1), 0).astype(np.float32)
    return depth, np.where(known, count, 0).astype(np.uint8)


def consensus(w, s, min_agree):
    """Inverse depth, its standard deviation and the number of supporters, per pixel, from hypotheses w with deviations s (k x h x w)."""
    variance = s * s
    votes = np.isfinite(w).astype(np.float32)
    with np.errstate(invalid="ignore"):
        for i in range(1, len(w)):
            for j in range(i):
                agree = (w[i] - w[j]) ** 2 <= 4 * (variance[i] + variance[j])
                votes[i] += agree
                votes[j] += agree
        finest = np.fmin.reduce(s)
        best = np.argmax(votes + np.nan_to_num(0.5 * finest / s), axis=0)[None]
        centre, spread = np.take_along_axis(w, best, 0), np.take_along_axis(variance, best, 0)
        support = (w - centre) ** 2 <= 4 * (variance + spread)
        weight = np.where(support, 1 / variance, 0)
        total = weight.sum(0)
        count = support.sum(0)
        total = np.where(count >= min_agree, total, np.nan)
        return np.where(support, w * weight, 0).sum(0) / total, 1 / np.sqrt(total), count
