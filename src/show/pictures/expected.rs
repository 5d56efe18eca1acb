//! Expected success of the depth map of a key view, per pixel of its image.

use crate::{
    method::{
        fulfilment::{self, Model},
        visibility::{NOTHING, front},
    },
    model::cluster::ViewCluster,
};

/// Chance that the backend measures each pixel of the key view's image, reduced to `width` x
/// `height`, row by row: coverage times confidence (method 3.1, 3.4) of the triangle that it shows.
/// `None` where it shows no triangle that the view sees. Lens distortion is ignored.
pub fn expected_success(
    model: &Model,
    cluster: &ViewCluster,
    width: u32,
    height: u32,
) -> Vec<Option<f32>> {
    let seen = model.visibility.triangles_seen_by(cluster.key);
    let shown = front(
        model.scene,
        model.surface,
        cluster.key,
        [width, height],
        0..height,
    );
    let mut drawn: Vec<u32> = shown.iter().copied().filter(|&t| t != NOTHING).collect();
    // The chance is computed once for each triangle, and not for each pixel.
    drawn.sort_unstable();
    drawn.dedup();
    let chance = |&triangle: &u32| {
        let f = fulfilment::value(model, cluster.key, &cluster.partners, triangle);
        seen.binary_search(&triangle)
            .is_ok()
            .then_some((f.coverage * f.confidence) as f32)
    };
    let chances: Vec<Option<f32>> = drawn.iter().map(chance).collect();
    shown
        .into_iter()
        .map(|triangle| {
            drawn
                .binary_search(&triangle)
                .ok()
                .and_then(|place| chances[place])
        })
        .collect()
}
