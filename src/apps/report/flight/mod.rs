//! Plans further images that fill the holes: poses, chosen greedily by the objective of the plan
//! from candidates around each hole.
//!
//! There are no pictures of planned images yet: success is predicted from geometry alone.

mod bare;
mod candidates;
mod choice;
mod files;
mod missed;
mod outlines;

use nalgebra::{Point3, Vector3};

use super::holes::Hole;
use crate::{
    base::{advice::on_command_line, error::Advice, progress::Watcher},
    config::Settings,
    method::{target::GSD_MARGIN, visibility::VisibilityError},
    model::{georeference::MapFrame, scene::Scene},
    plan::{Plan, Stages, length_in_words},
};

pub use bare::{BareGround, MOST, bare_ground};
pub use files::files;
pub use missed::{missed, missed_areas, unbuilt_ground};

/// Height above the ground up to which drones are flown without a permit in the EU; in the US it is
/// 400 ft. Metres.
const LEGAL_HEIGHT: f64 = 120.0;
/// Overlap below which neighbouring images are not sure to match.
const LITTLE_OVERLAP: f64 = 0.6;

/// An image to take.
#[derive(Clone, Debug, PartialEq)]
pub struct Waypoint {
    /// Order in which it was chosen, from 1: if only some can be flown, the first ones fill most.
    pub rank: usize,
    /// World coordinates.
    pub centre: Point3<f64>,
    /// Viewing direction, a unit vector in world coordinates.
    pub direction: Vector3<f64>,
    /// Hole that it was planned for, an index into the listed holes.
    pub hole: usize,
    /// Height above the place that it looks at, scene units.
    pub height: f64,
    /// Distance from the place that it looks at, scene units.
    pub distance: f64,
    /// Largest share of what it sees, by area, that one other image sees too, planned or taken; 0
    /// to 1.
    pub overlap: f64,
}

/// The images to take, in the order to fly them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Flight {
    pub waypoints: Vec<Waypoint>,
    /// Part of the weight of each listed hole that fusion is expected to keep with them, 0 to 1.
    pub of_holes: Vec<f64>,
    /// About how many more would be needed beyond the most that are planned.
    pub more: usize,
    /// Spacing of the images over bare ground: [`BareGround::spacing`].
    pub spacing: Option<[f64; 2]>,
}

/// The data that nadir images are planned from.
#[derive(Clone, Copy)]
pub struct Site<'a> {
    pub scene: &'a Scene,
    /// Size of the matched images over that of the model's.
    pub image_scale: f64,
    /// Vertices of the surface, above which they stay; none where it is unknown.
    pub surface: &'a [Point3<f64>],
}

impl<'a> Site<'a> {
    pub fn of_plan(stages: &'a Stages) -> Self {
        Self {
            scene: &stages.scene,
            image_scale: stages.settings.image_scale(),
            surface: &stages.surface.vertices,
        }
    }
}

/// Plans the images for the holes.
pub fn flight(
    plan: &Plan,
    holes: &[Hole],
    watcher: &dyn Watcher,
) -> Result<Flight, VisibilityError> {
    let frame = MapFrame::new(&plan.stages.scene, plan.stages.settings.surface.up);
    let poses = candidates::around(plan, holes, &frame);
    if poses.is_empty() {
        return Ok(Flight::default());
    }
    let mut flight = choice::choose(plan, holes, &poses, &frame, watcher)?;
    flight.waypoints = in_flying_order(flight.waypoints);
    Ok(flight)
}

impl Flight {
    /// Adds the images of bare ground, which becomes the first of the listed holes.
    pub fn with_ground_first(mut self, bare: &BareGround) -> Self {
        let before = self.waypoints.len();
        self.waypoints.iter_mut().for_each(|own| own.hole += 1);
        self.waypoints
            .extend(bare.waypoints.iter().map(|waypoint| Waypoint {
                rank: before + waypoint.rank,
                ..waypoint.clone()
            }));
        self.of_holes.insert(0, bare.covered);
        self.more = bare.more;
        self.spacing = bare.spacing;
        self
    }

    /// Returns a warning if more images are needed than are planned.
    pub fn unplanned(&self) -> Option<String> {
        (self.more > 0).then(|| {
            let what = format!(
                "only the {MOST} images nearest to the photographs are planned for bare ground; all of it would take about {} more: use a coarser ",
                two_digits(self.more)
            );
            let cure = Advice::text(what).set("target.gsd");
            on_command_line(&cure.and(", or plan the region in parts"))
        })
    }

    /// Returns what to know before the images are flown. `metres`: in a scene unit, if known.
    pub fn cautions(&self, metres: Option<f64>) -> Vec<String> {
        let cautions = [
            self.unplanned(),
            self.too_high(metres),
            self.little_overlap(),
        ];
        cautions.into_iter().flatten().collect()
    }

