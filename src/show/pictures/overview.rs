//! A small map of a plan, for notebooks: cameras and surface from above.

use std::{collections::BTreeMap, fmt::Write};

use nalgebra::Point3;

use super::{
    plot,
    surface::{TriangleState, colour, triangle_states},
};
use crate::{base::printable::printable, model::georeference::MapFrame, plan::Plan};

/// Width of the map, pixels.
const WIDTH: f64 = 460.0;
const MARGIN: f64 = 14.0;
const HEADER: f64 = 34.0;
/// Most cells of the surface along the longer side.
const CELLS: f64 = 64.0;
/// Colour of a chosen key view and of other views, as in the curve and the report.
const CHOSEN: &str = "#d55e00";
const OTHER: &str = "#8a8a8a";

/// SVG map of the plan, north or the model's second axis up: the surface in the colours of
/// `surface.ply` (red nothing, blue all that can be reached at the cut), the chosen key views as
/// discs with their rank on hovering, the other views as rings.
pub fn map_svg(plan: &Plan) -> String {
    let frame = MapFrame::new(&plan.stages.scene, plan.stages.settings.surface.up);
    let surface = &plan.stages.surface;
    // Four places of each triangle, so that a large one colours more than one cell.
    let places = |t: u32| {
        let (corners, middle) = (surface.corners(t), surface.centroid(t));
        [middle, corners[0], corners[1], corners[2]].map(|place| frame.local(&place))
    };
    let triangles: Vec<[[f64; 3]; 4]> = (0..surface.triangles.len() as u32).map(places).collect();
    let views: Vec<Point3<f64>> = plan
        .stages
        .scene
        .views
        .iter()
        .map(|view| frame.local(&view.cam_from_world.centre()).into())
        .collect();
    let Some(sheet) = Sheet::around(
        triangles
            .iter()
            .flatten()
            .copied()
            .chain(views.iter().map(|view| [view.x, view.y, view.z])),
    ) else {
        return plot::document(WIDTH, HEADER, "No views", "");
    };
    let mut svg = String::new();
    let chosen = plan.decision.cut.clusters;
    let title = format!("{chosen} of {} views as key views", views.len());
    let _ = writeln!(
        svg,
        "<text x=\"{MARGIN}\" y=\"22\" font-weight=\"600\">{title}</text>"
    );
    draw_surface(&mut svg, &sheet, &triangles, &triangle_states(plan, chosen));
    draw_views(&mut svg, &sheet, plan, &views);
    plot::document(WIDTH, sheet.height, &title, &svg)
}

/// Draws the chosen key views as discs, the others as rings.
fn draw_views(svg: &mut String, sheet: &Sheet, plan: &Plan, places: &[Point3<f64>]) {
    let chosen = plan.chosen().map(|cluster| cluster.key);
    let rank = plan.stages.scene.places_of(chosen);
    // Draws the best ones last, on top.
    let mut order: Vec<usize> = (0..places.len()).collect();
    order.sort_by_key(|&v| std::cmp::Reverse(rank[v].unwrap_or(usize::MAX)));
    for v in order {
        let (x, y) = sheet.at([places[v].x, places[v].y]);
        // XML cannot hold control characters, not even escaped.
        let name = printable(&plan.stages.scene.views[v].name);
        let name = quick_xml::escape::escape(&name);
        let (style, label) = match rank[v] {
            Some(rank) => (
                format!("r=\"5\" fill=\"{CHOSEN}\" stroke=\"#fff\""),
                format!("{}: {name}", rank + 1),
            ),
            None => (
                format!("r=\"3\" fill=\"#fff\" stroke=\"{OTHER}\""),
                name.into_owned(),
            ),
        };
        let _ = writeln!(
            svg,
            "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" {style}><title>{label}</title></circle>"
        );
    }
}

/// Draws the state of each cell, summed over the triangles in it; cells without triangles stay
/// white.
fn draw_surface(
    svg: &mut String,
    sheet: &Sheet,
    triangles: &[[[f64; 3]; 4]],
    states: &[TriangleState],
) {
    let size = (WIDTH - 2.0 * MARGIN) / (triangles.len() as f64).sqrt().clamp(8.0, CELLS);
    // Sorted, so that the same plan gives the same bytes.
    let mut cells = BTreeMap::<(i64, i64), TriangleState>::new();
    for (places, state) in triangles.iter().zip(states) {
        for place in places {
            let (x, y) = sheet.at([place[0], place[1]]);
            let sum = cells
                .entry(((y / size) as i64, (x / size) as i64))
                .or_default();
            sum.fulfilment += state.fulfilment;
            sum.reachable += state.reachable;
        }
    }
    for ((row, column), state) in &cells {
        let [r, g, b] = colour(state);
        let _ = writeln!(
            svg,
            "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"{size:.1}\" height=\"{size:.1}\" fill=\"#{r:02x}{g:02x}{b:02x}\"/>",
            *column as f64 * size,
            *row as f64 * size,
        );
    }
}

/// Maps frame coordinates to pixels.
struct Sheet {
    low: [f64; 2],
    high: f64,
    scale: f64,
    height: f64,
}

impl Sheet {
    /// Returns the sheet that shows all points; `None` without any.
    fn around(points: impl Iterator<Item = [f64; 3]>) -> Option<Self> {
        let (mut low, mut high) = ([f64::MAX; 2], [f64::MIN; 2]);
        for point in points {
            for (axis, x) in point.into_iter().take(2).enumerate() {
                low[axis] = low[axis].min(x);
                high[axis] = high[axis].max(x);
            }
        }
        let sides = [high[0] - low[0], high[1] - low[1]];
        let longest = sides[0].max(sides[1]);
        (longest >= 0.0).then(|| {
            // A single point has no extent.
            let scale = (WIDTH - 2.0 * MARGIN) / longest.max(f64::MIN_POSITIVE);
            Self {
                low,
                high: high[1],
                scale,
                height: HEADER + MARGIN + sides[1] * scale,
            }
        })
    }

    fn at(&self, [x, y]: [f64; 2]) -> (f64, f64) {
        (
            MARGIN + (x - self.low[0]) * self.scale,
            HEADER + (self.high - y) * self.scale,
        )
    }
}
