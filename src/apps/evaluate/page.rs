//! `evaluation.html`: the curves and tables of an evaluation on one page that needs nothing else.

use std::fmt::Write;

use super::evaluation::{Evaluation, KeyView};

/// Marks text as HTML.
fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// The whole page. `title`: the project.
pub fn page(evaluation: &Evaluation, title: &str) -> String {
    let mut html = format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\
         <title>Evaluation of {0}</title><style>{STYLE}</style></head><body>\n<h1>Evaluation of {0}</h1>\n",
        escape(title)
    );
    html += &summary(evaluation);
    html += "<h2>Share of what all depth maps give</h2>\n<div class=\"plots\">\n";
    html += &plots(evaluation);
    html += "</div>\n";
    html += &gap_table(evaluation);
    if !evaluation.orders.is_empty() {
        html += &order_tables(evaluation);
    }
    html += &missing_table(evaluation);
    html += &key_view_table(evaluation);
    html + "</body></html>\n"
}

const STYLE: &str = "body{font:15px/1.45 system-ui,sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem;color:#222;\
     background:#fff}h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2rem}table{border-collapse:collapse;margin:.6rem 0}\
     th,td{padding:.15rem .7rem;text-align:right;border-bottom:1px solid #8883}th:first-child,td:first-child{text-align:left}\
     .plots{display:flex;flex-wrap:wrap;gap:1rem}svg{max-width:100%;height:auto}\
     .wide{overflow-x:auto}@media(prefers-color-scheme:dark){body{color:#ddd;background:#181818}svg{background:#fff}}";

fn summary(e: &Evaluation) -> String {
    let truth = if e.reference {
        "held against the reference"
    } else {
        "no reference was given: every depth on the surface counts as right"
    };
    let mut html = format!(
        "<p>{} depth maps, {truth}. Completeness {:.1} %{}. Fulfilment of all clusters: {:.3} predicted, {:.3} real.</p>\n",
        e.key_views.len(),
        100.0 * e.quality.completeness,
        e.errors(),
        e.predicted,
        e.real
    );
    if !e.without_map.is_empty() {
        let _ = writeln!(
            html,
            "<p>{} of the planned clusters have no depth map here; shares are of what the others reach.</p>",
            e.without_map.len()
        );
    }
    html
}

/// A line of a plot.
struct Line {
    label: String,
    colour: &'static str,
    dash: &'static str,
    points: Vec<(f64, f64)>,
}

const COLOURS: [&str; 8] = ["#1668a8", "#2a9d6f", "#8e5bb5", "#c0392b", "#b8860b", "#777777", "#222222", "#17becf"];

fn plots(e: &Evaluation) -> String {
    let line = |label: &str, colour, dash, x: Vec<f64>, y: &[f64]| Line {
        label: label.into(),
        colour,
        dash,
        points: x.into_iter().zip(y.iter().copied()).collect(),
    };
    let mut html = String::new();
    for over_pairs in [false, true] {
        let x: Vec<f64> = match over_pairs {
            true => e.curve.pairs.iter().map(|&p| p as f64).collect(),
            false => (0..e.curve.real.len()).map(|i| i as f64).collect(),
        };
        let mut lines = vec![
            line("predicted", "#1668a8", "5 4", x.clone(), &e.curve.predicted),
            line("real", "#1668a8", "", x, &e.curve.real),
        ];
        for (i, order) in e.orders.iter().enumerate().skip(1) {
            let x = if over_pairs { order.pairs.clone() } else { (0..order.pairs.len()).map(|i| i as f64).collect() };
            let y: Vec<f64> =
                order.kept.iter().map(|kept| if e.kept.real > 0.0 { kept / e.kept.real } else { 0.0 }).collect();
            lines.push(line(order.name, COLOURS[i % COLOURS.len()], "", x, &y));
        }
        html += &plot(if over_pairs { "matching pairs" } else { "key views" }, &lines);
    }
    html
}

