//! Sizes of the images and maps of PatchmatchNet, and the words of commands that hold them.

use super::{AGREEING, lists::Lists};
use crate::{
    backends::Selection,
    model::cluster::{MapScale, RankedCluster},
};

/// Returns width and height of a picture of which PatchmatchNet makes the longest side at most
/// `longest`; it rounds down.
pub(super) fn reduced(size: [u32; 2], longest: Option<u32>) -> [u32; 2] {
    let side = size[0].max(size[1]);
    let scale = longest.map_or(1.0, |longest| f64::from(longest) / f64::from(side));
    size.map(|side| (scale.min(1.0) * f64::from(side)) as u32)
}

/// Returns the longest side to which images are reduced to be matched or fused at this size,
/// pixels; `None` at their own.
pub(super) fn limit(selection: &Selection, lists: &Lists, scale: MapScale) -> Option<u32> {
    let scale = matched_scale(selection, scale);
    (scale < 1.0).then(|| longest(lists, scale))
}

/// Matched size as a part of the image's.
fn matched_scale(selection: &Selection, scale: MapScale) -> f64 {
    selection.image_scale.min(1.0) * scale.factor()
}

/// Says how many key views are not matched at the planned size: the program reduces to one longest
/// side, whatever the image had.
pub(super) fn at_another_size(selection: &Selection, lists: &Lists) -> Option<String> {
    let is_other = |cluster: &&RankedCluster| {
        let (camera, scale) = (
            selection.scene.camera_of(cluster.key),
            matched_scale(selection, cluster.scale),
        );
        let side = camera.width.max(camera.height);
        scale < 1.0 && longest(lists, scale).min(side) != (f64::from(side) * scale) as u32
    };
    let other = selection.clusters.iter().filter(is_other).count();
    (other > 0).then(|| {
        let plural = if other == 1 { "" } else { "s" };
        format!("planned size of {other} map{plural}: images are reduced to one longest side, so smaller ones are reduced less")
    })
}

/// Returns the longest side of a picture that is matched at this size, pixels.
fn longest(lists: &Lists, scale: f64) -> u32 {
    (f64::from(lists.longest) * scale) as u32
}

/// The words of commands with their values.
pub(super) struct Words([(&'static str, String); 7]);

impl Words {
    pub fn new(selection: &Selection, lists: &Lists, scale: MapScale) -> Self {
        let size = matched_scale(selection, scale);
        // No picture is smaller.
        let least = |axis: usize| {
            let sides = lists.sizes.iter().map(|size| size[axis]);
            ((f64::from(sides.min().unwrap_or(0)) * size) as u32).to_string()
        };
        let most = selection.most_partners();
        let limit = limit(selection, lists, scale).map(|side| format!(" --image_max_dim {side}"));
        Self([
            (
                "INPUT",
                if scale == MapScale::Half {
                    "/half".into()
                } else {
                    String::new()
                },
            ),
            ("VIEWS", (most + 1).to_string()),
            ("PARTNERS", most.to_string()),
            ("WIDTH", least(0)),
            ("HEIGHT", least(1)),
            ("AGREEING", AGREEING.to_string()),
            ("SIZE", limit.unwrap_or_default()),
        ])
    }

    pub fn fill(&self, command: &str) -> String {
        self.0
            .iter()
            .fold(command.into(), |text: String, (word, with)| {
                text.replace(word, with)
            })
    }
}
