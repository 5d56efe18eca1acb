//! Partition of a selection by area.

use nalgebra::{Point3, Vector3};

use super::Selection;
use crate::{
    base::tiles,
    model::{cluster::RankedCluster, scene::ViewIndex},
};

/// Splits the clusters of a selection into `count` areas with about equal numbers, in rank order
/// within an area. A cluster belongs to the area of the mean of the sparse points that its key view
/// observes. With fewer distinct places there are fewer areas.
pub fn clusters_by_area(selection: &Selection, count: usize) -> Vec<Vec<RankedCluster>> {
    let points = selection.scene.view_points();
    let home = |key: ViewIndex| {
        let observed = points
            .observed_by(key)
            .iter()
            .map(|p| selection.scene.points[p.index()].coords);
        // A key view without points goes to the tile of the origin, rather than into none.
        let n = observed.len().max(1) as f64;
        Point3::from(observed.sum::<Vector3<f64>>() / n)
    };
    let homes: Vec<Point3<f64>> = selection
        .clusters
        .iter()
        .map(|cluster| home(cluster.key))
        .collect();
    let inside = |tile: &tiles::Tile| -> Vec<RankedCluster> {
        let clusters = selection.clusters.iter().zip(&homes);
        clusters
            .filter(|(_, home)| tile.contains(home))
            .map(|(cluster, _)| cluster.clone())
            .collect()
    };
    tiles::split_into(&homes, count)
        .iter()
        .map(inside)
        .filter(|clusters| !clusters.is_empty())
        .collect()
}
