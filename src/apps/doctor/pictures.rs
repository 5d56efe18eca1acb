//! Pictures that add little: blurred ones, and those taken again from the same place.

use rayon::prelude::*;

use super::{Finding, Inputs, Severity};
use crate::{
    base::progress::NoWatcher,
    io::pictures::PictureFolders,
    method::{
        confidence::Sharpness,
        twins::{self, Twin},
    },
    model::scene::ViewIndex,
};

/// Most pictures that are decoded: of more, evenly spread ones. A plan names all that are blurred.
const MOST_DECODED: usize = 400;

pub fn findings(inputs: &Inputs) -> Vec<Finding> {
    [blurred, twins]
        .iter()
        .filter_map(|check| check(inputs))
        .collect()
}

/// Reports images that are less sharp than the others of their camera.
fn blurred(inputs: &Inputs) -> Option<Finding> {
    // What is left of a damaged image says nothing of its sharpness.
    let without_image = inputs.images.without_image(inputs.scene.views.len());
    let pictures = PictureFolders::new(inputs.project).without(&without_image);
    let all: Vec<ViewIndex> = inputs.scene.view_indices().collect();
    let step = all.len().div_ceil(MOST_DECODED).max(1);
    let views: Vec<ViewIndex> = all.iter().copied().step_by(step).collect();
    let detail = |&view: &ViewIndex| {
        // Pictures that cannot be read are named elsewhere; without detail they count for nothing.
        let grey = pictures.grey(inputs.scene, view, 1.0).ok().flatten();
        grey.map_or([0.0; 2], |(grey, _)| grey.detail())
    };
    let found: Vec<[f64; 2]> = views.par_iter().map(detail).collect();
    let mut detail = vec![[0.0; 2]; all.len()];
    for (view, found) in views.iter().zip(found) {
        detail[view.index()] = found;
    }
    let blurred: Vec<ViewIndex> = Sharpness::new(inputs.scene, &detail).blurred().collect();
    (!blurred.is_empty()).then(|| {
        let seen = match step {
            1 => "images",
            _ => "images that were looked at",
        };
        let of = format!("{} of {} {seen}", blurred.len(), views.len());
        let are = if blurred.len() == 1 { "is" } else { "are" };
        let what = format!("{of} {are} blurred, compared with the others of the same camera");
        let cure = "leave them out where others show the same; less of them will match";
        Finding::new(Severity::Warning, "blurred-images", what, cure)
            .of_views(inputs.named(blurred))
    })
}

/// Reports images that show the same from the same place as a sharper one.
fn twins(inputs: &Inputs) -> Option<Finding> {
    let (scene, faults) = (inputs.scene, inputs.images);
    let pictures = PictureFolders::new(inputs.project);
    let excluded = twins::Excluded {
        without_image: &faults.without_image(scene.views.len()),
        tests: &[],
    };
    let twins = twins::twins(scene, inputs.points, excluded, &pictures, 1.0, &NoWatcher).ok()?;
    (!twins.is_empty()).then(|| {
        let of = format!("{} of {} images", twins.len(), scene.views.len());
        let show = if twins.len() == 1 { "shows" } else { "show" };
        let what = format!("{of} {show} the same from the same place as another, no less sharp");
        let finding = |twin: &Twin| {
            let sharper = format!("{} is used for it", scene.name(twin.sharper));
            inputs.view_finding(twin.view, sharper)
        };
        let cure = "nothing to do: plans use one of each place, the sharpest";
        Finding::new(Severity::Note, "twin-images", what, cure)
            .of_views(twins.iter().map(finding).collect())
    })
}
