//! The area of a region on the map, in numbers and in words.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::RegionFileError;
use crate::{
    base::{decimals::significant, progress::NoWatcher},
    config::Settings,
    method::{
        region::{COARSEST, Ground, Photographed, RegionError, RegionShape},
        target::GSD_MARGIN,
    },
    model::{
        georeference::{Georeference, MapFrame},
        scene::{Scene, ViewIndex},
    },
};

/// Area of a region on the map, and the parts that photographs miss (method 5.7).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct GroundSummary {
    /// Square scene units.
    pub area: f64,
    /// Share with a surface that some photograph shows, 0 to 1; null where no surface was built.
    pub surface: Option<f64>,
    /// Share that no photograph shows finely enough, 0 to 1: beside the surface in pixels of
    /// `coarsest` or less.
    pub unseen: f64,
    /// Part of it that some photograph shows more coarsely, as a share of the whole, 0 to 1.
    #[serde(default)]
    pub too_coarse: f64,
    /// Scene units per pixel at the size of the plan's images; of areas that want different ones,
    /// the largest.
    #[serde(default)]
    pub coarsest: f64,
    /// The same for the area that wants the finest; 0: unknown.
    #[serde(default)]
    pub coarsest_of_finest: f64,
    /// Share that a single photograph shows, 0 to 1.
    pub seen_once: f64,
    /// Photographs that must show a place for a depth there (`coverage.min_cameras`).
    #[serde(default)]
    pub needed: u32,
    /// Share that at least that many photographs show, 0 to 1.
    #[serde(default)]
    pub enough: f64,
}

impl GroundSummary {
    /// `has_surface`: a surface was laid over the region. `needed`: photographs that must show a
    /// place.
    pub fn new(ground: &Ground, has_surface: bool, needed: u32) -> Self {
        let wanted = || ground.cells.iter().map(|cell| cell.gsd);
        Self {
            area: ground.area,
            surface: has_surface.then(|| ground.share(|cell| cell.has_surface)),
            unseen: ground.share(|cell| cell.views == 0),
            too_coarse: ground.share(|cell| cell.too_coarse),
            coarsest: COARSEST * wanted().fold(0.0, f64::max),
            coarsest_of_finest: COARSEST * wanted().fold(f64::INFINITY, f64::min),
            seen_once: ground.share(|cell| cell.views == 1),
            needed,
            enough: ground.share(|cell| cell.views >= needed),
        }
    }

    /// Says how large the region is and how much of it has surface. `what`: the region, as the
    /// subject; `metres`: in a scene unit, if known.
    pub fn covered(&self, what: &str, metres: Option<f64>) -> String {
        let area = area_in_words(self.area, metres);
        match self.surface {
            Some(share) => format!(
                "{what} covers {area} on the map; the surface between the sparse points spans {} of it.",
                percent(share)
            ),
            None => format!("{what} covers {area} on the map."),
        }
    }

    /// Says how much of the region the photographs miss. `metres`: in a scene unit, if known.
    pub fn missed(&self, metres: Option<f64>) -> String {
        let in_metres = |share: f64| match metres {
            Some(_) if share > 0.0 => format!(" ({})", area_in_words(share * self.area, metres)),
            _ => String::new(),
        };
        let Self {
            unseen,
            seen_once,
            needed,
            enough,
            ..
        } = *self;
        if enough >= ALL {
            return format!("{needed} photographs or more show all of the region.");
        }
        // A share that would read as 0.0 % is not worth a clause.
        let [unseen, once] = [unseen, seen_once].map(|share| (is_some(share), share));
        let missed = match (unseen, once) {
            ((false, _), (false, _)) => {
                return format!(
                    "{needed} photographs or more show {} of the region.",
                    percent(enough)
                );
            }
            ((false, _), (_, once)) => format!(
                "Only one photograph shows {} of the region{}",
                percent(once),
                in_metres(once)
            ),
            ((_, unseen), (_, once)) => format!(
                "No photograph shows {} of the region{}{}, only one shows {}{}",
                percent(unseen),
                in_metres(unseen),
                self.finely_enough(metres).unwrap_or_default(),
                percent(once),
                in_metres(once)
            ),
        };
        format!(
            "{missed}{}, and the {needed} that each place needs, or more, show {}.",
            self.seen_by_few(in_metres),
            percent(enough)
        )
    }