    fn too_high(&self, metres: Option<f64>) -> Option<String> {
        let metres = metres?;
        let heights = self.waypoints.iter().map(|image| metres * image.height);
        let high: Vec<f64> = heights.filter(|height| *height > LEGAL_HEIGHT).collect();
        let highest = high.iter().copied().fold(0.0, f64::max);
        let which = self.part(high.len(), ["is", "are"])?;
        let what = format!(
            "{which} higher than {LEGAL_HEIGHT} m above the ground (up to {:.0} m), where the EU and the US ask for a permit: a finer ",
            highest.ceil()
        );
        let cure = Advice::text(what).set("target.gsd");
        Some(on_command_line(&cure.and(" plans lower ones")))
    }

    fn little_overlap(&self) -> Option<String> {
        let overlaps = self.waypoints.iter().map(|image| image.overlap);
        let little = overlaps.filter(|overlap| *overlap < LITTLE_OVERLAP).count();
        let which = self.part(little, ["shares", "share"])?;
        Some(format!(
            "{which} less than {:.0} % of the view with any one other: fly some between them, or they may not match",
            100.0 * LITTLE_OVERLAP
        ))
    }

    /// Begins a sentence about some of the images, with the verb for one or more; `None` for none
    /// of them.
    fn part(&self, number: usize, [one, more]: [&str; 2]) -> Option<String> {
        let all = self.waypoints.len();
        Some(match number {
            0 => return None,
            1 => format!("1 of the {all} planned images {one}"),
            _ if number == all => format!("all {all} planned images {more}"),
            _ => format!("{number} of the {all} planned images {more}"),
        })
    }

    /// Returns notes on the planned images: what they are for, their margin and distances, and the
    /// cautions. `purpose`: as [`purpose`].
    pub fn remarks(&self, purpose: String, metres: Option<f64>) -> String {
        let spacing = self.spacing.map(|spacing| {
            let [along, between] = spacing.map(|apart| length_in_words(apart, metres));
            format!("Over bare ground they are {along} apart on a line, and the lines {between}.")
        });
        let cautions = self.cautions(metres).into_iter();
        let cautions = cautions.map(|caution| format!("Note: {caution}."));
        [purpose, margin()]
            .into_iter()
            .chain(spacing)
            .chain(cautions)
            .collect::<Vec<_>>()
            .join(" ")
    }
}

/// Says for which resolution and region the files of a flight are, to tell them from those of
/// another plan.
pub fn purpose(stages: &Stages) -> String {
    let in_words = |gsd| stages.gsd_in_words(gsd);
    purpose_of(&stages.settings, &stages.wanted(), in_words)
}

/// The same of settings without a plan. `wanted`: the resolution.
pub fn purpose_of(
    settings: &Settings,
    wanted: &str,
    gsd_in_words: impl Fn(f64) -> String,
) -> String {
    let region = settings.region.as_ref().map(|region| match region.file() {
        Some(file) => file
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned(),
        None => region.to_string(),
    });
    let region = region.map_or_else(String::new, |region| format!("; region: {region}"));
    // Images at a part of their size show less than they do as photographs.
    let scale = settings.image_scale();
    let of_photographs = settings.target.gsd.filter(|_| scale != 1.0);
    let of_photographs = of_photographs.map_or_else(String::new, |gsd| {
        let own = gsd_in_words(gsd * scale);
        format!(" in depth maps at image_scale {scale}, so {own} in a photograph")
    });
    format!("Planned for {wanted}{of_photographs}{region}.")
}

fn margin() -> String {
    format!(
        "Each image is at {} of the distance that gives this: what is lower or slanted comes out coarser.",
        1.0 / GSD_MARGIN
    )
}

/// Rounds up to two significant digits.
fn two_digits(number: usize) -> usize {
    let unit = 10_usize.pow(number.max(1).ilog10().saturating_sub(1));
    number.div_ceil(unit) * unit
}

/// Returns the waypoints ordered so that each is followed by the nearest one left.
fn in_flying_order(mut left: Vec<Waypoint>) -> Vec<Waypoint> {
    let mut ordered: Vec<Waypoint> = Vec::with_capacity(left.len());
    while !left.is_empty() {
        let from = ordered.last().map(|last| last.centre);
        let distance =
            |waypoint: &Waypoint| from.map_or(0.0, |from| (waypoint.centre - from).norm());
        let next = (0..left.len())
            .min_by(|&a, &b| distance(&left[a]).total_cmp(&distance(&left[b])))
            .unwrap_or(0);
        ordered.push(left.remove(next));
    }
    ordered
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heights_beyond_the_law_and_little_overlap_are_said() {
        let image = |height: f64, overlap: f64| Waypoint {
            rank: 1,
            centre: Point3::origin(),
            direction: -Vector3::z(),
            hole: 0,
            height,
            distance: height,
            overlap,
        };
        let said = |images: Vec<Waypoint>, metres| {
            let waypoints = images;
            let flight = Flight {
                waypoints,
                ..Flight::default()
            };
            flight.cautions(metres)
        };
        assert!(said(vec![image(119.0, 0.7)], Some(1.0)).is_empty());
        // Without a known unit no height is compared.
        assert!(said(vec![image(1e6, 0.7)], None).is_empty());
        let both = said(vec![image(70.0, 0.5), image(50.0, 0.9)], Some(2.0));
        assert!(both[0].starts_with("1 of the 2 planned images is higher than 120 m"));
        assert!(both[0].contains("up to 140 m") && both[1].contains("less than 60 %"));
    }
}
