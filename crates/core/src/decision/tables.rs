//! The results of the stages that a decision reads.

use super::CountedPlaces;
use crate::{
    method::{
        confidence::{Agreement, Unary},
        fulfilment::{FulfilmentRule, FulfilmentTable, Model},
        partners::Candidates,
        ranking::{Maps, Objective},
        region::Region,
        target::Target,
        twins::Twin,
        visibility::{Shown, Visibility},
    },
    model::{
        cluster::{MapScale, ViewCluster},
        scene::{Scene, ViewIndex},
        surface::Surface,
    },
};

/// The results of all stages up to the view clusters and their fulfilment.
#[derive(Clone, Debug)]
pub struct Tables {
    pub scene: Scene,
    pub surface: Surface,
    pub visibility: Visibility,
    /// Number of views, pixels and finest GSD of each triangle.
    pub shown: Shown,
    /// Region of interest (method 5.7); `None`: the whole surface.
    pub region: Option<Region>,
    /// g_d and a_d of each triangle (method 3.6).
    pub target: Target,
    /// Views whose image is missing, unreadable or rejected ([`Agreement::rejected`]), ascending:
    /// neither key views nor partners.
    pub without_image: Vec<ViewIndex>,
    /// Views that are kept apart for tests, ascending: neither key views nor partners.
    pub kept_for_tests: Vec<ViewIndex>,
    /// Views that are set aside for a sharper one from the same place, ascending: neither key views
    /// nor partners.
    pub twins: Vec<Twin>,
    pub candidates: Candidates,
    /// Unary confidence of each row of `visibility`.
    pub unary: Unary,
    /// Agreement of the pictures of candidate pairs, if confidence is photometric.
    pub agreement: Agreement,
    /// How f is computed (method 3).
    pub rule: FulfilmentRule,
    /// Objective of the plan (method 5.1).
    pub objective: Objective,
    /// One per view that can be a key view, in the order of the views.
    pub clusters: Vec<ViewCluster>,
    /// f of each cluster: predicted, or measured where the cluster is finished.
    pub fulfilment: FulfilmentTable,
    /// The same at half the size; `None` where all maps have full size.
    pub half: Option<FulfilmentTable>,
    /// The places of the pilot, which the ranking counts; `None` without pictures.
    pub pilot: Option<CountedPlaces>,
    /// Work of each cluster's map at full and at half size, in Mpx matched with one partner (method
    /// 5.8).
    pub work: Vec<[f64; 2]>,
}

impl Tables {
    /// Returns the inputs of f, with which any view cluster can be evaluated.
    pub fn model(&self) -> Model<'_> {
        Model {
            scene: &self.scene,
            surface: &self.surface,
            visibility: &self.visibility,
            target: &self.target,
            unary: &self.unary,
            agreement: &self.agreement,
            rule: self.rule,
        }
    }

    /// Returns the depth maps to choose from.
    pub fn maps(&self) -> Maps<'_> {
        match &self.half {
            None => Maps::full_size(&self.fulfilment),
            Some(half) => Maps::two_sizes(&self.fulfilment, half, &self.work),
        }
    }

    /// Returns the work of a cluster's map, for any cluster, over that of all at full size.
    pub fn shares_of_work(&self) -> impl Fn(u32, MapScale) -> f64 {
        let all: f64 = self.work.iter().map(|[full, _]| full).sum();
        move |cluster, scale| {
            self.work[cluster as usize][usize::from(scale == MapScale::Half)] / all
        }
    }

    /// Approximate memory of the tables, surface and scene, bytes.
    pub fn bytes(&self) -> u64 {
        let fulfilment = self.fulfilment.triangles.bytes() + self.fulfilment.values.bytes();
        let tables = self.visibility.triangles.bytes() + self.unary.bytes() + fulfilment;
        // Corners and what is shown of each triangle.
        let surface = 24 * self.surface.vertices.len() + (12 + 16) * self.surface.triangles.len();
        let scene = 64 * self.scene.points.len() + 24 * self.scene.observations();
        (tables + surface + scene) as u64
    }
}
