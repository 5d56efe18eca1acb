//! Fulfilment ([method 3]): how well a cluster meets the wanted completeness, resolution and
//! accuracy on a triangle, 0 to 1.
//!
//! [`Model`] holds all inputs of f; [`value`] is its definition in f64, for one (cluster, triangle)
//! pair. [`block`] computes the same for many triangles at once.
//!
//! ```text
//! f     = (α f_res + (1 − α) f_unc) · f_cov · f_conf     each factor 0 to 1
//! f_res = min(ρ g_d², 1)                                 ρ: px² of the key view per area of t
//! f_unc = min(a_d / √u, 1)                               u: largest eigenvalue of Cov
//! Cov   = (Σ_c J_cᵀ J_c / σ_px²)⁻¹                       3 × 3, world frame, scene units²
//! ```
//!
//! f_cov is 1 where enough cameras see t, else 0; f_conf is the [confidence](super::confidence).
//! J_c is the 2 × 3 Jacobian of the projection at the centroid of t, pixels of the matched image
//! per scene unit, of the key view and of each partner that sees t; g_d and a_d are the
//! [target](super::target).
//!
//! ```
//! use viewrank_core::{
//!     base::column::Storage,
//!     method::{confidence::Unary, fulfilment, synthetic::Town, target::TargetSettings},
//!     model::scene::ViewIndex,
//! };
//!
//! // Pixels of 5 cm, and points that are right to 1 cm.
//! let wanted = TargetSettings { accuracy: Some(0.01), ..TargetSettings::default() };
//! let town = Town { edge: 4.0, points: 300, ..Town::default() };
//! let town = town.seen(&wanted, 0.05, Storage::Memory);
//! let unary = Unary::certain();
//! let model = town.model(&unary);
//!
//! let key = ViewIndex(12);
//! let triangle = town.visibility.triangles_seen_by(key)[0];
//! let mut partners = town.visibility.views();
//! partners.retain(|&view| view != key && town.visibility.row(view, triangle).is_some());
//! let f = |partners| fulfilment::value(&model, key, partners, triangle);
//! let [one, two, all] = [f(&partners[..1]), f(&partners[..2]), f(&partners)];
//! // Three cameras must see a triangle, the key view among them.
//! assert_eq!([one.coverage, two.coverage], [0.0, 1.0]);
//! // Partners add accuracy; the resolution is that of the key view.
//! assert!(two.uncertainty < all.uncertainty && two.resolution == all.resolution);
//! assert_eq!(all.value, 0.5 * all.resolution + 0.5 * all.uncertainty);
//! ```
//!
//! [method 3]: https://github.com/viewrank/viewrank/blob/main/docs/method.md#3-fulfilment-of-a-triangle-by-a-cluster

pub mod block;
mod by_triangle;
mod half_size;
mod lanes;
mod settings;

use nalgebra::Matrix3;

use self::block::{Block, BlockSlots};
pub use self::by_triangle::{ByTriangle, Rows};
pub use self::half_size::half_size;
pub use self::settings::{CoverageSettings, FulfilmentSettings};
use crate::method::{geometry::Geometry, target::Target};
use crate::{
    base::{
        column::{self, Column, ColumnBuilder, DiskError, TableError},
        progress::Watcher,
    },
    method::{
        confidence::{Agreement, Confidence, Constellation, PairAgreement, Unary},
        visibility::{self, Visibility},
    },
    model::{
        cluster::{MapScale, ViewCluster},
        scene::{Scene, ViewIndex},
        surface::Surface,
    },
};

/// Clusters evaluated in parallel before their rows are appended to the table; bounds the memory of
/// unfinished rows.
pub const BATCH: usize = 64;

/// Parameters of f (method 3).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FulfilmentRule {
    /// Weight of resolution against uncertainty, 0 to 1. 1: resolution alone.
    pub alpha: f64,
    /// Standard deviation of a match, pixels of the matched image.
    pub sigma_px: f64,
    /// Minimum number of cameras that see a triangle, including the key view (x in the paper).
    pub min_cameras: u32,
    /// Size of the matched images relative to the model's images.
    pub image_scale: f64,
    pub confidence: Confidence,
}

/// All inputs of f.
#[derive(Clone, Copy)]
pub struct Model<'a> {
    pub scene: &'a Scene,
    pub surface: &'a Surface,
    pub visibility: &'a Visibility,
    pub target: &'a Target,
    pub unary: &'a Unary,
    /// Photometric agreement of the pairs whose pictures were compared (method 7.4).
    pub agreement: &'a Agreement,
    pub rule: FulfilmentRule,
}

impl<'a> Model<'a> {
    pub fn new(
        geometry: Geometry<'a>,
        unary: &'a Unary,
        agreement: &'a Agreement,
        rule: FulfilmentRule,
    ) -> Self {
        let Geometry {
            scene,
            surface,
            visibility,
            target,
            ..
        } = geometry;
        Self {
            scene,
            surface,
            visibility,
            target,
            unary,
            agreement,
            rule,
        }
    }