    /// Says how much more than one photograph shows, but fewer than needed. `in_metres`: the area
    /// of a share in brackets.
    fn seen_by_few(&self, in_metres: impl Fn(f64) -> String) -> String {
        let share = 1.0 - self.unseen - self.seen_once - self.enough;
        let few = match self.needed {
            ..=2 => return String::new(),
            3 => "2".into(),
            needed => format!("2 to {}", needed - 1),
        };
        if !is_some(share) {
            return String::new();
        }
        format!(", {few} show {}{}", percent(share), in_metres(share))
    }

    /// Says what counts as shown, where photographs show more than that.
    pub fn finely_enough(&self, metres: Option<f64>) -> Option<String> {
        let unit = if metres.is_some() { "m" } else { "units" };
        let in_metres = |gsd: f64| significant(gsd * metres.unwrap_or(1.0));
        let coarsest = in_metres(self.coarsest);
        let coarsest = match in_metres(self.coarsest_of_finest) {
            finest if self.coarsest_of_finest > 0.0 && finest != coarsest => {
                format!("{finest} to {coarsest}")
            }
            _ => coarsest,
        };
        let others = match self.unseen - self.too_coarse {
            at_all if at_all < 1.0 - ALL => "others show it".into(),
            at_all => format!("none shows {} at all", percent(at_all)),
        };
        (self.too_coarse > 0.0).then(|| {
            format!(" finely enough ({coarsest} {unit} per pixel, {COARSEST} times the wanted, or finer; {others})")
        })
    }

    /// Returns whether a part of the region was missed that is worth a warning.
    pub fn is_incomplete(&self) -> bool {
        self.unseen + self.seen_once > MISSED
    }
}

/// Share that reads as 100.0 %.
const ALL: f64 = 0.9995;

/// Returns whether a share does not read as 0.0 %.
fn is_some(share: f64) -> bool {
    share > 1.0 - ALL
}

fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

/// Share of a region that no photograph, or a single one, shows, from which on it is a finding: its
/// rim is always seen less.
const MISSED: f64 = 0.01;

/// Formats an area of square scene units, in hectares where it is large.
pub fn area_in_words(area: f64, metres: Option<f64>) -> String {
    match metres.map(|metres| area * metres * metres) {
        Some(area) if area >= 10_000.0 => format!("{} ha", significant(area / 10_000.0)),
        Some(area) => format!("{} m²", significant(area)),
        None => format!("{} square units", significant(area)),
    }
}

/// Counts the photographs of the region of the settings, without a surface; `None` without a
/// region.
pub fn photographed_ground(
    scene: &Scene,
    place: &Georeference,
    settings: &Settings,
    without_image: &[ViewIndex],
) -> Result<Option<GroundSummary>, RegionFileError> {
    let ground = ground_without_surface(scene, place, settings, without_image)?;
    let needed = settings.coverage.min_cameras;
    Ok(ground.map(|ground| GroundSummary::new(&ground, false, needed)))
}

/// The error of a region of the settings whose numbers are probably degrees, where the model has no
/// place on earth.
pub fn region_in_degrees(
    scene: &Scene,
    place: &Georeference,
    settings: &Settings,
) -> Option<RegionError> {
    let frame = MapFrame::new(scene, settings.surface.up);
    match super::read(settings.region.as_ref()?, place, &frame).ok()? {
        RegionShape::Areas(areas) => areas.in_degrees(&scene.points),
        _ => None,
    }
}

/// Ground sampling distance that a plan of the scene wants, scene units per pixel of the matched
/// images.
pub fn wanted_gsd(scene: &Scene, settings: &Settings) -> Option<f64> {
    let by_images = || Some(GSD_MARGIN * scene.median_gsd()? / settings.image_scale());
    settings.target.gsd.or_else(by_images)
}

