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
        let (triangles, values) = full.row(cluster);
        let mut coarse = half.row(cluster);
        let blend = |(&t, &fine): (&u32, &f32)| {
            let before = coarse.0.partition_point(|&other| other < t);
            coarse = (&coarse.0[before..], &coarse.1[before..]);
            let own = if coarse.0.first() == Some(&t) {
                coarse.1[0]
            } else {
                0.0
            };
            own + worth as f32 * (fine - own)
        };
        let values: Vec<f32> = triangles.iter().zip(values).map(blend).collect();
        blended.push(triangles, &values)?;
        if cluster.is_multiple_of(READ_AT_ONCE) {
            full.release();
            half.release();
        }
    }
    Ok(blended.finish()?)
}