    /// Returns the inputs that confidence depends on.
    pub fn geometry(&self) -> Geometry<'a> {
        let Self {
            scene,
            surface,
            visibility,
            target,
            ..
        } = *self;
        Geometry {
            scene,
            surface,
            visibility,
            target,
            image_scale: self.rule.image_scale,
        }
    }

    /// Returns the model for matched images of this size relative to the plan's.
    pub fn at(&self, scale: MapScale) -> Self {
        let rule = FulfilmentRule {
            image_scale: self.rule.image_scale * scale.factor(),
            ..self.rule
        };
        Self { rule, ..*self }
    }

    /// Lets the operating system drop pages of tables on disk; they are read again when needed.
    pub fn release(&self) {
        self.visibility.triangles.release();
        self.unary.release();
        self.agreement.release();
    }
}

/// f of a triangle and its factors, each 0 to 1.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Fulfilment {
    /// f_cov: 1 if enough cameras see the triangle, else 0.
    pub coverage: f64,
    /// f_res, resolution.
    pub resolution: f64,
    /// f_unc, uncertainty.
    pub uncertainty: f64,
    /// f_conf, confidence.
    pub confidence: f64,
    pub value: f64,
}

/// f(t, cluster) of every cluster: sparse table, CSR by cluster, triangles ascending; only entries
/// with f > 0.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FulfilmentTable {
    /// Start of each cluster's row, and the end of the last: clusters + 1 entries.
    pub offsets: Vec<usize>,
    pub triangles: Column<u32>,
    /// f, in (0, 1].
    pub values: Column<f32>,
}

impl FulfilmentTable {
    /// Builds a table from each cluster's triangles and their f.
    pub fn new<R: AsRef<[(u32, f32)]>>(clusters: impl IntoIterator<Item = R>) -> Self {
        let (mut offsets, mut triangles, mut values) = (vec![0], Vec::new(), Vec::new());
        for row in clusters {
            triangles.extend(row.as_ref().iter().map(|entry| entry.0));
            values.extend(row.as_ref().iter().map(|entry| entry.1));
            offsets.push(triangles.len());
        }
        Self {
            offsets,
            triangles: triangles.into(),
            values: values.into(),
        }
    }

    /// Lets the operating system drop pages of a table on disk; they are read again when needed.
    pub fn release(&self) {
        self.triangles.release();
        self.values.release();
    }

    pub fn clusters(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// Returns a cluster's triangles and their f.
    pub fn row(&self, cluster: usize) -> (&[u32], &[f32]) {
        let rows = self.offsets[cluster]..self.offsets[cluster + 1];
        (&self.triangles[rows.clone()], &self.values[rows])
    }
}

/// An unfinished [`FulfilmentTable`], append only, one cluster at a time.
pub struct FulfilmentTableBuilder {
    offsets: Vec<usize>,
    triangles: ColumnBuilder<u32>,
    values: ColumnBuilder<f32>,
}

impl FulfilmentTableBuilder {
    /// Starts an empty table with the storage (memory or disk) of `visibility`, which has at least
    /// as many rows.
    pub fn like(visibility: &Visibility) -> Result<Self, DiskError> {
        let (keep, rows) = (visibility.triangles.storage(), visibility.triangles.len());
        let (mut triangles, mut values) = (ColumnBuilder::new(keep)?, ColumnBuilder::new(keep)?);
        triangles.reserve(rows);
        values.reserve(rows);
        Ok(Self {
            offsets: vec![0],
            triangles,
            values,
        })
    }

    /// Appends a cluster, given f of each triangle that its key view sees.
    pub fn push(&mut self, triangles: &[u32], values: &[f32]) -> Result<(), DiskError> {
        let fulfilled = triangles.iter().zip(values).filter(|(_, f)| **f > 0.0);
        let (triangles, values): (Vec<u32>, Vec<f32>) = fulfilled.unzip();
        self.triangles.extend(&triangles)?;
        self.values.extend(&values)?;
        self.offsets
            .push(self.offsets.last().expect("starts with one") + values.len());
        Ok(())
    }

