//! Thumbnails of the views.

use std::{collections::BTreeMap, path::Path};

use base64::{Engine, prelude::BASE64_STANDARD};
use image::{ExtendedColorType, ImageEncoder, codecs::jpeg::JpegEncoder};
use rayon::prelude::*;

use crate::{
    base::progress::{Cancelled, Watcher},
    method::confidence::Image,
    model::scene::ViewIndex,
    plan::Plan,
};

/// Largest number of thumbnails, about 3 kB each; with more views, only the first in the ranking get one.
pub const MOST: usize = 500;
/// Long side, pixels.
const SIDE: u32 = 112;
const QUALITY: u8 = 55;

/// JPEG files in base64 by view. Views whose image is missing or cannot be read have no entry.
pub fn thumbnails(plan: &Plan, images: &Path, watcher: &dyn Watcher) -> Result<BTreeMap<u32, String>, Cancelled> {
    let in_order = plan.ranked().map(|cluster| cluster.key);
    let views: Vec<ViewIndex> = match plan.stages.scene.views.len() <= MOST {
        true => plan.stages.scene.view_indices().collect(),
        false => in_order.take(MOST).collect(),
    };
    let of_view = |&view: &ViewIndex| {
        watcher.check()?;
        let small = thumbnail(&images.join(plan.stages.scene.name(view)));
        Ok(small.map(|jpeg| (view.0, BASE64_STANDARD.encode(jpeg))))
    };
    let all: Vec<Option<(u32, String)>> = views.par_iter().map(of_view).collect::<Result<_, Cancelled>>()?;
    Ok(all.into_iter().flatten().collect())
}

fn thumbnail(path: &Path) -> Option<Vec<u8>> {
    let small = Image::read(path, |full| within(full, SIDE)).ok()?;
    let mut jpeg = Vec::new();
    let encoder = JpegEncoder::new_with_quality(&mut jpeg, QUALITY);
    encoder.write_image(&small.rgb, small.width, small.height, ExtendedColorType::Rgb8).ok()?;
    Some(jpeg)
}

/// The size in pixels, reduced so that the longer side is at most `side`.
fn within([width, height]: [u32; 2], side: u32) -> [u32; 2] {
    let scale = (f64::from(side) / f64::from(width.max(height))).min(1.0);
    [width, height].map(|side| ((f64::from(side) * scale).round() as u32).max(1))
}