/// A plot of shares, 0 to 1, as SVG.
fn plot(label: &str, lines: &[Line]) -> String {
    const WIDTH: f64 = 520.0;
    const HEIGHT: f64 = 340.0;
    const LEFT: f64 = 50.0;
    const BOTTOM: f64 = 290.0;
    const TOP: f64 = 15.0;
    let most = lines.iter().flat_map(|l| &l.points).map(|p| p.0).fold(1.0, f64::max);
    let at = |(x, y): (f64, f64)| (LEFT + (WIDTH - LEFT - 15.0) * x / most, BOTTOM - (BOTTOM - TOP) * y);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" width=\"{WIDTH}\" height=\"{HEIGHT}\" \
         font-size=\"12\" font-family=\"system-ui,sans-serif\" role=\"img\" aria-label=\"share over {label}\">\n"
    );
    for tenth in 0..=5 {
        let y = f64::from(tenth) / 5.0;
        let (_, py) = at((0.0, y));
        let _ = writeln!(
            svg,
            "<path d=\"M{LEFT} {py:.1}H{}\" stroke=\"#ddd\"/><text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{:.0} %</text>",
            WIDTH - 15.0,
            LEFT - 6.0,
            py + 4.0,
            100.0 * y
        );
    }
    let step = (most / 5.0).ceil();
    for tick in (0..=5).map(|i| f64::from(i) * step).filter(|&tick| tick <= most) {
        let (px, _) = at((tick, 0.0));
        let _ = writeln!(svg, "<text x=\"{px:.1}\" y=\"{}\" text-anchor=\"middle\">{tick:.0}</text>", BOTTOM + 17.0);
    }
    for (i, line) in lines.iter().enumerate() {
        let points: Vec<String> = line.points.iter().map(|&p| at(p)).map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
        let _ = writeln!(
            svg,
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{}\" stroke-width=\"1.8\" stroke-dasharray=\"{}\"/>",
            points.join(" "),
            line.colour,
            line.dash
        );
        let y = BOTTOM - 12.0 - 15.0 * (lines.len() - 1 - i) as f64;
        let _ = writeln!(
            svg,
            "<path d=\"M{} {y}h22\" stroke=\"{}\" stroke-width=\"2\" stroke-dasharray=\"{}\"/><text x=\"{}\" y=\"{}\">{}</text>",
            WIDTH - 140.0,
            line.colour,
            line.dash,
            WIDTH - 112.0,
            y + 4.0,
            escape(&line.label)
        );
    }
    let _ = writeln!(
        svg,
        "<text x=\"{}\" y=\"{}\" text-anchor=\"middle\">{label}</text>\n</svg>",
        (LEFT + WIDTH) / 2.0,
        HEIGHT - 12.0
    );
    svg
}

fn gap_table(e: &Evaluation) -> String {
    let mut html = String::from(
        "<h2>Prediction</h2>\n<table><tr><th>predicted</th><th>key views</th><th>pairs</th><th>real</th><th>gap, points</th></tr>\n",
    );
    for gap in &e.gap {
        let _ = writeln!(
            html,
            "<tr><td>{:.0} %</td><td>{}</td><td>{}</td><td>{:.1} %</td><td>{:+.1}</td></tr>",
            100.0 * gap.share,
            gap.clusters,
            gap.pairs,
            100.0 * gap.real,
            100.0 * (gap.predicted - gap.real)
        );
    }
    html + "</table>\n"
}

fn order_tables(e: &Evaluation) -> String {
    let mut html = String::from("<h2>Orders</h2>\n");
    for (what, pairs) in [("Key views", false), ("Pairs", true)] {
        let _ = write!(html, "<p>{what} for a share of what all clusters really reach:</p>\n<table><tr><th>order</th>");
        e.orders[0].needed.iter().for_each(|n| html += &format!("<th>{:.0} %</th>", 100.0 * n.share));
        html += "</tr>\n";
        for order in &e.orders {
            let _ = write!(html, "<tr><td>{}</td>", escape(order.name));
            for needed in &order.needed {
                let value = if pairs { needed.pairs } else { needed.clusters };
                let digits = usize::from(!order.spread.is_empty());
                let _ = write!(html, "<td>{value:.digits$}</td>");
            }
            html += "</tr>\n";
        }
        html += "</table>\n";
    }
    html
}

fn missing_table(e: &Evaluation) -> String {
    let mut html = format!(
        "<h2>What is missing</h2>\n<p>Of {} triangles those with less than half of their fulfilment, coloured in <code>evaluation.ply</code>:\
         </p>\n<table><tr><th>reason</th><th>triangles</th><th>share</th></tr>\n",
        e.triangles
    );
    for (missing, count) in &e.missing {
        let _ = writeln!(
            html,
            "<tr><td>{}</td><td>{count}</td><td>{:.1} %</td></tr>",
            missing.words(),
            100.0 * *count as f64 / e.triangles.max(1) as f64
        );
    }
    html + "</table>\n"
}

fn key_view_table(e: &Evaluation) -> String {
    let mut html = String::from(
        "<h2>Key views</h2>\n<div class=\"wide\"><table><tr><th>key view</th><th>rank</th><th>partners matched</th><th>completeness</th>\
         <th>outliers</th><th>RMSE</th><th>predicted f</th><th>real f</th></tr>\n",
    );
    for (i, view) in e.key_views.iter().enumerate() {
        html += &key_view_row(i + 1, view);
    }
    html + "</table></div>\n"
}

fn key_view_row(rank: usize, view: &KeyView) -> String {
    format!(
        "<tr><td>{}</td><td>{rank}</td><td title=\"{}\">{} of {}</td><td>{:.1} %</td><td>{:.2} %</td><td>{:.4}</td><td>{:.0}</td>\
         <td>{:.0}</td></tr>\n",
        escape(&view.name),
        escape(&view.partners.join(", ")),
        view.matched.len(),
        view.partners.len(),
        100.0 * view.quality.completeness,
        100.0 * view.quality.outliers,
        view.quality.rmse,
        view.predicted,
        view.real
    )
}