    pub fn finish(self) -> Result<FulfilmentTable, DiskError> {
        let Self {
            offsets,
            triangles,
            values,
        } = self;
        Ok(FulfilmentTable {
            offsets,
            triangles: triangles.finish()?,
            values: values.finish()?,
        })
    }
}

/// Computes f of all clusters, in their order.
pub fn table(
    model: &Model,
    clusters: &[ViewCluster],
    watcher: &dyn Watcher,
) -> Result<FulfilmentTable, TableError> {
    let mut table = FulfilmentTableBuilder::like(model.visibility)?;
    let of_cluster = |slots: &mut BlockSlots, cluster: &ViewCluster| {
        watcher.check()?;
        let mut block = Block::new(model, cluster.key, &cluster.partners, |_| false, slots);
        Ok(block.values(&(0..cluster.partners.len()).collect::<Vec<_>>()))
    };
    column::in_order(
        clusters,
        BATCH,
        || BlockSlots::new(model),
        of_cluster,
        |batch, rows| {
            // The pages that each batch reads would add up to the whole tables.
            model.release();
            batch.iter().zip(rows).try_for_each(|(cluster, f)| {
                table.push(model.visibility.triangles_seen_by(cluster.key), &f)
            })
        },
    )?;
    Ok(table.finish()?)
}

/// Returns f of one triangle for one cluster by the definition; 0 if the key view does not see the
/// triangle.
pub fn value(model: &Model, key: ViewIndex, partners: &[ViewIndex], triangle: u32) -> Fulfilment {
    let Some(success) = Success::new(model, key, partners, triangle) else {
        return Fulfilment::default();
    };
    let (rule, gsd) = (&model.rule, f64::from(model.target.gsd[triangle as usize]));
    let resolution = (density(model, key, triangle) * gsd * gsd).min(1.0);
    let views = success.seeing.iter().copied().chain([key]);
    let uncertainty = uncertainty(model, views, triangle);
    let Success {
        coverage,
        confidence,
        ..
    } = success;
    let weighted = rule.alpha * resolution + (1.0 - rule.alpha) * uncertainty;
    Fulfilment {
        coverage,
        resolution,
        uncertainty,
        confidence,
        value: weighted * coverage * confidence,
    }
}

/// Returns f_unc of a triangle that these views see.
fn uncertainty(model: &Model, views: impl Iterator<Item = ViewIndex>, triangle: u32) -> f64 {
    let information = views
        .map(|view| information(model, view, triangle))
        .sum::<Matrix3<f64>>();
    // The largest eigenvalue of the inverse is the reciprocal of the smallest of the matrix.
    // Rounding may make that of a singular sum negative.
    let smallest = information.symmetric_eigenvalues().min().max(0.0);
    (model.target.accuracy(triangle) * smallest.sqrt()).min(1.0)
}

/// The partners of a cluster that see a triangle, and the factors of f that follow.
struct Success {
    seeing: Vec<ViewIndex>,
    coverage: f64,
    confidence: f64,
}

impl Success {
    /// Returns `None` if the key view does not see the triangle.
    fn new(model: &Model, key: ViewIndex, partners: &[ViewIndex], triangle: u32) -> Option<Self> {
        model.visibility.row(key, triangle)?;
        let chances = partners.iter().filter_map(|&partner| {
            let chance = chance(model, key, partner, triangle)?;
            Some((partner, chance))
        });
        let (seeing, chances): (Vec<ViewIndex>, Vec<f64>) = chances.unzip();
        let rule = &model.rule;
        let coverage = if 1 + seeing.len() >= rule.min_cameras as usize {
            1.0
        } else {
            0.0
        };
        Some(Self {
            seeing,
            coverage,
            confidence: rule.confidence.at_least(chances.into_iter()),
        })
    }
}

/// Returns p_i of a pair at a triangle; `None` unless both views see it.
fn chance(model: &Model, key: ViewIndex, partner: ViewIndex, triangle: u32) -> Option<f64> {
    let row_of = |view| model.visibility.row(view, triangle);
    let (key_row, row) = (row_of(key)?, row_of(partner)?);
    let confidence = &model.rule.confidence;
    Some(match (confidence, model.agreement.of_pair(key, partner)) {
        (Confidence::Photometric { agreement, .. }, PairAgreement::Compared(values)) => {
            agreement.chance(values[key_row - model.visibility.rows(key).start])
        }
        (Confidence::Photometric { .. }, PairAgreement::NoCandidate) => 0.0,
        _ => {
            let by_view = model.unary.at(key_row).with(model.unary.at(row));
            let constellation = Constellation::new(&model.geometry(), key, partner, triangle);
            confidence.pair(&constellation, by_view)
        }
    })
}

/// Returns rho of method 3.2: pixels of the matched image per squared scene unit, from the area of
/// the triangle between its projected corners; if a corner does not project, the density at the
/// centroid. 0 for a triangle without area.
fn density(model: &Model, key: ViewIndex, triangle: u32) -> f64 {
    let (camera, pose) = (
        model.scene.camera_of(key),
        &model.scene.view(key).cam_from_world,
    );
    let corners = model
        .surface
        .corners(triangle)
        .map(|v| pose.camera_from_world(&v));
    let normal = (corners[1] - corners[0]).cross(&(corners[2] - corners[0]));
    let projected = visibility::projected_area(camera, &corners);
    let density = 2.0 * projected / normal.norm() * model.rule.image_scale.powi(2);
    if density.is_finite() { density } else { 0.0 }
}

/// Returns J^T J / sigma_px^2 of method 3.3 at the centroid, in the world frame, per squared scene
/// unit.
pub fn information(model: &Model, view: ViewIndex, triangle: u32) -> Matrix3<f64> {
    let pose = &model.scene.view(view).cam_from_world;
    let centroid = pose.camera_from_world(&model.surface.centroid(triangle));
    let Some((_, jacobian)) = model.scene.camera_of(view).project_with_jacobian(&centroid) else {
        return Matrix3::zeros();
    };
    let jacobian =
        jacobian * pose.rotation.matrix() * (model.rule.image_scale / model.rule.sigma_px);
    jacobian.transpose() * jacobian
}

#[cfg(test)]
mod tests;
