//! The region of a plan, in the manifest and in words.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{
    config::TriangleWeight,
    method::region::RegionKind,
    plan::{GroundSummary, Plan},
};

/// Part of the scene that the plan is for (method 5.7); shares, fulfilment and cut are those
/// inside.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RegionSummary {
    /// "polygons", "box", "mesh", or "auto": the box around the places with the most pixels per
    /// area.
    pub kind: RegionKind,
    /// The box; of polygons and meshes that around the triangles inside. Corners x0, y0, z0, x1,
    /// y1, z1 in the frame of the model, as `--region` takes them.
    pub bounds: [f64; 6],
    /// Triangles that are at least partly inside.
    pub triangles: usize,
    /// Area of the surface inside, square scene units.
    pub area: f64,
    /// Its share of the area of the surface, 0 to 1.
    pub share_of_area: f64,
    /// Share inside of the weight that the whole surface would have without a region, 0 to 1.
    pub share_of_weight: f64,
    /// Its area on the map; null for `auto`, and for polygons that cannot be drawn there.
    #[serde(default)]
    pub ground: Option<GroundSummary>,
}

impl RegionSummary {
    /// `None` where the plan is for the whole surface.
    pub fn from_plan(plan: &Plan) -> Option<Self> {
        let (region, surface) = (plan.stages.region.as_ref()?, &plan.stages.surface);
        let all = || 0..surface.triangles.len() as u32;
        let area = plan.whole_area_inside();
        let whole: f64 = all().map(|t| surface.area(t)).sum();
        Some(Self {
            kind: region.kind,
            bounds: region.bounds,
            triangles: all().filter(|&t| region.is_inside(t)).count(),
            area,
            share_of_area: if whole > 0.0 { area / whole } else { 0.0 },
            share_of_weight: plan.stages.objective.inside,
            ground: plan.stages.ground_summary(),
        })
    }

    /// Returns a description of a few lines; for `auto` and a box it includes the corners as
    /// `--region` takes them.
    pub fn describe(&self, metres: Option<f64>) -> String {
        let corners = self.bounds.map(|x| short(x, &self.bounds)).join(",");
        let what = match self.kind {
            RegionKind::Polygons => "polygons".into(),
            RegionKind::Mesh => "a closed mesh".into(),
            RegionKind::Box => format!("the box {corners}"),
            RegionKind::Auto => format!("auto, the box {corners}"),
        };
        let ground = match self.ground {
            Some(ground) => vec![ground.covered("It", metres), ground.missed(metres)],
            None if self.kind == RegionKind::Auto => Vec::new(),
            None => vec![self.undrawn()],
        };
        [format!("Region: {what}.")]
            .into_iter()
            .chain(ground)
            .collect::<Vec<_>>()
            .join("\n")
    }

    /// Says what is known of a region whose area on the map is not.
    fn undrawn(&self) -> String {
        format!(
            "{:.1} % of the surface is inside. Its area on the map is not known, so what photographs miss of it is not counted.",
            100.0 * self.share_of_area
        )
    }

    /// Says how much of all the region is, in a line.
    pub fn part_of_all(&self, weight: TriangleWeight) -> String {
        let [area, weighed] = [self.share_of_area, self.share_of_weight].map(|share| 100.0 * share);
        match weight {
            TriangleWeight::Pixels => {
                format!(
                    "The region has {weighed:.1} % of the pixels and {area:.1} % of the surface."
                )
            }
            _ => format!("The region has {area:.1} % of the surface."),
        }
    }
}

/// Formats a coordinate to a thousandth of the shortest side.
fn short(x: f64, bounds: &[f64; 6]) -> String {
    let shortest = (0..3)
        .map(|axis| bounds[axis + 3] - bounds[axis])
        .fold(f64::INFINITY, f64::min);
    let places = (3.0 - shortest.log10().ceil()).clamp(0.0, 9.0);
    format!("{x:.0$}", if places.is_nan() { 3 } else { places as usize })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_a_region_without_an_area_on_the_map_the_share_of_the_surface_is_said() {
        let said = |kind| {
            let summary = RegionSummary {
                kind,
                bounds: [0.0, 0.0, 0.0, 1.0, 1.0, 1.0],
                triangles: 1,
                area: 1.0,
                share_of_area: 0.25,
                share_of_weight: 0.5,
                ground: None,
            };
            summary.describe(None)
        };
        assert!(said(RegionKind::Polygons).contains("25.0 % of the surface is inside"));
        assert!(!said(RegionKind::Auto).contains("surface"));
    }

    #[test]
    fn corners_have_the_digits_that_matter() {
        let words = |bounds| {
            let summary = RegionSummary {
                kind: RegionKind::Auto,
                bounds,
                triangles: 1,
                area: 1.0,
                share_of_area: 0.01,
                share_of_weight: 0.5,
                ground: None,
            };
            summary.describe(None)
        };
        assert!(
            words([-2.40123, -1.0, 0.9, -1.8, -0.8, 1.61])
                .contains("auto, the box -2.401,-1.000,0.900,")
        );
        assert!(
            words([-350.2, -180.0, -98.0, 109.0, 171.0, -34.0])
                .contains("box -350.2,-180.0,-98.0,109.0,171.0,-34.0.")
        );
        assert!(
            words([5e5, 5e6, 0.0, 5e5 + 4e3, 5e6 + 4e3, 4e3])
                .contains("box 500000,5000000,0,504000,5004000,4000.")
        );
    }
}
