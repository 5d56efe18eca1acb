//! `evaluation.html`: the curves and tables of an evaluation on one page without external files.

use std::fmt::Write;

use super::{
    baselines,
    cells::{NEEDED, TENTHS, order_in_words},
    evaluation::{Evaluation, KeyView},
    half_size::HalfSize,
};
use crate::{
    base::{decimals::to_decimals, printable::in_markup as escape},
    show::pictures::plot::{self, COLOURS, Line, Plot},
};

/// Returns the page. `title`: name of the project.
pub fn page(evaluation: &Evaluation, title: &str) -> String {
    let mut html = format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\
         <title>Evaluation of {0}</title><style>{STYLE}</style></head><body><main>\n<h1>Evaluation of {0}</h1>\n",
        escape(title)
    );
    html += &summary(evaluation);
    html += "<section><h2>Share of the area that these depth maps cover together</h2>\n<div class=\"plots\">\n";
    html += &plots(evaluation);
    html += "</div></section>\n";
    html += &gap_table(evaluation);
    // Other orders begin with maps that are not there.
    if evaluation.without_map.is_empty() {
        html += &cell_tables(evaluation);
    }
    html += &triangle_tables(evaluation);
    html += &clouds(evaluation);
    html += &half_size(evaluation);
    html += &missing_table(evaluation);
    html += &key_view_table(evaluation);
    html + "</main></body></html>\n"
}

/// Style sheet of the page, like the report's: cards, large numbers, dark if the reader's system
/// is, wide tables with scroll bars of their own.
const STYLE: &str = ":root{--page:#f6f7f8;--card:#fff;--text:#1d2329;--soft:#5b6670;--line:#d9dee3}\
     @media(prefers-color-scheme:dark){:root{--page:#14181c;--card:#1d2328;--text:#e4e8eb;--soft:#9aa5ae;--line:#343c43}svg{background:#fff}}\
     *{box-sizing:border-box}body{font:15px/1.45 system-ui,\"Segoe UI\",sans-serif;margin:0;color:var(--text);background:var(--page)}\
     main{max-width:1400px;margin:0 auto;padding:0 16px 24px}h1{font-size:1.5rem;margin:16px 0 4px;overflow-wrap:anywhere}\
     h2{font-size:1.05rem;margin:0 0 8px}section{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:14px;margin-top:14px;overflow-x:auto}\
     .verdict{font-size:1.1rem;margin:0}.note,dt,dd small{color:var(--soft);font-size:.88rem}\
     dl{display:grid;grid-template-columns:repeat(auto-fit,minmax(150px,1fr));gap:10px 16px;margin:0}dd{margin:0}dd b{font-size:2rem;line-height:1.1}\
     dd small{display:block}table{border-collapse:collapse;font-variant-numeric:tabular-nums}\
     th,td{padding:3px 10px;text-align:right;border-bottom:1px solid var(--line);font-weight:400}th{color:var(--soft)}\
     th:first-child,td:first-child{text-align:left}.plots{display:flex;flex-wrap:wrap;gap:1rem}svg{max-width:100%;height:auto}\
     @media print{body{background:#fff;font-size:9.5pt}section{border:0;padding:4px 0;break-inside:avoid;overflow:visible}.keys{break-inside:auto}}";

fn summary(e: &Evaluation) -> String {
    let mut html = format!(
        "<p class=\"verdict\">{}</p>\n<section><dl>",
        e.enough_in_words()
    );
    for (what, value, of) in numbers(e) {
        let _ = write!(
            html,
            "<div><dt>{what}</dt><dd><b>{value}</b><small>{of}</small></dd></div>"
        );
    }
    html += "</dl>";
    if !e.without_map.is_empty() {
        let _ = write!(
            html,
            "<p class=\"note\">{} of {} key views have no depth map; shares are of the others.</p>",
            e.without_map.len(),
            e.without_map.len() + e.key_views.len()
        );
    }
    html + "</section>\n"
}

