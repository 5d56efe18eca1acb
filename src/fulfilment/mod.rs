//! Method 3: how well a triangle meets the wanted completeness, resolution and accuracy.
//!
//! `f = (alpha f_res + (1 - alpha) f_unc) f_cov f_conf`, each factor in [0, 1]. [`Model`] is everything that f depends on, [`value`]
//! its definition, one (cluster, triangle) at a time, [`table`] the same for all triangles of many clusters.

mod information;
mod look;
mod success;
mod target;

use rayon::prelude::*;

pub use information::Information;
pub use look::{Eye, Look};
pub use success::Successes;
pub use target::{GSD_MARGIN, Target};

use crate::{
    confidence::{Confidence, Unary},
    partners::ViewCluster,
    progress::{Cancelled, Watcher},
    scene::{Scene, ViewIndex},
    surface::Surface,
    visibility::Visibility,
};

/// The numbers of method 3.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rule {
    /// Weight of resolution against uncertainty, 0 to 1.
    pub alpha: f64,
    /// Standard deviation of a match, pixels of the matched image.
    pub sigma_px: f64,
    /// Cameras that must see a triangle, the key view included (x).
    pub min_cameras: u32,
    /// Size of the matched images over the model's images.
    pub image_scale: f64,
    pub confidence: Confidence,
}

/// Everything that f depends on.
#[derive(Clone, Copy)]
pub struct Model<'a> {
    pub scene: &'a Scene,
    pub surface: &'a Surface,
    pub visibility: &'a Visibility,
    pub target: &'a Target,
    pub unary: &'a Unary,
    pub rule: Rule,
}

/// f of a triangle and its factors.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Fulfilment {
    /// f_cov: 1 where enough cameras see the triangle, else 0.
    pub coverage: f64,
    /// f_res.
    pub resolution: f64,
    /// f_unc.
    pub uncertainty: f64,
    /// f_conf.
    pub confidence: f64,
    pub value: f64,
}

impl Rule {
    /// f from f_res, the key view's look, and the looks of the partners that see the triangle.
    pub fn fulfilment(&self, resolution: f64, key: &Look, partners: impl IntoIterator<Item = Look>) -> Fulfilment {
        let (mut information, mut successes, mut cameras) = (key.information, Successes::default(), 1);
        for partner in partners {
            information += partner.information;
            successes = successes.with(self.confidence.pair(key, &partner));
            cameras += 1;
        }
        let coverage = if cameras >= self.min_cameras { 1.0 } else { 0.0 };
        let uncertainty = information.smallest_eigenvalue_to_one().sqrt();
        let confidence = self.confidence.min_matches().map_or(1.0, |matches| successes.at_least(matches));
        let quality = self.alpha * resolution + (1.0 - self.alpha) * uncertainty;
        Fulfilment { coverage, resolution, uncertainty, confidence, value: quality * coverage * confidence }
    }
}

/// f(t, cluster) of every cluster, CSR by cluster, triangles ascending, only f > 0.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FulfilmentTable {
    /// Clusters + 1 entries.
    pub offsets: Vec<usize>,
    pub triangles: Vec<u32>,
    /// In (0, 1].
    pub values: Vec<f32>,
}

impl FulfilmentTable {
    pub fn clusters(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// Triangles of a cluster and their fulfilment.
    pub fn of(&self, cluster: usize) -> (&[u32], &[f32]) {
        let rows = self.offsets[cluster]..self.offsets[cluster + 1];
        (&self.triangles[rows.clone()], &self.values[rows])
    }

    /// Joins the rows of clusters, in their order.
    pub fn from_rows(rows: Vec<FulfilmentRow>) -> Self {
        let entries = rows.iter().map(|row| row.triangles.len()).sum();
        let mut table =
            Self { offsets: vec![0], triangles: Vec::with_capacity(entries), values: Vec::with_capacity(entries) };
        for row in rows {
            table.triangles.extend_from_slice(&row.triangles);
            table.values.extend_from_slice(&row.values);
            table.offsets.push(table.triangles.len());
        }
        table
    }
}

/// f of one cluster: triangles ascending, only f > 0.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FulfilmentRow {
    pub triangles: Vec<u32>,
    pub values: Vec<f32>,
}

impl FulfilmentRow {
    /// Σ f over all triangles.
    pub fn sum(&self) -> f64 {
        self.values.iter().map(|&f| f64::from(f)).sum()
    }
}

/// f of any clusters, in their order.
pub fn table(model: &Model, clusters: &[ViewCluster], watcher: &dyn Watcher) -> Result<FulfilmentTable, Cancelled> {
    let row_of = |cluster: &ViewCluster| watcher.check().map(|()| row(model, cluster.key, &cluster.partners));
    let rows = clusters.par_iter().map(row_of).collect::<Result<Vec<_>, _>>()?;
    Ok(FulfilmentTable::from_rows(rows))
}

/// f of one cluster for every triangle that its key view sees.
pub fn row(model: &Model, key: ViewIndex, partners: &[ViewIndex]) -> FulfilmentRow {
    let eye = Eye::new(model, key);
    let first_row = model.visibility.rows(key).start;
    let mut partners: Vec<Walker> = partners.iter().map(|&partner| Walker::new(model, partner)).collect();
    let mut found = FulfilmentRow::default();
    for (i, &triangle) in model.visibility.of(key).iter().enumerate() {
        let seeing: Vec<(usize, usize)> =
            partners.iter_mut().enumerate().filter_map(|(j, p)| Some((j, p.row_of(triangle)?))).collect();
        if 1 + seeing.len() < model.rule.min_cameras as usize {
            continue;
        }
        let Some(look) = eye.look(triangle, first_row + i) else { continue };
        let looks = seeing.iter().filter_map(|&(j, row)| partners[j].eye.look(triangle, row));
        let f = model.rule.fulfilment(eye.resolution(triangle), &look, looks).value as f32;
        if f > 0.0 {
            found.triangles.push(triangle);
            found.values.push(f);
        }
    }
    found
}

/// Walks through a view's visible triangles beside ascending triangles of another view.
struct Walker<'a> {
    eye: Eye<'a>,
    triangles: &'a [u32],
    first_row: usize,
    at: usize,
}

impl<'a> Walker<'a> {
    fn new(model: &'a Model<'a>, view: ViewIndex) -> Self {
        let (triangles, first_row) = (model.visibility.of(view), model.visibility.rows(view).start);
        Self { eye: Eye::new(model, view), triangles, first_row, at: 0 }
    }

    /// The row of the visibility table for a triangle not below the last one asked for; `None`: not visible.
    fn row_of(&mut self, triangle: u32) -> Option<usize> {
        while self.triangles.get(self.at).is_some_and(|&t| t < triangle) {
            self.at += 1;
        }
        (self.triangles.get(self.at) == Some(&triangle)).then_some(self.first_row + self.at)
    }
}

/// f of one triangle by one cluster, by the definition; 0 where the key view does not see the triangle.
pub fn value(model: &Model, key: ViewIndex, partners: &[ViewIndex], triangle: u32) -> Fulfilment {
    let look = |view: ViewIndex| {
        let position = model.visibility.of(view).binary_search(&triangle).ok()?;
        Eye::new(model, view).look(triangle, model.visibility.rows(view).start + position)
    };
    let Some(key_look) = look(key) else { return Fulfilment::default() };
    let resolution = Eye::new(model, key).resolution(triangle);
    model.rule.fulfilment(resolution, &key_look, partners.iter().filter_map(|&partner| look(partner)))
}
