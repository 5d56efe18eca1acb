//! Method 2: which view sees which triangle.

use crate::scene::ViewIndex;

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
}
