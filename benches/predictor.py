#!/usr/bin/env python3
"""Measures the confidence on scenes that it was not trained on, leaving out each in turn.

    predictor.py PROJECT=REFERENCE... --viewrank target/release/viewrank --out DIR [--maps sgm|openmvs]

Each PROJECT is a COLMAP project (images/, sparse/) with clusters.txt, the depth maps of these in PROJECT/sgm (integrations/sgm) or
PROJECT/openmvs (integrations/openmvs) and, for the training alone, as many further PROJECT.* beside it with other clusters. REFERENCE is what its depths are held against: exact
depth (truth/depth of a rendered scene) or the maps with all 22 partners (sgm.py match --connected 22). For each project the confidence is
trained on all the others, without their references, and then held against this one's:

- per (cluster, triangle): f_conf against the share of the triangle's pixels that came out right (what `viewrank evaluate` measures), for triangles
  that at least two partners see; and how well it parts those of which more than half came out right from all others that the key view sees;
- per pixel, with --maps sgm: the picture's confidence alone against "came out right", where the reference has a depth and at least two partners show it: what
  lies beside their images fails whatever the picture shows;
- the curve of `viewrank evaluate`: key views until 50, 70 and 80 % of the real fulfilment, in the order of each confidence, partners the same;
- with --adapt NAME: the first 10 % of its maps, in the order that the others' model gives, are trained on together with the others, and the rest
  is predicted by both models.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "integrations/sgm"))
from measure import read_reference, resized  # noqa: E402
from workspace import Workspace  # noqa: E402

SOURCES = ["none", "geometric", "photometric", "proxy", "trained"]
# A triangle may come out right in part, so that even who knows the shares has no area of 1.
KNOWN = "known shares, optimum"
SHARES = [0.5, 0.7, 0.8]
RIGHT_WITHIN = 3.0  # a_d, as method 8
FINEST = 1.25  # a_d over a view's own ground sampling distance where no other is finer, as method 3.6
ADAPTED = 0.1


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("projects", nargs="+", metavar="PROJECT=REFERENCE")
    parser.add_argument("--viewrank", default="viewrank")
    parser.add_argument("--out", type=Path, required=True, help="for models, plans and predictor.md")
    parser.add_argument("--maps", choices=["sgm", "openmvs"], default="sgm", help="the backend that made the depth maps")
    parser.add_argument("--threads", default="2")
    parser.add_argument("--adapt", action="append", default=[], metavar="NAME", help="measure what its first 10 %% of maps teach")
    arguments = parser.parse_args()
    if arguments.adapt and arguments.maps != "sgm":
        parser.error("--adapt needs the maps of --maps sgm")
    sets = {Path(p): Path(r) for p, r in (text.split("=", 1) for text in arguments.projects)}
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = [measure(project, sets, arguments) for project in sets]
    text = table(rows)
    (arguments.out / "predictor.md").write_text(text)
    print(text)


def measure(project, sets, arguments):
    """Measures one project with the model trained on the others."""
    model = arguments.out / f"without_{project.name}.model"
    others = [p for other in sets if other != project for p in (other, *sorted(other.parent.glob(other.name + ".*")))]
    run(arguments, "train", *others, "--depth-maps", arguments.maps, "--out", model)
    reference = exact(sets[project], project, arguments.out)
    row = {"name": project.name, "sources": {}}
    for source in SOURCES:
        result = clusters(project, reference, model if source == "trained" else source, arguments)
        row["sources"][source] = {**scored(result), "needed": needed(result["evaluation"], "ours")}
        known = {**result, "chance": result["outcome"]}
        row["sources"][KNOWN] = {**scored(known), "needed": needed(result["evaluation"], "optimum")}
    if project.name in arguments.adapt:
        row["adapted"] = adapted(project, others, reference, result, arguments)
    row["pixels"] = pixels(project, sets[project], model, arguments) if arguments.maps == "sgm" else {}
    print(json.dumps(row), file=sys.stderr)
    return row


def run(arguments, *words):
    command = [arguments.viewrank, *map(str, words), "--threads", arguments.threads, "--quiet"]
    environment = {**os.environ, "XDG_CONFIG_HOME": str(arguments.out)}
    return subprocess.run(command, check=True, env=environment, stdout=subprocess.PIPE, text=True).stdout


def exact(reference, project, out):
    """A folder of .npy for the program: rendered sets have their depth coded."""
    if (reference / "depth_maps").is_dir():
        return reference / "depth_maps"
    folder = out / "reference" / project.name
    folder.mkdir(parents=True, exist_ok=True)
    for name in partners_of(project):
        np.save(folder / f"{Path(name).name}.npy", read_reference(reference, name))
    return folder


def partners_of(project):
    """Returns the partners of each key view in clusters.txt."""
    lines = [line.rstrip("\n").split("\t") for line in (project / "clusters.txt").read_text().splitlines()]
    return {line[0]: line[1:] for line in lines if not line[0].startswith("#")}


def clusters(project, reference, source, arguments):
    """f_conf and measured shares of the clusters that the maps were made for, and the results of `viewrank evaluate`."""
    tables = arguments.out / "tables"
    run(arguments, "plan", project, "--backend", arguments.maps, "--confidence", source, "-k", 5, "--budget", "100%")
    evaluate = ["evaluate", project, "--depth-maps", project / arguments.maps, "--reference", reference, "--baselines"]
    evaluate += ["--clusters", project / "clusters.txt", "--dump-tables", tables, "--out", arguments.out / "evaluation"]
    run(arguments, *evaluate)
    read = {path.stem: np.load(path) for path in tables.glob("*.npy")}
    seen = np.bincount(read["visible"][:, 0], minlength=read["real_key"].max() + 1)[read["real_key"]].sum()
    names = [view["name"] for view in json.loads((tables / "views.json").read_text())]
    return {
        "chance": ratio(read, "real_predicted", "real_nocp"),
        "outcome": ratio(read, "real", "real_attainable"),
        "cluster": read["real_nocp"][:, 0],
        "order": [(row, names[read["real_key"][row]]) for row in read["real_order"]],
        "uncovered": int(seen) - len(read["real_nocp"]),
        "evaluation": json.loads((arguments.out / "evaluation/evaluation.json").read_text()),
    }


def scored(result):
    """Figures for triangles that can be fulfilled, and the area where those that cannot count as foreseen failures."""
    nothing = np.zeros(result["uncovered"])
    chance = np.concatenate([result["chance"], nothing])
    all_seen = scores(chance, np.concatenate([result["outcome"] > 0.5, nothing]))
    return {**scores(result["chance"], result["outcome"]), "auc_seen": all_seen["auc"]}


def adapted(project, others, reference, before, arguments):
    """Scores the remaining clusters by the model of the others, and by that of the others with the first maps."""
    finished = before["order"][: int(np.ceil(ADAPTED * len(before["order"])))]
    folder = arguments.out / "first" / project.name
    maps = folder / "sgm/depth_maps"
    maps.mkdir(parents=True, exist_ok=True)
    for part in ["images", "sparse", "viewrank.toml", "sgm/report.json"]:
        link(folder / part, project / part)
    for _, name in finished:
        link(maps / f"{name}.npy", project / f"sgm/depth_maps/{name}.npy")
    model = arguments.out / f"with_first_of_{project.name}.model"
    run(arguments, "train", folder, *others, "--depth-maps", arguments.maps, "--out", model)
    after = clusters(project, reference, model, arguments)
    rest = ~np.isin(before["cluster"], [row for row, _ in finished])
    of = lambda result: scores(result["chance"][rest], result["outcome"][rest])  # noqa: E731
    means = [float(values[rest].mean()) for values in (before["outcome"], before["chance"], after["chance"])]
    return {"maps": len(finished), "means": means, "before": of(before), "after": of(after)}


def link(path, target):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    path.symlink_to(target.resolve())


def needed(result, name):
    """Returns the number of key views until each share of the real fulfilment, in that order."""
    order = next(o for o in result["orders"] if o["name"] == name)
    clusters = {n["share"]: n["clusters"] for n in order["needed"]}
    return [clusters[share] for share in SHARES]


def ratio(read, part, whole):
    """Returns the ratio of two tables by (cluster, triangle), at the rows that the planned partners can fulfil."""
    keys = lambda name: read[name].astype(np.int64) @ np.array([1 << 32, 1])  # noqa: E731
    wanted = keys("real_nocp")

    def values(name):
        of, rows = keys(name), np.zeros(len(wanted))
        both, at, there = np.intersect1d(wanted, of, return_indices=True)
        rows[at] = read[name + "_value"][there]
        return rows

    return np.clip(values(part) / np.maximum(values(whole), 1e-12), 0, 1)


def scores(chance, outcome):
    """AUC with shares as weights of success and failure, Brier score, calibration error over ten ranges."""
    order = np.argsort(chance, kind="stable")
    p, y = chance[order].astype(float), outcome[order].astype(float)
    _, first = np.unique(p, return_index=True)
    right, wrong = np.add.reduceat(y, first), np.add.reduceat(1 - y, first)
    below = np.concatenate([[0], np.cumsum(wrong)[:-1]])
    auc = float((right * (below + 0.5 * wrong)).sum() / (right.sum() * wrong.sum()))
    ranges = np.minimum((p * 10).astype(int), 9)
    apart = [abs((p - y)[ranges == r].sum()) for r in range(10)]
    return {"auc": auc, "brier": float(((p - y) ** 2).mean()), "calibration": float(sum(apart) / len(p)), "count": len(p)}


def pixels(project, reference, model, arguments):
    """The picture alone against "came out right", each fourth pixel of the maps that has a reference depth."""
    maps = sorted((project / "sgm/depth_maps").rglob("*.npy"))
    names = [str(path.relative_to(project / "sgm/depth_maps"))[: -len(".npy")] for path in maps]
    images = [project / "images" / name for name in names]
    found = {}
    for source in ["proxy", model]:
        folder = arguments.out / "pictures"
        words = ["predict", *images, "--out", folder, "--confidence", source, "--quiet"]
        subprocess.run([arguments.viewrank, *map(str, words)], check=True)
        found["proxy" if source == "proxy" else "trained"] = {n: np.load(folder / (Path(n).name + ".npy")) for n in names}
    settings = json.loads((project / "viewrank/manifest.json").read_text())["settings"]
    workspace = Workspace(project, settings["image_scale"])
    partners = partners_of(project)
    truths = {name: truth(reference, view) for name, view in workspace.views.items()}
    chances, outcomes = {"constant": [], "gradient": [], "proxy": [], "trained": []}, []
    for name, path in zip(names, maps):
        depth, exact_depth, view = np.load(path), truths[name], workspace.views[name]
        accuracy = np.maximum(settings["target"]["accuracy"], FINEST * exact_depth / view.K[0, 0])
        right = (depth > 0) & (np.abs(depth - exact_depth) <= RIGHT_WITHIN * accuracy)
        known = np.zeros_like(right)
        showing = sum(shown(view, exact_depth, workspace.views[p], truths[p]).astype(int) for p in partners[name])
        known[2::4, 2::4] = (exact_depth[2::4, 2::4] > 0) & (showing >= 2)
        outcomes.append(right[known])
        grey = cv2.imread(str(project / "images" / name), cv2.IMREAD_GRAYSCALE).astype(np.float32)
        energy = cv2.GaussianBlur(cv2.Sobel(grey, -1, 1, 0) ** 2 + cv2.Sobel(grey, -1, 0, 1) ** 2, (0, 0), 4)
        energy = np.log(cv2.resize(energy, depth.shape[::-1]) + 1)
        chances["constant"].append(np.full(known.sum(), 0.5))
        chances["gradient"].append(energy[known])
        for source in ["proxy", "trained"]:
            map_ = cv2.resize(found[source][name], depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
            chances[source].append(map_[known])
    outcomes = np.concatenate(outcomes)
    result = {source: scores(np.concatenate(values), outcomes) for source, values in chances.items()}
    # Energy is no probability, and a constant is best at the share that succeeds: only ranks and that share are of use.
    result["constant"].update(brier=float(outcomes.mean() * (1 - outcomes.mean())), calibration=0.0)
    result["gradient"].update(brier=None, calibration=None)
    return result


def truth(reference, view):
    depth = read_reference(reference, view.name)
    return np.zeros(view.size[::-1], np.float32) if depth is None else resized(depth, view.size)


def shown(view, depths, partner, its_depths):
    """Returns, at every fourth pixel, whether the partner's image shows the place unoccluded, by its reference depth."""
    v, u = np.mgrid[2 : depths.shape[0] : 4, 2 : depths.shape[1] : 4]
    rays = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3) @ np.linalg.inv(view.K).T
    pixels, depth = partner.project((rays * depths[v, u].reshape(-1, 1) - view.t) @ view.R)
    x, y = np.rint(np.nan_to_num(pixels, nan=-9, posinf=-9, neginf=-9)).clip(-9, 1e6).astype(int).T
    width, height = partner.size
    inside = (depth > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    there = its_depths[y.clip(0, height - 1), x.clip(0, width - 1)]
    return (inside & ~((there > 0) & (there < 0.98 * depth))).reshape(u.shape)


def table(rows):
    head = "| unseen scene | confidence | AUC, all that the key views see | AUC, covered | Brier | calibration error | key views for 50, 70, 80 % |"
    lines = [head, "|---|---|---|---|---|---|---|"]
    for row in rows:
        for source, s in row["sources"].items():
            needed = ", ".join(f"{n:.1f}" for n in s["needed"])
            figures = f"{s['auc_seen']:.3f} | {s['auc']:.3f} | {s['brier']:.3f} | {s['calibration']:.3f}"
            lines.append(f"| {row['name']} | {source} | {figures} | {needed} |")
    for source in [*SOURCES, KNOWN]:
        mean = np.mean([row["sources"][source]["needed"] for row in rows], axis=0)
        areas = [np.mean([row["sources"][source][which] for row in rows]) for which in ("auc_seen", "auc")]
        lines.append(f"| mean | {source} | {areas[0]:.3f} | {areas[1]:.3f} | | | {', '.join(f'{n:.1f}' for n in mean)} |")
    if any(row["pixels"] for row in rows):
        lines += ["", "| unseen scene | picture alone, per pixel | AUC | Brier | calibration error |", "|---|---|---|---|---|"]
    number = lambda n: "" if n is None else f"{n:.3f}"  # noqa: E731
    for row in rows:
        for source, s in row["pixels"].items():
            lines.append(f"| {row['name']} | {source} | {s['auc']:.3f} | {number(s['brier'])} | {number(s['calibration'])} |")
    head = "| rest of | after maps | came out right | foreseen by the others' model | with the first maps | AUC | calibration error |"
    lines += ["", head, "|---|---|---|---|---|---|---|"] if any("adapted" in row for row in rows) else []
    for row in (row for row in rows if "adapted" in row):
        a = row["adapted"]
        means = " | ".join(f"{m:.3f}" for m in a["means"])
        change = lambda figure: f"{a['before'][figure]:.3f}, then {a['after'][figure]:.3f}"  # noqa: E731
        lines.append(f"| {row['name']} | {a['maps']} | {means} | {change('auc')} | {change('calibration')} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
