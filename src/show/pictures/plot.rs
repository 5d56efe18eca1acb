//! SVG plot of shares over a count: axes, ticks, lines, and a legend below them.

use std::fmt::Write;

use quick_xml::escape::escape;

/// Width of a plot with its labels, pixels.
pub const WIDTH: f64 = 440.0;
/// The area inside the axes.
const LEFT: f64 = 56.0;
const RIGHT: f64 = WIDTH - 20.0;
const TOP: f64 = 34.0;
const BOTTOM: f64 = TOP + 240.0;
/// Height of a plot without its legend.
const BARE_HEIGHT: f64 = BOTTOM + 54.0;
const LEGEND_COLUMNS: usize = 2;
const LEGEND_ROW: f64 = 19.0;
/// Approximate number of points of a polyline; more would not be visible at this width.
const MOST_POINTS: usize = 600;
/// The cut, not among the [`COLOURS`].
const CUT: &str = "#d55e00";

/// Colours of lines that the colour-blind can tell apart on white (Okabe and Ito, without the
/// yellow and the orange of the cut).
pub const COLOURS: [&str; 6] = [
    "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000",
];

/// A line of a plot.
#[derive(Clone, Debug)]
pub struct Line {
    pub label: &'static str,
    pub colour: &'static str,
    /// SVG dash pattern; empty for a solid line.
    pub dash: &'static str,
    /// x from 0, and a share, 0 to 1.
    pub points: Vec<(f64, f64)>,
}

/// Shares over a count.
#[derive(Clone, Debug)]
pub struct Plot<'a> {
    /// Label of the x axis.
    pub over: &'a str,
    /// Label of the y axis.
    pub share_of: &'a str,
    /// Lines of the plot; a legend is drawn if there is more than one.
    pub lines: &'a [Line],
    /// The cut, marked by a dot with dashed lines to both axes.
    pub cut: Option<(f64, f64)>,
}

impl Plot<'_> {
    /// Returns the height with the legend, pixels.
    pub fn height(&self) -> f64 {
        let labels = if self.lines.len() > 1 {
            self.lines.len()
        } else {
            0
        };
        BARE_HEIGHT + LEGEND_ROW * labels.div_ceil(LEGEND_COLUMNS) as f64
    }

    /// Adds the plot to a drawing, with its upper left corner at (`x`, `y`).
    pub fn draw(&self, svg: &mut String, x: f64, y: f64) {
        let scale = Scale::new(self.lines);
        let _ = writeln!(svg, "<g transform=\"translate({x} {y})\">");
        self.draw_axes(svg, &scale);
        for line in self.lines {
            scale.draw(svg, line);
        }
        if let Some(cut) = self.cut {
            draw_cut(svg, cut, &scale);
        }
        if self.lines.len() > 1 {
            self.draw_legend(svg);
        }
        svg.push_str("</g>\n");
    }

    fn draw_axes(&self, svg: &mut String, scale: &Scale) {
        for percent in (0..=100).step_by(20) {
            let (_, y) = scale.at((0.0, f64::from(percent) / 100.0));
            let stroke = if percent == 0 { "#888" } else { "#e4e4e4" };
            let _ = writeln!(
                svg,
                "<path d=\"M{LEFT} {y:.1}H{RIGHT}\" stroke=\"{stroke}\"/><text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{percent} %</text>",
                LEFT - 8.0,
                y + 4.5
            );
        }
        for tick in (0..)
            .map(|i| f64::from(i) * scale.step)
            .take_while(|&tick| tick <= scale.most)
        {
            let (x, _) = scale.at((tick, 0.0));
            let _ = writeln!(
                svg,
                "<path d=\"M{x:.1} {BOTTOM}v5\" stroke=\"#888\"/><text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
                BOTTOM + 20.0,
                short(tick)
            );
        }
        let _ = writeln!(
            svg,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>\n<text x=\"14\" y=\"{:.1}\" fill=\"#666\">{}</text>",
            (LEFT + RIGHT) / 2.0,
            BOTTOM + 42.0,
            escape(self.over),
            TOP - 16.0,
            escape(self.share_of)
        );
    }

    fn draw_legend(&self, svg: &mut String) {
        for (i, line) in self.lines.iter().enumerate() {
            let x = LEFT + (i % LEGEND_COLUMNS) as f64 * (RIGHT - LEFT) / LEGEND_COLUMNS as f64;
            let y = BARE_HEIGHT + LEGEND_ROW * (i / LEGEND_COLUMNS) as f64 + 6.0;
            let _ = writeln!(
                svg,
                "<path d=\"M{x} {y}h26\" fill=\"none\" {}/><text x=\"{}\" y=\"{}\">{}</text>",
                line.stroke(),
                x + 33.0,
                y + 4.5,
                escape(line.label)
            );
        }
    }
}

impl Line {
    fn stroke(&self) -> String {
        let dash = if self.dash.is_empty() {
            String::new()
        } else {
            format!(" stroke-dasharray=\"{}\"", self.dash)
        };
        format!(
            "stroke=\"{}\" stroke-width=\"2\" stroke-linejoin=\"round\"{dash}",
            self.colour
        )
    }
}

