//! Photometric confidence (method 7.4): agreement of the pictures on the surface, computed before
//! anything is matched and without training.
//!
//! Each view samples its picture at fixed positions of every triangle that it sees. Where the
//! samples of two views correlate, a backend finds the match too; where they don't (no texture,
//! leaves, gloss, a wrong surface), it does not.

mod compare;
mod grey;
mod sharpness;
mod stacks;

use std::sync::Arc;

use self::compare::{Sampled, compared, samples};
pub use self::{compare::SampleRoom, grey::Grey, sharpness::Sharpness, stacks::SPACING};
use super::pictures::{
    NOT_COMPARED, NOT_PLANNED, PictureError, PictureFault, Pictures, picture_warnings,
};
use crate::{
    base::{
        column::{Column, READ_AT_ONCE, TableError},
        progress::Watcher,
    },
    method::{confidence::ConfidenceSettings, geometry::Geometry},
    model::{
        cluster::Reach,
        scene::{Scene, ViewIndex},
    },
};

/// Chance of a match by the correlation of the pictures (method 7.4); each backend has its own.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Photometric {
    /// Where the pictures agree, 0 to 1.
    pub agree: f64,
    /// Where they don't: matchers also search elsewhere along the ray, and smooth over, 0 to
    /// `agree`.
    pub differ: f64,
    /// Correlation from which the pictures count as in full agreement, above 0, at most 1.
    pub full_agreement: f64,
}

impl Photometric {
    /// Returns these parameters with the user's settings in place of theirs.
    pub fn with(&self, settings: &ConfidenceSettings) -> Self {
        let agree = settings.agree.unwrap_or(self.agree);
        Self {
            agree,
            // A user's `agree` may be below the backend's `differ`.
            differ: settings.differ.unwrap_or(self.differ).min(agree),
            full_agreement: settings.full_agreement.unwrap_or(self.full_agreement),
        }
    }

    /// p_i of a pair at a triangle, 0 to 1: `differ + (agree - differ) min(correlation /
    /// full_agreement, 1)`; 0 if the program does not search there, or the two pictures show no
    /// common patch.
    pub fn chance(&self, agreement: u8) -> f64 {
        match correlated(agreement) {
            // Curves of angle, scale, incidence and contrast on top raise the area under the ROC
            // curve from 0.91 to 0.93 on seven sets, but save no maps and forecast no better.
            Some(correlation) => {
                self.differ
                    + (self.agree - self.differ) * (correlation / self.full_agreement).min(1.0)
            }
            None => 0.0,
        }
    }
}

const NO_FOLDER: &str = "the project has no image folder: no pictures were compared";

/// Quantisation steps of a correlation from 0 to 1.
const STEPS: f32 = 254.0;

/// 0: not visible in both; else 1 + the correlation in [`STEPS`], clamped at 0.
fn packed(correlation: Option<f32>) -> u8 {
    correlation.map_or(0, |correlation| {
        1 + (correlation.clamp(0.0, 1.0) * STEPS).round() as u8
    })
}

fn correlated(agreement: u8) -> Option<f64> {
    agreement
        .checked_sub(1)
        .map(|steps| f64::from(steps) / f64::from(STEPS))
}

/// Agreement of pairs of pictures on each triangle that the key view sees.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Agreement {
    /// By key view: start of its values, and its rows of visibility.
    keys: Vec<(usize, usize)>,
    /// Partners of each key view, in the order of their values; CSR by view.
    pub offsets: Vec<usize>,
    pub partners: Vec<ViewIndex>,
    /// By view: true if its picture was compared.
    compared: Vec<bool>,
    /// By key view, then partner, then row of the key view: 0 if the pictures share no patch, else
    /// 1 + 254 times the correlation.
    pub values: Arc<Column<u8>>,
    /// Views whose picture is damaged or has the wrong aspect ratio, ascending: neither key views
    /// nor partners. Empty if no pair was compared.
    pub rejected: Vec<ViewIndex>,
    /// Warnings of unusable pictures.
    pub warnings: Vec<String>,
    /// By view, [`Grey::detail`] of its picture; zeros without one.
    pub detail: Vec<[f64; 2]>,
}

