//! Measured numbers of the MVS program that a plan is made for.

use serde::Serialize;

use crate::{
    method::{
        confidence::{PairConfidence, Photometric},
        partners::PairGeometry,
    },
    model::{
        camera::Camera,
        cluster::{Gate, Reach},
        scene::{Scene, ViewIndex, ViewPoints},
    },
};

/// Numbers that a backend contributes to planning.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct PlanningNumbers {
    /// Method 7.1.
    pub gate: Gate,
    /// What the program can match of a pair, by its own rule, if images are matched at this share
    /// of the model's size; `None`: everything.
    #[serde(skip)]
    pub reach: Option<ReachRule>,
    /// Method 7.2.
    pub confidence: PairConfidence,
    /// Method 7.4.
    pub photometric: Photometric,
    /// Number of depth maps that must see a triangle (m, method 5.2).
    pub support: u32,
    /// Work of a depth map (method 5.8).
    pub work: WorkPerMap,
    /// Data sets that the numbers were measured on, or the backend that they were taken from; a few
    /// words.
    pub measured: &'static str,
    /// What a user has to know of the shares that these numbers lead to, a sentence.
    pub caution: Option<&'static str>,
    /// Source of the numbers and the gate, with the reason.
    pub source: &'static str,
}

/// Returns a program's rule for the pairs of a key view, matched at a share of the model's size.
pub type ReachRule =
    for<'a> fn(&'a Scene, &'a ViewPoints, ViewIndex, f64) -> Box<dyn ReachOfPair + 'a>;

/// A program's matching limits, applied to pairs with one key view.
pub trait ReachOfPair {
    /// Returns what it can match of a pair.
    fn reach(&self, pair: &PairGeometry) -> Reach;

    /// Returns whether the program refuses the pair. One-sided: may accept, on a sample of the
    /// points, a borderline pair for which [`Self::reach`] returns [`Reach::Nothing`].
    fn refuses(&self, pair: &PairGeometry) -> bool;
}

/// Work of a depth map: `fixed + Mpx (per_map + partners)`, in Mpx matched with one partner.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct WorkPerMap {
    /// Work that does not depend on the size of the images, such as the start of the program.
    pub fixed: f64,
    /// Work that does not depend on the partners, in partners.
    pub per_map: f64,
}

impl WorkPerMap {
    /// Returns the work of a depth map. `megapixels`: of the matched image.
    pub fn map_work(&self, megapixels: f64, partners: usize) -> f64 {
        self.fixed + megapixels * (self.per_map + partners as f64)
    }
}

/// The MVS program that a plan is made for.
#[derive(Clone, Copy, Debug)]
pub struct Matcher {
    /// Value of `--backend`.
    pub name: &'static str,
    pub numbers: PlanningNumbers,
    /// Size at which the program matches a camera's images by itself, over their own.
    pub own_scale: fn(&Camera) -> f64,
    /// True if it can match key views at different sizes and fuse their depth maps.
    pub mixes_sizes: bool,
    /// False if it uses the images themselves and makes no depth maps.
    pub makes_maps: bool,
}

impl Matcher {
    /// Returns the size at which the program matches the largest images of the scene by itself,
    /// over their own; 1 without views.
    pub fn image_scale(&self, scene: &Scene) -> f64 {
        let cameras = scene.view_indices().map(|view| scene.camera_of(view));
        cameras
            .max_by_key(|camera| camera.width.max(camera.height))
            .map_or(1.0, self.own_scale)
    }
}
