//! Small pictures of the views.

use std::{collections::BTreeMap, io::Cursor, path::Path};

use base64::{Engine, prelude::BASE64_STANDARD};
use image::{ImageReader, Limits, codecs::jpeg::JpegEncoder};
use rayon::prelude::*;

use crate::{
    plan::Plan,
    progress::{Cancelled, Watcher},
    scene::ViewIndex,
};

/// Views beyond which only those first in the ranking get a picture, of some 3 kB each.
pub const MOST: usize = 500;
/// Long side, pixels.
const SIDE: u32 = 112;
const QUALITY: u8 = 55;
/// An image that needs more memory is left out.
const MAX_BYTES: u64 = 1 << 30;

/// JPEG files in base64 by view; images that are not there, or not to be read, have none.
pub fn thumbnails(plan: &Plan, images: &Path, watcher: &dyn Watcher) -> Result<BTreeMap<u32, String>, Cancelled> {
    let in_order = plan.ranked().map(|cluster| cluster.key);
    let views: Vec<ViewIndex> = match plan.scene.views.len() <= MOST {
        true => plan.scene.view_indices().collect(),
        false => in_order.take(MOST).collect(),
    };
    let of_view = |&view: &ViewIndex| {
        watcher.check()?;
        let small = thumbnail(&images.join(plan.scene.name(view)));
        Ok(small.map(|jpeg| (view.0, BASE64_STANDARD.encode(jpeg))))
    };
    let all: Vec<Option<(u32, String)>> = views.par_iter().map(of_view).collect::<Result<_, Cancelled>>()?;
    Ok(all.into_iter().flatten().collect())
}

fn thumbnail(path: &Path) -> Option<Vec<u8>> {
    let mut reader = ImageReader::open(path).ok()?.with_guessed_format().ok()?;
    let mut limits = Limits::default();
    limits.max_alloc = Some(MAX_BYTES);
    reader.limits(limits);
    let small = reader.decode().ok()?.thumbnail(SIDE, SIDE).into_rgb8();
    let mut jpeg = Cursor::new(Vec::new());
    JpegEncoder::new_with_quality(&mut jpeg, QUALITY).encode_image(&small).ok()?;
    Some(jpeg.into_inner())
}