/// Scale that maps points of the plot to pixels.
struct Scale {
    /// Right end of the x axis, a multiple of `step`.
    most: f64,
    step: f64,
}

impl Scale {
    fn new(lines: &[Line]) -> Self {
        let most = lines
            .iter()
            .flat_map(|line| &line.points)
            .map(|point| point.0)
            // Not 0, by which an empty plot would divide.
            .fold(1.0, f64::max);
        let step = tick_step(most);
        Self {
            most: (most / step).ceil() * step,
            step,
        }
    }

    fn at(&self, (x, share): (f64, f64)) -> (f64, f64) {
        (
            LEFT + (RIGHT - LEFT) * x / self.most,
            BOTTOM - (BOTTOM - TOP) * share,
        )
    }

    fn draw(&self, svg: &mut String, line: &Line) {
        let point = |i: usize| {
            let (x, y) = self.at(line.points[i]);
            format!("{x:.1},{y:.1}")
        };
        let points: Vec<String> = thinned(line.points.len()).map(point).collect();
        let _ = writeln!(
            svg,
            "<polyline points=\"{}\" fill=\"none\" {}/>",
            points.join(" "),
            line.stroke()
        );
    }
}

/// Draws the cut, with its label at the foot of the vertical line, clear of the curves, on the side
/// with more room.
fn draw_cut(svg: &mut String, cut: (f64, f64), scale: &Scale) {
    let (x, y) = scale.at(cut);
    let (label_x, anchor) = if x > (LEFT + RIGHT) / 2.0 {
        (x - 8.0, "end")
    } else {
        (x + 8.0, "start")
    };
    let _ = writeln!(
        svg,
        "<path d=\"M{x:.1} {BOTTOM}V{y:.1}H{LEFT}\" fill=\"none\" stroke=\"{CUT}\" stroke-dasharray=\"4 3\"/>\n\
         <circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"{CUT}\"/>\n\
         <text x=\"{label_x:.1}\" y=\"{:.1}\" text-anchor=\"{anchor}\" font-weight=\"600\">cut at {}</text>",
        BOTTOM - 10.0,
        cut.0
    );
}

/// Returns an SVG file or element with a white background. `content`: its elements; `label`: a
/// description for screen readers.
pub fn document(width: f64, height: f64, label: &str, content: &str) -> String {
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" \
         font-family=\"system-ui, sans-serif\" font-size=\"13\" fill=\"#333\" role=\"img\" aria-label=\"{}\">\n\
         <rect width=\"{width}\" height=\"{height}\" fill=\"#fff\"/>\n{content}</svg>\n",
        escape(label)
    )
}

/// Returns about `MOST_POINTS` evenly spaced indices below `count`, and the last index.
fn thinned(count: usize) -> impl Iterator<Item = usize> {
    let step = count.div_ceil(MOST_POINTS).max(1);
    (0..count).filter(move |i| i % step == 0 || i + 1 == count)
}

/// Returns the distance between ticks: 1, 2 or 5 times a power of ten, so that at most 6 fit.
fn tick_step(most: f64) -> f64 {
    let rough = (most / 6.0).max(1.0);
    let power = 10f64.powf(rough.log10().floor());
    [1.0, 2.0, 5.0, 10.0]
        .map(|m| m * power)
        .into_iter()
        .find(|s| *s >= rough)
        .unwrap_or(10.0 * power)
}

/// Formats a round number with at most four digits, such as 2000, 20k or 1.2M.
fn short(tick: f64) -> String {
    match tick {
        1e6.. => format!("{}M", tick / 1e6),
        1e4.. => format!("{}k", tick / 1e3),
        _ => tick.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_numbers() {
        assert_eq!([7.0, 62.0, 1236.0].map(tick_step), [2.0, 20.0, 500.0]);
        assert_eq!(
            [500.0, 6000.0, 20_000.0, 1_200_000.0].map(short),
            ["500", "6000", "20k", "1.2M"]
        );
    }

    #[test]
    fn thinning_keeps_both_ends() {
        let kept: Vec<usize> = thinned(1501).collect();
        assert_eq!((kept[0], kept[kept.len() - 1]), (0, 1500));
        assert!(kept.len() <= MOST_POINTS + 1);
    }

    #[test]
    fn only_several_lines_make_a_legend() {
        let line = |label| Line {
            label,
            colour: COLOURS[0],
            dash: "",
            points: vec![(0.0, 0.0), (3.0, 1.0)],
        };
        let drawn = |lines: &[Line]| {
            let (mut svg, plot) = (
                String::new(),
                Plot {
                    over: "key views",
                    share_of: "share",
                    lines,
                    cut: None,
                },
            );
            plot.draw(&mut svg, 0.0, 0.0);
            (svg, plot.height())
        };
        let (one, low) = drawn(&[line("real")]);
        let (two, high) = drawn(&[line("real"), line("a < b")]);
        assert!(!one.contains("real") && two.contains("real") && two.contains("a &lt; b"));
        assert!(low < high);
    }
}
