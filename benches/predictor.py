#!/usr/bin/env python3
"""How good the confidence is where nothing was fitted to it: one command, one table (docs/benchmarks.md).

    predictor.py FOLDER... [--viewrank target/release/viewrank] [--maps rules/k5/ours] [--backend sgm]

Each FOLDER is what integrations/sgm/experiments.py wrote: a project with the depth maps of its view clusters and their clusters.txt in --maps, and
truth/depth if it is rendered. The label is "the map has a depth there", per (cluster, triangle) and weighted by nothing. Printed per set and source
(none, geometric, photometric with the backend's numbers, photometric with numbers fitted by `viewrank train` to all other sets):

    seen         area under the ROC curve: does f_conf part triangles of which more than half of the pixels have a depth from all others seen?
    covered      the same among triangles that enough partners see
    calibration  mean distance between predicted and real share over ten ranges of prediction, all that is seen
    accurate     where the scene is known: share of the pixels with a depth that are right within 3 a_d, and how well f_conf parts these triangles

Needs numpy. Writes nothing but temporary folders; plans of the FOLDERs are made anew and end as they were.
"""

import argparse
import json
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

SOURCES = ["none", "geometric", "photometric", "fitted"]


def main():
    options = arguments(__doc__).parse_args()
    print("| set | confidence | seen | covered | calibration | key views for 50, 70, 80, 90 % | accurate |\n|---|---|---|---|---|---|---|")
    for folder in options.folders:
        for source in SOURCES:
            print(row(folder, source, options), flush=True)


def arguments(text):
    """The options that say which sets, and what of them."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--viewrank", default="viewrank")
    parser.add_argument("--maps", default="rules/k5/ours", help="folder of depth maps in each FOLDER")
    parser.add_argument("--backend", default="sgm")
    return parser


def row(folder, source, options):
    with tempfile.TemporaryDirectory() as scratch:
        project = copy(folder, Path(scratch) / folder.name)
        settings = project / "viewrank.toml"
        if source == "fitted":
            others = [other for other in options.folders if other != folder]
            if not others:
                return f"| {folder.name} | fitted | – | – | – | – | – |"
            learnt = Path(scratch) / "learnt.toml"
            run(options, "train", *others, "--depth-maps", options.maps, "--backend", options.backend, "--out", learnt, "--quiet")
            settings.write_text(learnt.read_text() + settings.read_text())
        confidence = "photometric" if source == "fitted" else source
        run(options, "plan", project, "--backend", options.backend, "-k", 5, "--confidence", confidence, "--quiet")
        depth, evaluation = tables(project, folder, None, options)
        truth = folder / "truth/depth"
        right = tables(project, folder, truth, options)[0] if truth.exists() else None
    return f"| {folder.name} | {source} | {figures(depth)} | {needed(evaluation)} | {accuracy(depth, right)} |"


def copy(folder, project):
    """The project without its plan; images and model as links."""
    project.mkdir()
    for part in ("images", "sparse"):
        (project / part).symlink_to((folder / part).resolve())
    shutil.copy(folder / "viewrank.toml", project)
    return project


def run(options, *words):
    subprocess.run([options.viewrank, *map(str, words)], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def tables(project, folder, truth, options):
    """Predicted and real share of each (cluster, triangle) that partners see, how many others are seen, and evaluation.json."""
    out, maps = project / "out", folder / options.maps
    shutil.rmtree(out, ignore_errors=True)
    reference = ["--reference", truth] if truth else []
    run(options, "evaluate", project, "--depth-maps", maps, "--clusters", maps / "clusters.txt", *reference, "--baselines", "--dump-tables",
        out / "tables", "--out", out)
    read = {path.stem: np.load(path) for path in (out / "tables").glob("*.npy")}
    keys = lambda name: read[name].astype(np.int64) @ np.array([1 << 32, 1])  # noqa: E731

    def at(name):
        of, values = keys(name), np.zeros(len(read["real_nocp"]))
        _, here, there = np.intersect1d(keys("real_nocp"), of, return_indices=True)
        values[here] = read[name + "_value"][there]
        return values

    seen = np.bincount(read["visible"][:, 0], minlength=read["real_key"].max() + 1)[read["real_key"]].sum()
    share = lambda part, whole: np.clip(part / np.maximum(whole, 1e-12), 0, 1)  # noqa: E731
    table = {
        "chance": share(at("real_predicted"), read["real_nocp_value"]),
        "share": share(at("real"), at("real_attainable")),
        "others": int(seen) - len(read["real_nocp"]),
    }
    return table, json.loads((out / "evaluation.json").read_text())


def figures(table):
    nothing = np.zeros(table["others"])
    chance, share = np.concatenate([table["chance"], nothing]), np.concatenate([table["share"], nothing])
    ranges = np.minimum((chance * 10).astype(int), 9)
    apart = sum(abs((chance - share)[ranges == r].sum()) for r in range(10)) / len(chance)
    return f"{area(chance, share > 0.5):.3f} | {area(table['chance'], table['share'] > 0.5):.3f} | {apart:.3f}"


def accuracy(depth, right):
    if right is None:
        return "–"
    matched = depth["share"] > 0.5
    accurate = right["share"][matched] / depth["share"][matched]
    return f"{accurate.mean():.2f}, {area(depth['chance'][matched], accurate > 0.5):.3f}"


def needed(evaluation):
    ours = next(order for order in evaluation["orders"] if order["name"] == "ours")
    clusters = {round(at["share"], 2): at["clusters"] for at in ours["needed"]}
    return ", ".join(f"{clusters[share]:.0f}" for share in (0.5, 0.7, 0.8, 0.9))


def area(chance, success):
    """Probability that a success has the larger chance than a failure; ties count half."""
    order = np.argsort(chance, kind="stable")
    _, first = np.unique(chance[order], return_index=True)
    right, wrong = (np.add.reduceat(part[order].astype(float), first) for part in (success, ~success))
    below = np.concatenate([[0], np.cumsum(wrong)[:-1]])
    return float((right * (below + 0.5 * wrong)).sum() / max(right.sum() * wrong.sum(), 1e-12))


if __name__ == "__main__":
    main()