/// Agreement of a pair, or the reason for its absence.
pub enum PairAgreement<'a> {
    /// One value for each row of the key view.
    Compared(&'a [u8]),
    /// Not compared, because the backend is not expected to match the pair; occurs only in clusters
    /// of other origin.
    NoCandidate,
    /// One of the two views has no usable picture.
    NoPicture,
}

/// The table of a plan that compares no pictures.
pub static NO_AGREEMENT: std::sync::LazyLock<Agreement> =
    std::sync::LazyLock::new(Agreement::default);

/// What the program can match of each pair, by its own rule.
pub struct ProgramReach<'a, 'r> {
    /// Name of the program if it has such a rule.
    pub program: Option<&'static str>,
    /// Returns what the program can match of the pairs of a key view.
    pub of_key_view: &'a (dyn Fn(ViewIndex) -> ReachOfPartner<'r> + Sync),
}

/// Returns what the program can match of the pair of a key view and this partner.
pub type ReachOfPartner<'a> = Box<dyn Fn(ViewIndex) -> Reach + 'a>;

impl ProgramReach<'_, '_> {
    /// Programs that match whatever two pictures show.
    pub const EVERYTHING: ProgramReach<'static, 'static> = ProgramReach {
        program: None,
        of_key_view: &|_| Box::new(|_| Reach::Everything),
    };
}

