#!/usr/bin/env python3
"""What a project's first depth maps do to the forecast of the rest (docs/benchmarks.md).

    adapt.py FOLDER... [--viewrank target/release/viewrank] [--maps rules/k5/ours] [--backend sgm] [--first 5]

Each FOLDER is what integrations/sgm/experiments.py wrote. Printed per set, as shares of what is wanted of all triangles (every depth counts as right):

    real       what all depth maps keep
    forecast   what they are predicted to keep before the first map is made
    finished   the same with the plan's first maps measured (`viewrank plan --finished`)
    trained    the same with numbers fitted to the first maps (`viewrank train`)
    both       the same with both

Writes nothing but temporary folders.
"""

import json
import shutil
import tempfile
from pathlib import Path

from predictor import arguments, copy, run


def main():
    parser = arguments(__doc__)
    parser.add_argument("--first", type=int, default=5, help="number of finished maps")
    options = parser.parse_args()
    print("| set | real | forecast | finished | trained | both |\n|---|---|---|---|---|---|")
    for folder in options.folders:
        print("| " + " | ".join([folder.name, *(f"{share:.2f}" for share in shares(folder, options))]) + " |", flush=True)


def shares(folder, options):
    with tempfile.TemporaryDirectory() as scratch:
        project, first = copy(folder, Path(scratch) / folder.name), Path(scratch) / "first"
        forecast = reachable(project, options)
        real = kept(project, folder, options)
        maps = folder / options.maps
        keys = [cluster["key"] for cluster in manifest(project)["clusters"]]
        finished = [path for path in (maps / "depth_maps" / f"{key}.npy" for key in keys) if path.exists()]
        first.mkdir()
        for path in finished[: options.first]:
            shutil.copy(path, first)
        learnt = Path(scratch) / "learnt.toml"
        run(options, "train", project, "--depth-maps", first, "--backend", options.backend, "--out", learnt, "--quiet")
        measured = reachable(project, options, "--finished", first)
        settings = project / "viewrank.toml"
        settings.write_text(learnt.read_text() + settings.read_text())
        trained = reachable(project, options)
        return real, forecast, measured, trained, reachable(project, options, "--finished", first)


def reachable(project, options, *more):
    """What all clusters are expected to keep."""
    run(options, "plan", project, "--backend", options.backend, "-k", 5, "--budget", "100%", "--target", "100%", *more, "--quiet")
    return manifest(project)["cut"]["reachable"]


def manifest(project):
    return json.loads((project / "viewrank/manifest.json").read_text())


def kept(project, folder, options):
    maps, out = folder / options.maps, project / "out"
    run(options, "evaluate", project, "--depth-maps", maps, "--clusters", maps / "clusters.txt", "--out", out, "--quiet")
    return json.loads((out / "evaluation.json").read_text())["kept"]["real"]


if __name__ == "__main__":
    main()
