//! Masks that the plan cannot use, or that leave nothing to use.

use super::{Finding, Inputs, Severity, ViewFinding, counted};
use crate::{
    config::ConfidenceSource,
    io::{image::ImageError, pictures::PictureFolders},
    method::confidence::{ALL_COUNTS, NOT_COMPARED},
    model::scene::ViewIndex,
};

/// Number of masks whose pixels are read, spread over the views.
const READ: usize = 32;

/// A view that has a mask, and the fault of that.
type Checked = (ViewIndex, Result<(), ImageError>);

pub fn findings(inputs: &Inputs) -> Vec<Finding> {
    let pictures = PictureFolders::new(inputs.project);
    let consequence = match inputs
        .settings
        .confidence
        .source
        .in_force(inputs.project.images.is_some())
    {
        // Masks only lower the confidence (method 7.2), which is off here.
        ConfidenceSource::None => return Vec::new(),
        ConfidenceSource::Geometric => ALL_COUNTS,
        ConfidenceSource::Photometric | ConfidenceSource::Auto => NOT_COMPARED,
    };
    if !pictures.have_masks() {
        return Vec::new();
    }
    if let Some([what, cure]) = pictures.unused_masks(inputs.scene) {
        return vec![Finding::new(Severity::Warning, "unused-masks", what, cure)];
    }
    let check = |view| Some((view, pictures.check_mask(inputs.scene, view)?));
    let checked: Vec<Checked> = inputs.scene.view_indices().filter_map(check).collect();
    [
        stray(inputs, &pictures),
        broken(inputs, &checked, consequence),
        black(inputs, &checked, &pictures),
    ]
    .into_iter()
    .flatten()
    .collect()
}

/// Reports masks that belong to no image, while others do.
fn stray(inputs: &Inputs, pictures: &PictureFolders) -> Option<Finding> {
    let stray = pictures.stray_masks(inputs.scene);
    let cure = pictures
        .naming_of_masks(inputs.scene)
        .filter(|_| !stray.is_empty())?;
    let what = format!(
        "{} without an image of this name",
        counted(stray.len(), "mask")
    );
    let names = stray
        .into_iter()
        .map(|path| ViewFinding::new(path.display().to_string(), ""))
        .collect();
    Some(Finding::new(Severity::Warning, "stray-masks", what, cure).of_views(names))
}

/// Reports masks that cannot be used, by header and end of their files.
fn broken(inputs: &Inputs, checked: &[Checked], consequence: &str) -> Option<Finding> {
    let finding = |(view, fault): &Checked| {
        Some(inputs.view_finding(*view, fault.as_ref().err()?.to_string()))
    };
    let broken: Vec<ViewFinding> = checked.iter().filter_map(finding).collect();
    (!broken.is_empty()).then(|| {
        let what = format!("{} cannot be used: {consequence}", counted(broken.len(), "mask"));
        let cure = "make them again from images of the model's size, black where nothing counts, or remove them";
        Finding::new(Severity::Warning, "broken-masks", what, cure).of_views(broken)
    })
}

/// Reports masks without a pixel that counts, among a few.
fn black(inputs: &Inputs, checked: &[Checked], pictures: &PictureFolders) -> Option<Finding> {
    let usable: Vec<ViewIndex> = checked
        .iter()
        .filter(|(_, fault)| fault.is_ok())
        .map(|(view, _)| *view)
        .collect();
    let read: Vec<ViewIndex> = usable
        .iter()
        .copied()
        .step_by(usable.len().div_ceil(READ).max(1))
        .collect();
    let is_black = |view: &ViewIndex| pictures.is_all_masked(inputs.scene, *view);
    let black: Vec<ViewIndex> = read.iter().copied().filter(is_black).collect();
    (!black.is_empty()).then(|| {
        let what = format!(
            "masks that exclude all of the image: {} of {} that were read",
            black.len(),
            read.len()
        );
        let cure = "make them black only where nothing counts; perhaps they are inverted";
        Finding::new(Severity::Warning, "black-masks", what, cure).of_views(inputs.named(black))
    })
}
