//! Method 2: which view sees which triangle.

use crate::{
    config::VisibilitySettings,
    progress::{Cancelled, Watcher},
    scene::{Scene, ViewIndex},
    surface::Surface,
};

/// The sparse table of (view, triangle), CSR by view, triangles ascending within a view.
#[derive(Clone, Debug, Default)]
pub struct Visibility {
    /// Views + 1 entries.
    pub offsets: Vec<usize>,
    /// Triangles, ascending within a view.
    pub triangles: Vec<u32>,
    /// Observations that contradict the table: the view observes a sparse point on the plane of a triangle that it is said not to see.
    pub contradictions: u64,
}

impl Visibility {
    /// The triangles that the view sees, ascending.
    pub fn of(&self, view: ViewIndex) -> &[u32] {
        &self.triangles[self.rows(view)]
    }

    /// Range of the view's rows; tables beside this one (unary confidence) are indexed by row.
    pub fn rows(&self, view: ViewIndex) -> std::ops::Range<usize> {
        self.offsets[view.at()]..self.offsets[view.at() + 1]
    }

    /// Is the triangle seen by at least one view?
    pub fn seen(&self, triangles: usize) -> Vec<bool> {
        let mut seen = vec![false; triangles];
        self.triangles.iter().for_each(|&t| seen[t as usize] = true);
        seen
    }

    /// The table for the surface without the triangles where `keep` is false, renumbered as [`Surface::keep`] does.
    pub fn keep(&self, keep: &[bool]) -> Self {
        let mut next = 0;
        let number = |&k: &bool| {
            let kept = if k { next } else { u32::MAX };
            next += u32::from(k);
            kept
        };
        let numbers: Vec<u32> = keep.iter().map(number).collect();
        let mut kept = Self { offsets: vec![0], triangles: Vec::new(), contradictions: self.contradictions };
        for rows in self.offsets.windows(2) {
            let view = self.triangles[rows[0]..rows[1]].iter();
            kept.triangles.extend(view.map(|&t| numbers[t as usize]).filter(|&t| t != u32::MAX));
            kept.offsets.push(kept.triangles.len());
        }
        kept
    }
}

/// Which view sees which triangle (method 2). `edge_length` is r g_d, the length below which the surface was simplified.
pub fn estimate(
    scene: &Scene,
    surface: &Surface,
    settings: &VisibilitySettings,
    edge_length: f64,
    watcher: &dyn Watcher,
) -> Result<Visibility, Cancelled> {
    let _ = (surface, settings, edge_length, watcher);
    Ok(Visibility { offsets: vec![0; scene.views.len() + 1], ..Default::default() })
}

/// Which triangles at least one view sees; cheaper than [`estimate`]. Reports no progress.
pub fn seen(
    scene: &Scene,
    surface: &Surface,
    settings: &VisibilitySettings,
    edge_length: f64,
    watcher: &dyn Watcher,
) -> Result<Vec<bool>, Cancelled> {
    let _ = (scene, settings, edge_length, watcher);
    Ok(vec![true; surface.triangles.len()])
}
