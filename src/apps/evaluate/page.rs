//! `evaluation.html`: the curves and tables of an evaluation on one page without external files.

use std::fmt::Write;

use super::evaluation::{Evaluation, KeyView};
use crate::show::pictures::{
    SHARE_LABEL,
    plot::{self, COLOURS, Line, Plot},
};

/// Escapes text for HTML.
fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Returns the page. `title`: name of the project.
pub fn page(evaluation: &Evaluation, title: &str) -> String {
    let mut html = format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\
         <title>Evaluation of {0}</title><style>{STYLE}</style></head><body>\n<h1>Evaluation of {0}</h1>\n",
        escape(title)
    );
    html += &summary(evaluation);
    html += "<h2>Share of what these depth maps give together</h2>\n<div class=\"plots\">\n";
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
        "compared with the reference"
    } else {
        "without a reference, every depth on the surface counts as right"
    };
    let mut html = format!(
        "<p>{} depth maps, {truth}. They reach {}. Completeness {:.1} %{}. Fulfilment of these clusters: {:.3} predicted, {:.3} real.</p>\n",
        e.key_views.len(),
        e.reached_in_words(),
        100.0 * e.quality.completeness,
        e.errors(),
        e.predicted,
        e.real
    );
    if !e.without_map.is_empty() {
        let _ = writeln!(
            html,
            "<p>{} planned clusters have no depth map; shares refer to the others.</p>",
            e.without_map.len()
        );
    }
    html
}

fn plots(e: &Evaluation) -> String {
    let mut html = String::new();
    for over_pairs in [false, true] {
        let x: Vec<f64> = match over_pairs {
            true => e.curve.pairs.iter().map(|&p| p as f64).collect(),
            false => (0..e.curve.real.len()).map(|i| i as f64).collect(),
        };
        let mut lines = vec![
            line("predicted", COLOURS[0], DASHED, &x, &e.curve.predicted),
            line("real", COLOURS[0], "", &x, &e.curve.real),
        ];
        for (i, order) in e.orders.iter().enumerate().skip(1) {
            let x = if over_pairs { order.pairs.clone() } else { (0..order.pairs.len()).map(|i| i as f64).collect() };
            let y: Vec<f64> =
                order.kept.iter().map(|kept| if e.kept.real > 0.0 { kept / e.kept.real } else { 0.0 }).collect();
            // Colours are used again with dots, except the first, that of the plan.
            let (round, colour) = ((i - 1) / (COLOURS.len() - 1), 1 + (i - 1) % (COLOURS.len() - 1));
            lines.push(line(order.name, COLOURS[colour], if round == 0 { "" } else { DOTTED }, &x, &y));
        }
        let over = if over_pairs { "matching pairs" } else { "key views" };
        let plot = Plot { over, share_of: SHARE_LABEL, lines: &lines, cut: None };
        let mut svg = String::new();
        plot.draw(&mut svg, 0.0, 0.0);
        html += &plot::document(plot::WIDTH, plot.height(), &format!("{SHARE_LABEL} over {over}"), &svg);
    }
    html
}

const DASHED: &str = "6 4";
const DOTTED: &str = "2 3";

fn line(label: &'static str, colour: &'static str, dash: &'static str, x: &[f64], y: &[f64]) -> Line {
    Line { label, colour, dash, points: x.iter().copied().zip(y.iter().copied()).collect() }
}

fn gap_table(e: &Evaluation) -> String {
    let mut html = String::from(
        "<h2>Prediction</h2>\n<p>Shares of what these depth maps give together.</p>\n<table><tr><th>predicted</th><th>key views</th><th>pairs</th><th>real</th><th>gap, points</th></tr>\n",
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
        let _ = write!(
            html,
            "<p>{what} needed for a share of what all depth maps give (measured):</p>\n<table><tr><th>order</th>"
        );
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
        "<h2>Missing fulfilment</h2>\n<p>Triangles with less than half of their fulfilment, of {} in total, coloured in \
         <code>evaluation.ply</code>:</p>\n<table><tr><th>reason</th><th>triangles</th><th>share</th></tr>\n",
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
    let [outliers, rmse] = view.quality.errors();
    format!(
        "<tr><td>{}</td><td>{rank}</td><td title=\"{}\">{} of {}</td><td>{:.1} %</td><td>{outliers}</td><td>{rmse}</td><td>{:.0}</td>\
         <td>{:.0}</td></tr>\n",
        escape(&view.name),
        escape(&view.partners.join(", ")),
        view.matched.len(),
        view.partners.len(),
        100.0 * view.quality.completeness,
        view.predicted,
        view.real
    )
}
