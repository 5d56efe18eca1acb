"""Binary PLY of a mesh with a material for each face."""

import numpy as np

FACE = np.dtype([("n", "u1"), ("i", "<i4", 3), ("material", "u1")])


def write(path, surface, comment):
    """Vertices at one place are joined, and faces that have no area left out. Returns the number of faces."""
    vertices, new = np.unique(surface.vertices, axis=0, return_inverse=True)
    faces = new.reshape(-1)[surface.faces]
    real = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    records = np.empty(real.sum(), FACE)
    records["n"], records["i"], records["material"] = 3, faces[real], surface.materials[real]
    xyz = "".join("property float %s\n" % axis for axis in "xyz")
    header = "ply\nformat binary_little_endian 1.0\ncomment %s\nelement vertex %d\n%s" % (comment, len(vertices), xyz)
    header += "element face %d\nproperty list uchar int vertex_indices\nproperty uchar material\nend_header\n" % len(records)
    path.write_bytes(header.encode() + vertices.astype("<f4").tobytes() + records.tobytes())
    return len(records)


def read(path):
    """Vertices, faces, materials of a file that `write` made."""
    read = path.read_bytes()
    end = read.index(b"end_header\n") + 11
    header = read[:end].decode().split("\n")
    vertices, faces = (int(line.split()[2]) for line in header if line.startswith("element"))
    records = np.frombuffer(read, FACE, faces, end + 12 * vertices)
    return np.frombuffer(read, "<f4", 3 * vertices, end).reshape(-1, 3), records["i"].copy(), records["material"].copy()
