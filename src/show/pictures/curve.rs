//! `curve.svg`: share of the area that all depth maps cover, over key views and over matching
//! pairs.

use super::plot::{self, COLOURS, Line, Plot};
use crate::plan::{Cut, Plan};

/// Label of the shares (method 5.2) in every plot.
pub const SHARE_LABEL: &str = "share of the area that all depth maps cover";

/// The share along a ranking; entry i is after i + 1 clusters.
#[derive(Clone, Debug, Default)]
pub struct FulfilmentCurve {
    /// Share of what fusion keeps of all clusters together, 0 to 1.
    pub share: Vec<f64>,
    /// Cumulative number of matching pairs.
    pub pairs: Vec<usize>,
    pub cut: Cut,
    /// Registered views.
    pub views: usize,
    /// True if the shares are those inside a region.
    pub of_region: bool,
    /// True for a program that uses the images themselves.
    pub of_images: bool,
}

impl FulfilmentCurve {
    /// Returns the curve that the plan predicts for its order.
    pub fn predicted(plan: &Plan) -> Self {
        let pairs = plan.decision.ranking.order.iter().scan(0, |sum, &c| {
            *sum += plan.stages.clusters[c as usize].partners.len();
            Some(*sum)
        });
        Self {
            share: (1..=plan.decision.ranking.order.len())
                .map(|n| plan.decision.ranking.share(n))
                .collect(),
            pairs: pairs.collect(),
            cut: plan.decision.cut,
            views: if plan.stages.makes_maps {
                plan.stages.scene.views.len()
            } else {
                plan.decision.forecast.all_maps
            },
            of_region: plan.stages.region.is_some(),
            of_images: !plan.stages.makes_maps,
        }
    }

    /// Returns the share and the number of pairs at the cut.
    fn at_cut(&self) -> Option<(f64, usize)> {
        let last = self.cut.clusters.checked_sub(1)?;
        Some((*self.share.get(last)?, *self.pairs.get(last)?))
    }

    fn title(&self) -> String {
        match self.at_cut() {
            Some((share, pairs)) => {
                let [chosen, views] = [self.cut.clusters, self.views];
                let what = if self.of_images {
                    format!("{chosen} of {views} images")
                } else {
                    format!("{chosen} of {views} views as key views, {pairs} pairs")
                };
                let share = 100.0 * share;
                let inside = if self.of_region {
                    " inside the region"
                } else {
                    ""
                };
                let of = self.share_label().trim_start_matches("share ");
                format!("{what}: {share:.1} % {of}{inside} (predicted)")
            }
            None => "No view cluster fulfils anything".into(),
        }
    }

    fn share_label(&self) -> &'static str {
        if self.of_images {
            "share of what all images draw"
        } else {
            SHARE_LABEL
        }
    }

    /// The bound of method 5.2; empty without a cut.
    fn subtitle(&self) -> String {
        let Cut {
            clusters,
            fulfilment,
            ..
        } = self.cut;
        if fulfilment <= 0.0 || self.of_images {
            return String::new();
        }
        format!(
            "No other choice of {clusters} depth maps is {} better, by the same prediction",
            self.cut.more_of_others()
        )
    }
}

const MARGIN: f64 = 6.0;
const HEADER: f64 = 64.0;

/// Returns an SVG of two plots, the share over key views and over pairs, with the cut marked.
pub fn curve_svg(curve: &FulfilmentCurve) -> String {
    let title = curve.title();
    let mut content = format!(
        "<text x=\"20\" y=\"30\" font-size=\"15\" font-weight=\"600\">{title}</text>\n\
         <text x=\"20\" y=\"52\" fill=\"#666\">{}</text>\n",
        curve.subtitle()
    );
    let key_views = (1..=curve.share.len()).collect::<Vec<_>>();
    let mut height = 0.0;
    let overs: &[(&str, &Vec<usize>)] = if curve.of_images {
        &[("images", &key_views)]
    } else {
        &[("key views", &key_views), ("matching pairs", &curve.pairs)]
    };
    for (i, &(over, x)) in overs.iter().enumerate() {
        let points = x.iter().map(|&n| n as f64).zip(curve.share.iter().copied());
        let points: Vec<(f64, f64)> = std::iter::once((0.0, 0.0)).chain(points).collect();
        let cut = points
            .get(curve.cut.clusters)
            .copied()
            .filter(|_| curve.cut.clusters > 0);
        let lines = [Line {
            label: "predicted",
            colour: COLOURS[0],
            dash: "",
            points,
        }];
        let plot = Plot {
            over,
            share_of: curve.share_label(),
            lines: &lines,
            cut,
        };
        plot.draw(&mut content, MARGIN + i as f64 * plot::WIDTH, HEADER);
        height = HEADER + plot.height();
    }
    plot::document(2.0 * (plot::WIDTH + MARGIN), height, &title, &content)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_drawing_is_xml_and_says_what_the_cut_gives() {
        let share = (1..=1000)
            .map(|n| 1.0 - (-f64::from(n) / 80.0).exp())
            .collect();
        let cut = Cut {
            clusters: 184,
            reachable: 0.873,
            fulfilment: 0.5,
            fulfilment_bound: 0.52,
            ..Default::default()
        };
        let svg = curve_svg(&FulfilmentCurve {
            share,
            pairs: (1..=1000).map(|n| 5 * n).collect(),
            cut,
            views: 1236,
            of_region: false,
            of_images: false,
        });
        assert!(svg.contains("184 of 1236 views as key views, 920 pairs: 90.0 %"));
        assert!(svg.contains("more than 4 % better"));
        assert!(svg.contains(">cut at 184<") && svg.contains(">cut at 920<"));
        let mut reader = quick_xml::Reader::from_str(&svg);
        while !matches!(
            reader.read_event().expect("well-formed XML"),
            quick_xml::events::Event::Eof
        ) {}
        assert!(svg.len() < 40_000, "{} bytes", svg.len());
    }

    #[test]
    fn an_empty_plan_has_a_drawing_too() {
        assert!(curve_svg(&FulfilmentCurve::default()).contains("No view cluster"));
    }
}
