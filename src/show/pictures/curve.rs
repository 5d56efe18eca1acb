//! `curve.svg`: share of the reachable fulfilment over key views and over matching pairs.

use std::fmt::Write;

use crate::plan::Plan;

/// A curve of share reached; entry i is after i + 1 clusters.
#[derive(Clone, Debug, Default)]
pub struct Curve {
    /// Share of what all clusters together reach, 0 to 1.
    pub share: Vec<f64>,
    /// Cumulative number of matching pairs.
    pub pairs: Vec<usize>,
    /// Clusters up to the cut.
    pub cut: usize,
    /// Registered views.
    pub views: usize,
}

impl Curve {
    /// The curve that the plan predicts for its order.
    pub fn predicted(plan: &Plan) -> Self {
        let pairs = plan.decision.ranking.order.iter().scan(0, |sum, &c| {
            *sum += plan.stages.clusters[c as usize].partners.len();
            Some(*sum)
        });
        Self {
            share: (1..=plan.decision.ranking.order.len()).map(|n| plan.decision.ranking.share(n)).collect(),
            pairs: pairs.collect(),
            cut: plan.decision.cut.clusters,
            views: plan.stages.scene.views.len(),
        }
    }

    /// Share and pairs at the cut.
    fn at_cut(&self) -> Option<(f64, usize)> {
        let last = self.cut.checked_sub(1)?;
        Some((*self.share.get(last)?, *self.pairs.get(last)?))
    }
}

const WIDTH: f64 = 860.0;
const HEIGHT: f64 = 380.0;
const PANEL_WIDTH: f64 = 340.0;
const PANEL_HEIGHT: f64 = 240.0;
const TOP: f64 = 80.0;
/// Points of a polyline; more would not be visible at this width.
const MOST_POINTS: usize = 600;

/// Two panels, share over key views and over pairs, with the cut marked.
pub fn curve_svg(curve: &Curve) -> String {
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" width=\"{WIDTH}\" height=\"{HEIGHT}\" \
         font-family=\"system-ui, sans-serif\" font-size=\"13\" fill=\"#333\">\n\
         <rect width=\"{WIDTH}\" height=\"{HEIGHT}\" fill=\"#fff\"/>\n"
    );
    let title = match curve.at_cut() {
        Some((share, pairs)) => format!(
            "{} of {} views as key views, {pairs} pairs: {:.1} % of what can be reached (predicted)",
            curve.cut,
            curve.views,
            share * 100.0
        ),
        None => "No view cluster fulfils anything".into(),
    };
    let _ = writeln!(svg, "<text x=\"18\" y=\"30\" font-size=\"16\" font-weight=\"600\">{title}</text>");
    let key_views: Vec<f64> = (1..=curve.share.len()).map(|n| n as f64).collect();
    let pairs: Vec<f64> = curve.pairs.iter().map(|&n| n as f64).collect();
    panel(&mut svg, 60.0, "key views", &key_views, curve);
    panel(&mut svg, 490.0, "matching pairs", &pairs, curve);
    svg.push_str("</svg>\n");
    svg
}

fn panel(svg: &mut String, left: f64, label: &str, x: &[f64], curve: &Curve) {
    let step = tick_step(x.last().copied().unwrap_or(1.0));
    let most = (x.last().copied().unwrap_or(1.0) / step).ceil().max(1.0) * step;
    let at_x = |value: f64| left + PANEL_WIDTH * value / most;
    let at_y = |share: f64| TOP + PANEL_HEIGHT * (1.0 - share);
    let (bottom, right) = (at_y(0.0), left + PANEL_WIDTH);
    for percent in (0..=100).step_by(20) {
        let y = at_y(f64::from(percent) / 100.0);
        let _ = writeln!(
            svg,
            "<path d=\"M{left} {y:.1}H{right}\" stroke=\"#e4e4e4\"/><text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{percent} %</text>",
            left - 8.0,
            y + 4.5
        );
    }
    let mut tick = 0.0;
    while tick <= most {
        let _ = writeln!(
            svg,
            "<path d=\"M{:.1} {bottom}v5\" stroke=\"#888\"/><text x=\"{0:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{tick}</text>",
            at_x(tick),
            bottom + 20.0
        );
        tick += step;
    }
    let _ = writeln!(
        svg,
        "<path d=\"M{left} {bottom}H{right}\" stroke=\"#888\"/>\n<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{label}</text>",
        left + PANEL_WIDTH / 2.0,
        bottom + 42.0
    );
    let _ = writeln!(
        svg,
        "<text x=\"{:.1}\" y=\"{:.1}\" fill=\"#666\">share of the reachable fulfilment</text>",
        left - 42.0,
        TOP - 14.0
    );
    let points = thinned(x.len()).map(|i| format!("{:.1},{:.1}", at_x(x[i]), at_y(curve.share[i])));
    let points: Vec<String> = std::iter::once(format!("{left:.1},{bottom:.1}")).chain(points).collect();
    let _ = writeln!(
        svg,
        "<polyline points=\"{}\" fill=\"none\" stroke=\"#1668a8\" stroke-width=\"2.2\" stroke-linejoin=\"round\"/>",
        points.join(" ")
    );
    if let Some(((share, _), cut)) = curve.at_cut().zip(curve.cut.checked_sub(1)) {
        let (cut_x, cut_y) = (at_x(x[cut]), at_y(share));
        let _ = writeln!(
            svg,
            "<path d=\"M{cut_x:.1} {bottom}V{cut_y:.1}H{left}\" fill=\"none\" stroke=\"#c0392b\" stroke-dasharray=\"4 3\"/>\n\
             <circle cx=\"{cut_x:.1}\" cy=\"{cut_y:.1}\" r=\"4\" fill=\"#c0392b\"/>\n\
             <text x=\"{:.1}\" y=\"{:.1}\" fill=\"#c0392b\">{} {label}</text>",
            cut_x + 8.0,
            cut_y + 18.0,
            x[cut]
        );
    }
}

/// About `MOST_POINTS` evenly spaced indices below `count`, and the last index.
fn thinned(count: usize) -> impl Iterator<Item = usize> {
    let step = count.div_ceil(MOST_POINTS).max(1);
    (0..count).filter(move |i| i % step == 0 || i + 1 == count)
}

/// 1, 2 or 5 times a power of ten, at most 6 of which fit.
fn tick_step(most: f64) -> f64 {
    let rough = (most / 6.0).max(1.0);
    let power = 10f64.powf(rough.log10().floor());
    [1.0, 2.0, 5.0, 10.0].map(|m| m * power).into_iter().find(|s| *s >= rough).unwrap_or(10.0 * power)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_drawing_is_xml_and_says_what_the_cut_gives() {
        let share = (1..=1000).map(|n| 1.0 - (-f64::from(n) / 80.0).exp()).collect();
        let curve = Curve { share, pairs: (1..=1000).map(|n| 5 * n).collect(), cut: 184, views: 1236 };
        let svg = curve_svg(&curve);
        assert!(svg.contains("184 of 1236 views as key views, 920 pairs: 90.0 %"));
        let mut reader = quick_xml::Reader::from_str(&svg);
        while !matches!(reader.read_event().expect("well-formed XML"), quick_xml::events::Event::Eof) {}
        assert!(svg.len() < 40_000, "{} bytes", svg.len());
    }

    #[test]
    fn an_empty_plan_has_a_drawing_too() {
        assert!(curve_svg(&Curve::default()).contains("No view cluster"));
    }

    #[test]
    fn ticks_are_round_numbers() {
        assert_eq!([7.0, 62.0, 1236.0].map(tick_step), [2.0, 20.0, 500.0]);
    }
}