/// The numbers at the top of the page: what each is, its value, and of what.
fn numbers(e: &Evaluation) -> [(&'static str, String, String); 7] {
    let [outliers, rmse] = e.quality.errors();
    let percent = |share: f64| format!("{:.1} %", 100.0 * share);
    let measured = match e.at_half_size() {
        0 => "measured".to_owned(),
        half => format!("measured, {half} at half the size"),
    };
    let [completeness, of_outliers, of_rmse] = if e.reference {
        [
            "of the reference's pixels are right",
            "against the reference",
            "scene units, of the right pixels",
        ]
    } else {
        let unknown = "not measured without a reference";
        [
            "of the pixels have a depth on the surface",
            unknown,
            unknown,
        ]
    };
    let maps = e.key_views.len().to_string();
    let reached = e.reached.share.map_or("–".into(), percent);
    let complete = percent(e.quality.completeness);
    let [real, predicted] = [e.real, e.predicted].map(|fulfilment| format!("{fulfilment:.3}"));
    [
        ("Depth maps", maps, measured),
        ("Reached", reached, e.of_all()),
        ("Completeness", complete, completeness.into()),
        ("Outliers", outliers, of_outliers.into()),
        ("RMSE", rmse, of_rmse.into()),
        ("Fulfilment, measured", real, "of what is wanted".into()),
        (
            "Fulfilment, predicted",
            predicted,
            "for the same depth maps".into(),
        ),
    ]
}

fn plots(e: &Evaluation) -> String {
    let maps = |curve: &[f64]| -> Vec<(f64, f64)> {
        curve
            .iter()
            .enumerate()
            .map(|(i, &share)| (i as f64, share))
            .collect()
    };
    let predicted = line("predicted", COLOURS[0], DASHED, maps(&e.curve.predicted));
    let real = line("real", COLOURS[0], "", maps(&e.curve.real));
    let mut lines = vec![predicted, real];
    let others = if e.without_map.is_empty() {
        &e.cells.all.orders[..]
    } else {
        &[]
    };
    for (i, order) in others.iter().enumerate().skip(1) {
        // Colours are reused with dotted lines, except the first, which is the plan's.
        let (round, colour) = (
            (i - 1) / (COLOURS.len() - 1),
            1 + (i - 1) % (COLOURS.len() - 1),
        );
        let dash = if round == 0 { "" } else { DOTTED };
        let name = order_in_words(order.name);
        lines.push(line(name, COLOURS[colour], dash, maps(&order.curve)));
    }
    let plot = Plot {
        over: "key views",
        share_of: SHARE_OF_CELLS,
        lines: &lines,
        cut: None,
    };
    let mut svg = String::new();
    plot.draw(&mut svg, 0.0, 0.0);
    let title = format!("{SHARE_OF_CELLS} over key views");
    plot::document(plot::WIDTH, plot.height(), &title, &svg)
}

/// Vertical axis of the curves.
const SHARE_OF_CELLS: &str = "share of the area that they cover";
const DASHED: &str = "6 4";
const DOTTED: &str = "2 3";

fn line(
    label: &'static str,
    colour: &'static str,
    dash: &'static str,
    points: Vec<(f64, f64)>,
) -> Line {
    Line {
        label,
        colour,
        dash,
        points,
    }
}

fn gap_table(e: &Evaluation) -> String {
    let mut html = String::from(
        "<section><h2>Prediction</h2>\n<p>Predicted by the plan; real: share of the area that these depth maps cover together, in cells.</p>\n<table><tr><th>predicted</th><th>key views</th><th>pairs</th><th>real</th><th>three agree</th><th>gap, points</th></tr>\n",
    );
    // Shares that the same depth maps reach are one row.
    for same in e.gap.chunk_by(|one, next| one.clusters == next.clusters) {
        let (gap, last) = (&same[0], &same[same.len() - 1]);
        let up_to = if same.len() > 1 {
            format!("–{:.0}", 100.0 * last.share)
        } else {
            String::new()
        };
        let _ = writeln!(
            html,
            "<tr><td>{:.0}{up_to} %</td><td>{}</td><td>{}</td><td>{:.1} %</td><td>{:.1} %</td><td>{:+.1}</td></tr>",
            100.0 * gap.share,
            gap.clusters,
            gap.pairs,
            100.0 * gap.real,
            100.0 * gap.agreeing,
            to_decimals(100.0 * (gap.predicted - gap.real), 1)
        );
    }
    html + "</table></section>\n"
}

/// Orders judged by cells, for both kinds of cells.
fn cell_tables(e: &Evaluation) -> String {
    let mut html = format!(
        "<section tabindex=\"0\" aria-label=\"Orders\"><h2>Orders, by the area covered</h2>\n<p>{}. Way: 0 is every n-th, 1 the oracle, known only afterwards.</p>\n",
        escape(&e.cells.source.describe())
    );
    for (name, kind) in e.cells.kinds() {
        let _ = write!(html, "<table><tr><th>{:.0} {name}</th>", kind.cells);
        TENTHS
            .iter()
            .for_each(|tenth| html += &format!("<th>{:.0} % of the maps</th>", 100.0 * tenth));
        NEEDED
            .iter()
            .for_each(|share| html += &format!("<th>maps for {:.0} %</th>", 100.0 * share));
        html += "</tr>\n";
        let ours = kind.ours();
        for order in &kind.orders {
            let _ = write!(html, "<tr><td>{}</td>", order_in_words(order.name));
            order
                .covered
                .iter()
                .for_each(|share| html += &format!("<td>{:.1} %</td>", 100.0 * share));
            order
                .needed
                .iter()
                .for_each(|maps| html += &format!("<td>{maps}</td>"));
            html += "</tr>\n";
        }
        html += "<tr><td>viewrank's way</td>";
        for way in ours.way {
            let way = way.map_or("–".into(), |way| format!("{:.2}", to_decimals(way, 2)));
            let _ = write!(html, "<td>{way}</td>");
        }
        html += "</tr></table>\n";
    }
    html + "</section>\n"
}

/// Orders compared by the fulfilment of each triangle, by key views and, unless all have as many
/// partners, by pairs; empty unless asked for.
fn triangle_tables(e: &Evaluation) -> String {
    if e.orders.is_empty() {
        return String::new();
    }
    let is_even = e
        .key_views
        .windows(2)
        .all(|two| two[0].partners.len() == two[1].partners.len());
    let mut html = String::from(
        "<section tabindex=\"0\" aria-label=\"Orders by triangle\"><h2>Orders, by the fulfilment of each triangle</h2>\n",
    );
    let ways: &[bool] = if is_even { &[false] } else { &[false, true] };
    for &pairs in ways {
        let what = if pairs { "Pairs" } else { "Key views" };
        let _ = write!(
            html,
            "<p>{what} needed for a share of the fulfilment that all maps give (the paper's measure):</p>\n<table><tr><th>order</th>"
        );
        e.orders[0]
            .needed
            .iter()
            .for_each(|n| html += &format!("<th>{:.0} %</th>", 100.0 * n.share));
        html += "</tr>\n";
        for (names, cells) in baselines::rows(&e.orders, pairs) {
            let _ = write!(html, "<tr><td>{}</td>", escape(&names.join(", ")));
            cells
                .iter()
                .for_each(|cell| html += &format!("<td>{cell}</td>"));
            html += "</tr>\n";
        }
        html += "</table>\n";
    }
    html + "</section>\n"
}

/// Returns the comparison of the fused cloud with that of a full run; empty unless both were given.
fn clouds(e: &Evaluation) -> String {
    let Some(clouds) = &e.clouds else {
        return String::new();
    };
    let percent = |share: f64| format!("{:.1} %", 100.0 * share);
    let mut html = format!(
        "<section><h2>Fused cloud against the reference cloud</h2>\n<table><tr><th></th><th>this cloud</th><th>reference</th></tr>\n\
         <tr><td>points</td><td>{}</td><td>{}</td></tr>\n<tr><td>area, square units</td><td>{:.4}</td><td>{:.4}</td></tr>\n\
         <tr><td>median error, units</td><td>{}</td><td>–</td></tr></table>\n\
         <table><tr><th>within</th><th>completeness</th><th>precision</th></tr>\n",
        clouds.points,
        clouds.reference_points,
        clouds.area,
        clouds.reference_area,
        clouds
            .error
            .map_or("–".into(), |error| format!("{error:.4}")),
    );
    for at in &clouds.within {
        let _ = writeln!(
            html,
            "<tr><td>{:.0} GSD</td><td>{}</td><td>{}</td></tr>",
            at.gsd,
            percent(at.completeness),
            percent(at.precision)
        );
    }
    html + "</table></section>\n"
}

/// Returns the comparison with all at half the size; empty unless such depth maps were given.
fn half_size(e: &Evaluation) -> String {
    let section = |half: &HalfSize| {
        format!(
            "<section><h2>Half the size</h2>\n<p>{}</p></section>\n",
            half.in_words()
        )
    };
    e.half_size.as_ref().map(section).unwrap_or_default()
}

fn missing_table(e: &Evaluation) -> String {
    let mut html = format!(
        "<section><h2>Missing fulfilment</h2>\n<p>Triangles with less than half of their fulfilment, of {} in total, coloured in \
         <code>evaluation.ply</code>:</p>\n<table><tr><th>reason</th><th>triangles</th><th>share</th></tr>\n",
        e.triangles
    );
    for (missing, count) in &e.missing {
        let _ = writeln!(
            html,
            "<tr><td>{}</td><td>{count}</td><td>{:.1} %</td></tr>",
            missing.describe(),
            100.0 * *count as f64 / e.triangles.max(1) as f64
        );
    }
    html + "</table></section>\n"
}

fn key_view_table(e: &Evaluation) -> String {
    let mut html = String::from(
        "<section class=\"keys\" tabindex=\"0\" aria-label=\"Key views\"><h2>Key views</h2>\n<table><tr><th>key view</th><th>rank</th><th>partners matched</th><th>completeness</th>\
         <th>outliers</th><th>RMSE</th><th>predicted f</th><th>real f</th></tr>\n",
    );
    for (i, view) in e.key_views.iter().enumerate() {
        html += &key_view_row(i + 1, view);
    }
    html + "</table></section>\n"
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
