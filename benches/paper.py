"""Tables of the paper's experiments, from experiments.json of integrations/sgm/experiments.py, beside what the paper has (arXiv 1803.08323)."""

ORDERS = {
    "optimum": "Opt",
    "ours": "Ours",
    "nocp": "OursNoCP",
    "realupdate": "OursRU",
    "replan": "replanned (5.4)",
    "maxpts": "MaxPts",
    "every n-th": "every n-th",
    "farthest view": "farthest view",
    "random": "Random",
}
# What the paper says of 1,236 images: per cent of the images, by share of the reachable fulfilment.
PAPER_RANKING = {0.5: "1.8 to 2.4", 0.7: "7.1"}
# Pairs over those of Max, by share, at k = 11.
PAPER_PAIRS = {0.5: "0.40", 0.7: "0.50", 0.8: "0.55", 0.9: "0.65"}
ALONG = (10, 25, 50, 100, 200, 400)
# From so many key views on, gaps count.
SETTLED = 50


def tables(results):
    """Markdown tables by the name of their mark."""
    results = sorted(results, key=lambda result: result["maps"])
    made = {}
    for result in results:
        name = result["set"]
        made |= {f"ranking-{name}": ranking(result), f"partners-{name}": partners(result), f"full-{name}": full_method(result)}
    if results:
        made |= {"gap": gaps(results), "matching": matching(results)}
    return made


def table(head, rows):
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]


def per_cent(part, whole, digits=1):
    return "–" if part is None else f"{100 * part / whole:.{digits}f}"


def ranking(result):
    """Per cent of the clusters that each order needs: by fulfilment / by cells of the cloud / by those where three maps agree."""
    shares, needed = result["ranking"]["shares"], result["ranking"]["needed"]
    rows = []
    for order, name in ORDERS.items():
        best_of_cells = "oracle" if order == "optimum" else order
        kinds = needed["f_o"][order], needed["all"][best_of_cells], needed["agreeing"][best_of_cells]
        rows.append([name, *(" / ".join(per_cent(row[i], result["maps"]) for row in kinds) for i in range(len(shares)))])
    rows.append(["the paper, k = 5", *(PAPER_RANKING.get(share, "") for share in shares)])
    return table([f"{result['set']}, {result['maps']}", *(f"{share:.0%}" for share in shares)], rows)


def partners(result):
    """Completeness / outliers in per cent / RMSE in mm / f_o of all clusters."""
    counts = sorted({row["k"] for row in result["partners"]})
    found = {(row["rule"], row["k"]): row for row in result["partners"]}
    quality = lambda row: f"{100 * row['completeness']:.1f} / {100 * row['outliers']:.1f} / {1000 * row['rmse']:.0f} / {row['real']:.3f}"
    rules = sorted({rule for rule, _ in found}, key=lambda rule: -found[rule, 5]["real"])
    return table([result["set"], *(f"k = {k}" for k in counts)], [[rule, *(quality(found[rule, k]) for k in counts)] for rule in rules])


def full_method(result):
    """Pairs in per cent of all at the same k: ours / its clusters in the best order / Max (ratio of ours to Max)."""
    full = result["full"]
    found = {(row["rule"], row["k"]): row for row in full["rows"]}
    rows = []
    for k in sorted({k for _, k in found}):
        ours, most = (found[rule, k] for rule in ("ours", "maxcon"))
        rows.append([f"k = {k}", *(compared(ours, most, i) for i in range(len(full["shares"])))])
    rows.append(["the paper, ratio", *(PAPER_PAIRS.get(share, "") for share in full["shares"])])
    return table([result["set"], *(f"{share:.0%}" for share in full["shares"])], rows)


def compared(ours, most, i):
    """Where one never gets there, it has a dash."""
    pairs = [(ours["needed"][i], ours["pairs"]), (ours["optimum"][i], ours["pairs"]), (most["needed"][i], most["pairs"])]
    text = " / ".join(per_cent(*one) for one in pairs)
    return f"{text} ({ours['needed'][i] / most['needed'][i]:.2f})" if ours["needed"][i] and most["needed"][i] else text


def gaps(results):
    """Forecast share minus real one in points, along the order: by cells / by those where three maps agree."""
    rows = []
    for result in results:
        gap = result["gap"]
        off = {kind: [100 * (forecast - real) for forecast, real in zip(gap["forecast"], gap[kind])] for kind in ("all", "agreeing")}
        along = [" / ".join(f"{of[i]:+.1f}" for of in off.values()) if i < result["maps"] else "" for i in ALONG]
        worst = " / ".join(f"{max(of[SETTLED:], key=abs):+.1f}" for of in off.values()) if result["maps"] > SETTLED else "–"
        rows.append([f"{result['set']}, {result['maps']}", *along, worst, " / ".join(f"{share:.3f}" for share in gap["f_o of all"])])
    return table(["set, maps", *map(str, ALONG), f"largest from {SETTLED} on", "f_o of all, forecast / real"], rows)


def planning(timed):
    """Planning from nothing, and once more with another target, by set; processor time, which other programs hardly change."""
    rows = []
    for name, kinds in sorted(timed.items(), key=lambda one: one[1]["sgm"][0]["views"]):
        for kind, (plan, again) in kinds.items():
            rows.append([f"{name}, {plan['views']}", kind, f"{1000 * plan['cpu'] / plan['views']:.0f}", f"{plan['peak_mb']:,.0f}", f"{again['cpu']:.2f}"])
    return table(["set, views", "planned with", "CPU, ms per view", "peak, MB", "other target, CPU s"], rows)


def matching(results):
    """Planning beside matching of all clusters, seconds of one core per key view."""
    rows = []
    for result in results:
        plan, match = result["time"]["planning"]["sgm"][0]["cpu"] / result["maps"], result["time"]["matching"]
        rows.append([f"{result['set']}, {result['maps']}", f"{1000 * plan:.0f}", f"{1000 * match:.0f}", f"{100 * plan / match:.1f}", "2 to 6"])
    return table(["set, maps", "planning, ms", "matching, ms", "planning over matching, %", "the paper, %"], rows)
