//! Fulfilment of half-size depth maps (method 5.8).

use super::{FulfilmentTable, FulfilmentTableBuilder, Model, table};
use crate::{
    base::{
        column::{READ_AT_ONCE, TableError},
        progress::Watcher,
    },
    model::cluster::{MapScale, ViewCluster},
};

/// Returns f of clusters at half size: f by the half-size pixels and their deviations, plus `worth`
/// (0 to 1) times the difference to f at full size, `full`.
pub fn half_size(
    model: &Model,
    clusters: &[ViewCluster],
    full: &FulfilmentTable,
    worth: f64,
    watcher: &dyn Watcher,
) -> Result<FulfilmentTable, TableError> {
    let half = table(&model.at(MapScale::Half), clusters, watcher)?;
    let mut blended = FulfilmentTableBuilder::like(model.visibility)?;
    for cluster in 0..clusters.len() {
        // No triangle is lost: with fewer pixels and larger deviations, f is 0 wherever it is at
        // full size.
        let values = blended_row(full.row(cluster), half.row(cluster), worth as f32);
        blended.push(full.row(cluster).0, &values)?;
        if cluster.is_multiple_of(READ_AT_ONCE) {
            full.release();
            half.release();
        }
    }
    Ok(blended.finish()?)
}

/// Returns f of the triangles of a row at full size. Those without f at half size have 0 there.
fn blended_row(
    (triangles, values): (&[u32], &[f32]),
    mut half: (&[u32], &[f32]),
    worth: f32,
) -> Vec<f32> {
    let blend = |(&t, &fine): (&u32, &f32)| {
        let before = half.0.partition_point(|&other| other < t);
        half = (&half.0[before..], &half.1[before..]);
        let own = if half.0.first() == Some(&t) {
            half.1[0]
        } else {
            0.0
        };
        own + worth * (fine - own)
    };
    triangles.iter().zip(values).map(blend).collect()
}
