//! Thumbnails of the views and of the expected success of their depth maps.

use std::{collections::BTreeMap, path::Path};

use base64::{Engine, prelude::BASE64_STANDARD};
use image::{ExtendedColorType, ImageEncoder, codecs::jpeg::JpegEncoder};
use rayon::prelude::*;

use crate::{
    base::{
        pixels::PixelBound,
        progress::{Cancelled, Watcher},
    },
    io::{image::Image, project::ImageFolder},
    model::{cluster::ViewCluster, scene::ViewIndex},
    plan::Plan,
    show::pictures::{expected_success, in_colour},
};

/// Largest number of thumbnails, about 3 kB each; with more views, only the first in the ranking
/// get one.
pub const MOST: usize = 500;
/// Long side, pixels.
const SIDE: u32 = 112;
const QUALITY: u8 = 55;

/// Returns JPEG files in base64 by view. Views whose image is missing or cannot be read have no
/// entry.
pub fn thumbnails(
    plan: &Plan,
    images: &ImageFolder,
    watcher: &dyn Watcher,
) -> Result<BTreeMap<u32, String>, Cancelled> {
    let in_order = plan.ranked().map(|cluster| cluster.key);
    let views: Vec<ViewIndex> = if plan.stages.scene.views.len() <= MOST {
        plan.stages.scene.view_indices().collect()
    } else {
        in_order.take(MOST).collect()
    };
    let of_view = |&view: &ViewIndex| {
        let scene = &plan.stages.scene;
        let bound = scene.camera_of(view).most_picture_pixels();
        let small = thumbnail(&images.file(scene.name(view)), bound);
        (view, small)
    };
    by_view(&views, of_view, watcher)
}

/// Makes the JPEG files of these, each of a view; returns them in base64.
fn by_view<T: Sync>(
    all: &[T],
    make: impl Fn(&T) -> (ViewIndex, Option<Vec<u8>>) + Sync,
    watcher: &dyn Watcher,
) -> Result<BTreeMap<u32, String>, Cancelled> {
    let made = all.par_iter().map(|one| {
        watcher.check()?;
        let (view, jpeg) = make(one);
        Ok(jpeg.map(|jpeg| (view.0, BASE64_STANDARD.encode(jpeg))))
    });
    let made: Vec<Option<_>> = made.collect::<Result<_, Cancelled>>()?;
    Ok(made.into_iter().flatten().collect())
}

/// Largest number of key views with a picture of their expected success.
const MOST_EXPECTED: usize = 200;

/// Returns the expected success of the first clusters, as JPEG files in base64 by key view.
pub fn expected(plan: &Plan, watcher: &dyn Watcher) -> Result<BTreeMap<u32, String>, Cancelled> {
    let model = plan.stages.model();
    let of_cluster = |cluster: &&ViewCluster| {
        let camera = plan.stages.scene.camera_of(cluster.key);
        let [width, height] = within([camera.width, camera.height], SIDE);
        let colours = in_colour(&expected_success(&model, cluster, width, height));
        (cluster.key, encoded(&colours, width, height))
    };
    let clusters: Vec<&ViewCluster> = plan.chosen().take(MOST_EXPECTED).collect();
    by_view(&clusters, of_cluster, watcher)
}

fn thumbnail(path: &Path, bound: PixelBound) -> Option<Vec<u8>> {
    let small = Image::read(path, bound, |full| within(full, SIDE)).ok()?;
    encoded(&small.rgb, small.width, small.height)
}

fn encoded(rgb: &[u8], width: u32, height: u32) -> Option<Vec<u8>> {
    let mut jpeg = Vec::new();
    let encoder = JpegEncoder::new_with_quality(&mut jpeg, QUALITY);
    encoder
        .write_image(rgb, width, height, ExtendedColorType::Rgb8)
        .ok()?;
    Some(jpeg)
}

/// Returns the size in pixels, reduced so that the longer side is at most `side`.
fn within([width, height]: [u32; 2], side: u32) -> [u32; 2] {
    let scale = (f64::from(side) / f64::from(width.max(height))).min(1.0);
    [width, height].map(|side| ((f64::from(side) * scale).round() as u32).max(1))
}