/// The ground of the region of the settings as the photographs show it, without a surface; `None`
/// without a region.
pub fn ground_without_surface(
    scene: &Scene,
    place: &Georeference,
    settings: &Settings,
    without_image: &[ViewIndex],
) -> Result<Option<Ground>, RegionFileError> {
    let scale = settings.image_scale();
    let gsd = wanted_gsd(scene, settings);
    let (Some(choice), Some(gsd)) = (&settings.region, gsd) else {
        return Ok(None);
    };
    let frame = MapFrame::new(scene, settings.surface.up);
    let region = super::read(choice, place, &frame)?;
    let photographed = Photographed {
        scene,
        left_out: without_image,
        gsd,
        image_scale: scale,
        surface: None,
    };
    Ok(region.footprint(&frame).and_then(|area| {
        // The only error is a cancellation, which does not happen here.
        Ground::new(&area, &photographed, &frame, &NoWatcher)
            .ok()
            .flatten()
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_missed_part_of_the_area_is_said_in_metres_where_they_are_known() {
        let ground = GroundSummary {
            area: 384.0,
            surface: Some(0.179),
            unseen: 0.812,
            too_coarse: 0.0,
            coarsest: 0.2,
            coarsest_of_finest: 0.2,
            seen_once: 0.004,
            needed: 3,
            enough: 0.18,
        };
        let covered = |metres| ground.covered("It", metres);
        assert_eq!(
            covered(Some(0.5)),
            "It covers 96.0 m² on the map; the surface between the sparse points spans 17.9 % of it."
        );
        assert!(covered(None).contains("384 square units"));
        assert!(covered(Some(100.0)).contains("384 ha"));
        assert_eq!(
            ground.missed(None),
            "No photograph shows 81.2 % of the region, only one shows 0.4 %, 2 show 0.4 %, and the 3 that each place needs, or more, show 18.0 %."
        );
        assert_eq!(
            ground.missed(Some(0.5)),
            "No photograph shows 81.2 % of the region (78.0 m²), only one shows 0.4 % (0.384 m²), 2 show 0.4 % (0.384 m²), and the 3 that each place needs, or more, show 18.0 %."
        );
        let oblique = GroundSummary {
            too_coarse: 0.512,
            ..ground
        };
        assert_eq!(
            oblique.missed(Some(0.5)),
            "No photograph shows 81.2 % of the region (78.0 m²) finely enough (0.100 m per pixel, 4 times the wanted, or finer; none shows 30.0 % at all), only one shows 0.4 % (0.384 m²), 2 show 0.4 % (0.384 m²), and the 3 that each place needs, or more, show 18.0 %."
        );
        let of_areas = GroundSummary {
            coarsest_of_finest: 0.04,
            ..oblique
        };
        let missed = of_areas.missed(Some(0.5));
        assert!(missed.contains("(0.0200 to 0.100 m per pixel"), "{missed}");
        let rim = GroundSummary {
            unseen: 0.0,
            enough: 0.992,
            ..ground
        };
        assert_eq!(
            rim.missed(None),
            "Only one photograph shows 0.4 % of the region, 2 show 0.4 %, and the 3 that each place needs, or more, show 99.2 %."
        );
        let rim = GroundSummary {
            seen_once: 0.0002,
            ..rim
        };
        assert_eq!(
            rim.missed(None),
            "3 photographs or more show 99.2 % of the region."
        );
        let unbuilt = GroundSummary {
            surface: None,
            ..ground
        };
        assert_eq!(
            unbuilt.covered("The region", Some(0.5)),
            "The region covers 96.0 m² on the map."
        );
        assert!(ground.is_incomplete());
        let whole = GroundSummary {
            unseen: 0.0,
            seen_once: 0.0,
            enough: 1.0,
            ..ground
        };
        assert!(!whole.is_incomplete() && whole.missed(None).contains("all of the region"));
    }
}
