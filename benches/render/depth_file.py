"""Files of exact depth: NAME.npz with `lo`, `hi`, `mask`, and indoors `fine`.

z-depth in units of STEP as uint16; stored are the differences along both axes (modulo 65536), zigzag coded, low and high bytes apart, which
compresses well. `mask`: 0 none or sky, 1 static, 2 leaves that move (no depth), 3 water. `fine`: the rest in units of STEP / FINE.
"""

import numpy as np

STEP = 0.003
FINE = 16
STATIC, WATER = 1, 3


def write(path, z, mask, fine=False):
    q, valid = np.rint(z / STEP).astype(np.int64), (mask == STATIC) | (mask == WATER)
    # The last valid value is carried over holes.
    last = np.where(valid.ravel(), np.arange(q.size), -1)
    np.maximum.accumulate(last, out=last)
    filled = np.where(last >= 0, q.ravel()[np.maximum(last, 0)], 0).reshape(q.shape)
    r = np.diff(np.diff(filled, axis=0, prepend=0), axis=1, prepend=0).astype(np.int16).astype(np.int32)
    zigzag = ((r << 1) ^ (r >> 31)).astype(np.uint16)
    rest = np.where(valid, np.rint((z / STEP - q) * FINE), 0) + FINE // 2
    more = dict(fine=rest.astype(np.uint8)) if fine else {}
    np.savez_compressed(path, lo=(zigzag & 255).astype(np.uint8), hi=(zigzag >> 8).astype(np.uint8), mask=mask, **more)


def read(path):
    """Metres along the optical axis as float32 (0 where there is none), and the mask."""
    file = np.load(path)
    mask, zigzag = file["mask"], file["hi"].astype(np.uint16) * 256 + file["lo"]
    r = (zigzag >> 1) ^ (0 - (zigzag & 1)).astype(np.uint16)
    q = np.cumsum(np.cumsum(r, axis=0, dtype=np.uint16), axis=1, dtype=np.uint16)
    if "fine" in file:
        q = q + (file["fine"].astype(np.float32) - FINE // 2) / FINE
    return np.where((mask == STATIC) | (mask == WATER), q * np.float32(STEP), 0).astype(np.float32), mask
