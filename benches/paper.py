"""Tables of the paper's experiments, from experiments.json of integrations/sgm/experiments.py, beside what the paper has (arXiv 1803.08323)."""

ORDERS = {"optimum": "Opt", "ours": "Ours", "nocp": "OursNoCP", "maxpts": "MaxPts", "every n-th": "every n-th", "random": "Random"}
# What the paper says of 1,236 images: per cent of the images, by share of the reachable fulfilment.
PAPER_RANKING = {0.5: "1.8 to 2.4", 0.7: "7.1"}
# Pairs over those of Max, by share, at k = 11.
PAPER_PAIRS = {0.5: "0.40", 0.7: "0.50", 0.8: "0.55", 0.9: "0.65"}
K = 5
ALONG = (10, 25, 50, 100, 200, 400)
# From so many key views on, gaps count.
SETTLED = 50


def tables(results):
    """Markdown tables by the name of their mark."""
    if not results:
        return {}
    results = sorted(results, key=lambda result: result["maps"])
    made = {f"ranking-{result['set']}": ranking(result) for result in results}
    return made | {"partners": partners(results), "full": full_method(results), "gap": gaps(results)}


def table(head, rows):
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]


def per_cent(part, whole, digits=1):
    return "–" if part is None else f"{100 * part / whole:.{digits}f}"


def ranking(result):
    """Per cent of the clusters that each order needs: by fulfilment / by cells of the cloud."""
    shares, needed = upper(result["ranking"]["shares"]), result["ranking"]["needed"]
    rows = []
    for order, name in ORDERS.items():
        kinds = needed["f_o"][order], needed["all"]["oracle" if order == "optimum" else order]
        rows.append([name, *(" / ".join(per_cent(row[i], result["maps"]) for row in kinds) for i in shares)])
    rows.append(["the paper, k = 5", *(PAPER_RANKING.get(share, "") for share in shares.values())])
    return table([f"{result['set']}, {result['maps']}", *(f"{share:.0%}" for share in shares.values())], rows)


def upper(shares):
    """The shares from a half on, by their index."""
    return {i: share for i, share in enumerate(shares) if share >= 0.5}


def partners(results):
    """Completeness and outliers in per cent, RMSE in mm, f_o of all clusters, with K partners."""
    rows = []
    for result in results:
        for row in sorted((row for row in result["partners"] if row["k"] == K), key=lambda row: -row["real"]):
            quality = f"{100 * row['completeness']:.1f}", f"{100 * row['outliers']:.1f}", f"{1000 * row['rmse']:.0f}", f"{row['real']:.3f}"
            rows.append([result["set"], row["rule"], *quality])
    return table(["set", "rule", "complete", "outliers", "RMSE", "fulfilment"], rows)


def full_method(results):
    """Pairs that ours needs over those that Max does, at the same k."""
    rows = []
    for result in results:
        found = {(row["rule"], row["k"]): row["needed"] for row in result["full"]["rows"]}
        shares = upper(result["full"]["shares"])
        for k in sorted({k for _, k in found}):
            ours, most = found["ours", k], found["maxcon", k]
            rows.append([f"{result['set']}, k = {k}", *(f"{ours[i] / most[i]:.2f}" if ours[i] and most[i] else "–" for i in shares)])
    rows.append(["the paper, k = 11", *(PAPER_PAIRS.get(share, "") for share in shares.values())])
    return table(["set", *(f"{share:.0%}" for share in shares.values())], rows)


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
