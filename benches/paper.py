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
        made |= {"gap": gaps(results), "planning": planning(results), "matching": matching(results)}
    return made


def table(head, rows):
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]


def per_cent(part, whole, digits=1):
    return "–" if part is None else f"{100 * part / whole:.{digits}f}"


def ranking(result):
    """Per cent of the clusters that each order needs: by fulfilment / by cells of the cloud."""
    shares, needed = result["ranking"]["shares"], result["ranking"]["needed"]
    rows = []
    for order, name in ORDERS.items():
        both = needed["f_o"][order], needed["all"]["oracle" if order == "optimum" else order]
        rows.append([name, *(" / ".join(per_cent(row[i], result["maps"]) for row in both) for i in range(len(shares)))])
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
    """Pairs in per cent of all at the same k: ours / Max (ratio)."""
    full = result["full"]
    found = {(row["rule"], row["k"]): row for row in full["rows"]}
    rows = []
    for k in sorted({k for _, k in found}):
        both = [found[rule, k] for rule in ("ours", "maxcon")]
        rows.append([f"k = {k}", *(compared(both, i) for i in range(len(full["shares"])))])
    rows.append(["the paper, ratio", *(PAPER_PAIRS.get(share, "") for share in full["shares"])])
    return table([result["set"], *(f"{share:.0%}" for share in full["shares"])], rows)


def compared(both, i):
    """Where one of the two never gets there, it has a dash."""
    ours, most = (row["needed"][i] for row in both)
    text = " / ".join(per_cent(row["needed"][i], row["pairs"]) for row in both)
    return f"{text} ({ours / most:.2f})" if ours and most else text


def gaps(results):
    """Forecast share minus real one in points, along the order: by fulfilment / by cells."""
    rows = []
    for result in results:
        gap = result["gap"]
        off = {kind: [100 * (forecast - real) for forecast, real in zip(gap["forecast"], gap[kind])] for kind in ("f_o", "all")}
        along = [" / ".join(f"{of[i]:+.1f}" for of in off.values()) if i < result["maps"] else "" for i in ALONG]
        worst = " / ".join(f"{max(of[SETTLED:], key=abs):+.1f}" for of in off.values())
        rows.append([f"{result['set']}, {result['maps']}", *along, worst, " / ".join(f"{share:.3f}" for share in gap["f_o of all"])])
    return table(["set, maps", *map(str, ALONG), f"largest from {SETTLED} on", "f_o of all, forecast / real"], rows)


def serial_share(alone, pair):
    """Share of the work that only one thread can do: T1 = serial + parallel, T2 = serial + parallel / 2."""
    return max(0.0, min(1.0, (2 * pair - alone) / alone))


def planning(results):
    rows = []
    for result in results:
        timed = result["time"]["planning"]
        for kind in dict.fromkeys(name.rsplit(", ", 1)[0] for name in timed):
            alone, pair, again = (timed[f"{kind}, {of}"] for of in ("1", "2", "again"))
            of_view = [f"{1000 * one['seconds']['total'] / one['views']:.0f}" for one in (alone, pair)]
            serial = f"{100 * serial_share(alone['seconds']['total'], pair['seconds']['total']):.0f}"
            rows.append([f"{result['set']}, {alone['views']}", kind, *of_view, serial, f"{pair['peak_mb']:,.0f}", f"{again['seconds']['total']:.2f}"])
    return table(["set, views", "planned with", "ms per view, 1 thread", "2 threads", "serial, %", "peak, MB", "other target, s"], rows)


def matching(results):
    """Planning beside matching of all clusters, seconds of one core per key view."""
    rows = []
    for result in results:
        matched, timed = result["time"]["matching"], result["time"]["planning"]["pictures, 1"]
        plan, match = timed["cpu"] / matched["maps"], matched["cpu"] / matched["maps"]
        rows.append([f"{result['set']}, {matched['maps']}", f"{1000 * plan:.0f}", f"{1000 * match:.0f}", f"{100 * plan / match:.1f}", "2 to 6"])
    return table(["set, maps", "planning, ms", "matching, ms", "planning over matching, %", "the paper, %"], rows)