impl Agreement {
    /// Compares the picture of each view with those of its partners. Views without a usable picture
    /// have no values.
    pub fn new<'p>(
        geometry: &Geometry,
        pictures: &dyn Pictures,
        partners_of: impl Fn(ViewIndex) -> &'p [ViewIndex] + Sync,
        reach: &ProgramReach,
        room: SampleRoom,
        watcher: &dyn Watcher,
    ) -> Result<Self, TableError> {
        let Sampled {
            samples,
            detail,
            faults,
        } = samples(geometry, pictures, room, watcher)?;
        let mut without = vec![!pictures.have_images(); geometry.scene.views.len()];
        for (view, _) in &faults {
            without[view.index()] = true;
        }
        let mut table = Self::laid_out(geometry, &partners_of, &without);
        table.values = Arc::new(table.compare(geometry, &samples, reach, watcher)?);
        table.detail = detail;
        table.reject(faults, geometry.scene);
        if !pictures.have_images() {
            table.warnings.push(NO_FOLDER.into());
        }
        Ok(table)
    }

    /// Returns the values of all pairs.
    fn compare(
        &self,
        geometry: &Geometry,
        samples: &Column<i8>,
        reach: &ProgramReach,
        watcher: &dyn Watcher,
    ) -> Result<Column<u8>, TableError> {
        let of_key = |places: &mut Vec<u32>, key: ViewIndex| {
            watcher.check()?;
            places.resize(geometry.surface.triangles.len(), u32::MAX);
            let partners = self.partners_of(key);
            Ok(compared(geometry, samples, key, partners, reach, places))
        };
        geometry.visibility.column(READ_AT_ONCE, Vec::new, of_key)
    }

    /// Rejects the views whose picture cannot be used, and warns of all faults.
    fn reject(&mut self, faults: Vec<PictureFault>, scene: &Scene) {
        // Without a compared pair, no view has evidence against it that the others lack.
        let is_rejected = |fault: &PictureError| !self.is_empty() && fault.is_unusable;
        let (rejected, others): (Vec<_>, Vec<_>) = faults
            .into_iter()
            .partition(|(_, fault)| is_rejected(fault));
        self.warnings = picture_warnings(scene, &rejected, NOT_PLANNED);
        self.warnings
            .extend(picture_warnings(scene, &others, NOT_COMPARED));
        self.rejected = rejected.into_iter().map(|(view, _)| view).collect();
    }

    /// Returns the views without a usable picture, ascending.
    pub fn not_compared(&self) -> impl Iterator<Item = ViewIndex> {
        let views = (0..).zip(&self.compared);
        views.filter_map(|(view, compared)| (!compared).then_some(ViewIndex(view)))
    }

    /// Builds a table without values; `without`: by view, true if it has no usable picture.
    pub fn laid_out<'p>(
        geometry: &Geometry,
        partners_of: impl Fn(ViewIndex) -> &'p [ViewIndex],
        without: &[bool],
    ) -> Self {
        let has_picture = |view: &ViewIndex| !without[view.index()];
        let compared = without.iter().map(|without| !without).collect();
        let mut table = Self {
            offsets: vec![0],
            compared,
            ..Self::default()
        };
        let mut start = 0;
        for key in geometry.scene.view_indices() {
            let rows = geometry.visibility.triangles_seen_by(key).len();
            table.keys.push((start, rows));
            if has_picture(&key) {
                let before = table.partners.len();
                table
                    .partners
                    .extend(partners_of(key).iter().copied().filter(has_picture));
                start += rows * (table.partners.len() - before);
            }
            table.offsets.push(table.partners.len());
        }
        table
    }

    /// Number of values.
    pub fn len(&self) -> usize {
        let last = self
            .keys
            .len()
            .checked_sub(1)
            .map(|last| ViewIndex(last as u32));
        last.map_or(0, |last| {
            self.keys[last.index()].0 + self.keys[last.index()].1 * self.partners_of(last).len()
        })
    }

    fn partners_of(&self, key: ViewIndex) -> &[ViewIndex] {
        match self.offsets.get(key.index()..key.index() + 2) {
            Some(bounds) => &self.partners[bounds[0]..bounds[1]],
            None => &[],
        }
    }

    /// Returns the agreement of a pair on each triangle that the key view sees, in the order of its
    /// rows.
    pub fn of_pair(&self, key: ViewIndex, partner: ViewIndex) -> PairAgreement<'_> {
        let is_compared = |view: ViewIndex| {
            self.compared
                .get(view.index())
                .is_some_and(|&compared| compared)
        };
        if !is_compared(key) || !is_compared(partner) {
            return PairAgreement::NoPicture;
        }
        match self.partners_of(key).iter().position(|&p| p == partner) {
            Some(place) => {
                let (start, rows) = self.keys[key.index()];
                PairAgreement::Compared(&self.values[start + place * rows..][..rows])
            }
            None => PairAgreement::NoCandidate,
        }
    }

    /// Returns a table of made-up values; `without`: by view, true if it has no usable picture.
    #[cfg(test)]
    pub fn made_up<'p>(
        geometry: &Geometry,
        partners_of: impl Fn(ViewIndex) -> &'p [ViewIndex],
        without: &[bool],
        value: impl Fn(ViewIndex, ViewIndex, u32) -> u8,
    ) -> Self {
        let table = Self::laid_out(geometry, partners_of, without);
        let of_pair = |key: ViewIndex, partner| {
            geometry
                .visibility
                .triangles_seen_by(key)
                .iter()
                .map(move |&t| (key, partner, t))
        };
        let pairs = geometry
            .scene
            .view_indices()
            .flat_map(|key| table.partners_of(key).iter().map(move |&p| (key, p)));
        let values: Vec<u8> = pairs
            .flat_map(|(key, p)| of_pair(key, p))
            .map(|(key, p, t)| value(key, p, t))
            .collect();
        assert_eq!(values.len(), table.len());
        Self {
            values: Arc::new(values.into()),
            ..table
        }
    }

    pub fn is_empty(&self) -> bool {
        self.partners.is_empty()
    }

    /// Lets the operating system drop pages of a table on disk; they are read again when needed.
    pub fn release(&self) {
        self.values.release();
    }

    /// Returns the table's heap memory, bytes.
    pub fn bytes(&self) -> usize {
        self.values.bytes() + 4 * self.partners.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        base::{column::Storage, progress::NoWatcher},
        method::{
            confidence::Mask,
            synthetic::{SeenTown, Town},
            target::TargetSettings,
        },
        model::scene::Scene,
    };

    pub fn town() -> SeenTown {
        Town {
            edge: 4.0,
            points: 50,
            ..Town::default()
        }
        .seen(&TargetSettings::default(), 0.05, Storage::Memory)
    }

    /// The view with most triangles in common.
    pub fn view_that_overlaps(geometry: &Geometry, key: ViewIndex) -> ViewIndex {
        let seen = geometry.visibility.triangles_seen_by(key);
        let common = |view: &ViewIndex| {
            seen.iter()
                .filter(|&&t| geometry.visibility.row(*view, t).is_some())
                .count()
        };
        geometry
            .scene
            .view_indices()
            .filter(|view| *view != key)
            .max_by_key(common)
            .unwrap()
    }

    /// Black pictures, of which some are missing and one is damaged.
    struct Black {
        missing: Vec<ViewIndex>,
        damaged: ViewIndex,
    }

    impl Pictures for Black {
        fn have_images(&self) -> bool {
            true
        }

        fn grey(
            &self,
            scene: &Scene,
            view: ViewIndex,
            _: f64,
        ) -> Result<Option<(Grey, Option<Mask>)>, PictureError> {
            let is_missing = self.missing.contains(&view);
            if is_missing || view == self.damaged {
                return Err(PictureError {
                    cause: "no picture".into(),
                    is_unusable: !is_missing,
                    is_known: is_missing,
                });
            }
            let camera = scene.camera_of(view);
            let [width, height] = [camera.width, camera.height].map(|side| side as usize / 2);
            Ok(Some((
                Grey::new(width, height, vec![0; width * height]),
                None,
            )))
        }

        fn mask(&self, _: &Scene, _: ViewIndex) -> Result<Option<Mask>, PictureError> {
            Ok(None)
        }
    }

    #[test]
    fn pictures_that_are_missing_or_damaged() {
        let town = town();
        let geometry = town.geometry(1.0);
        let views: Vec<ViewIndex> = town.scene.view_indices().collect();
        let [missing, damaged] = [views[0], views[1]];
        let compared = |without: &[ViewIndex]| {
            let pictures = Black {
                missing: without.to_vec(),
                damaged,
            };
            // A plan never pairs a view without an image.
            let partners_of = |view: ViewIndex| {
                if view == missing {
                    &[][..]
                } else {
                    &views[1..4]
                }
            };
            let room = SampleRoom {
                keep: Storage::Memory,
                views_at_once: 4,
            };
            let everything = &ProgramReach::EVERYTHING;
            Agreement::new(
                &geometry,
                &pictures,
                partners_of,
                everything,
                room,
                &NoWatcher,
            )
            .unwrap()
        };
        let table = compared(&[missing]);
        let is_without_picture = |a, b| matches!(table.of_pair(a, b), PairAgreement::NoPicture);
        assert!(is_without_picture(missing, views[2]) && is_without_picture(views[2], missing));
        assert!(is_without_picture(damaged, views[2]) && !is_without_picture(views[3], views[2]));
        assert_eq!(
            (&table.rejected[..], table.warnings.len()),
            (&[damaged][..], 1)
        );
        let all_but_damaged: Vec<ViewIndex> = views
            .iter()
            .copied()
            .filter(|view| *view != damaged)
            .collect();
        assert_eq!(compared(&all_but_damaged).rejected, [], "no pair is left");
    }

    const NUMBERS: Photometric = Photometric {
        agree: 0.9,
        differ: 0.2,
        full_agreement: 0.8,
    };

    #[test]
    fn chances_rise_with_the_correlation_up_to_full_agreement() {
        let chance = |correlation: f32| NUMBERS.chance(packed(Some(correlation)));
        for (correlation, expected) in
            [(-1.0, 0.2), (0.0, 0.2), (0.4, 0.55), (0.8, 0.9), (1.0, 0.9)]
        {
            assert!(
                (chance(correlation) - expected).abs() < 0.002,
                "{correlation}: {}",
                chance(correlation)
            );
        }
        assert_eq!(NUMBERS.chance(packed(None)), 0.0);
    }

    #[test]
    fn settings_take_the_place_of_the_programs_numbers() {
        let settings = |agree, differ, full_agreement| ConfidenceSettings {
            agree,
            differ,
            full_agreement,
            ..ConfidenceSettings::default()
        };
        assert_eq!(NUMBERS.with(&settings(None, None, None)), NUMBERS);
        let all = Photometric {
            agree: 0.7,
            differ: 0.1,
            full_agreement: 0.5,
        };
        assert_eq!(
            NUMBERS.with(&settings(Some(0.7), Some(0.1), Some(0.5))),
            all
        );
        assert_eq!(
            NUMBERS.with(&settings(Some(0.15), None, None)).differ,
            0.15,
            "never above the chance where they agree"
        );
    }
}
