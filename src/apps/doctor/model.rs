//! Images and sub-models that the model leaves out, and warnings from reading it.

use super::{FEW, Finding, Inputs, Severity, ViewFinding, counted};
use crate::{
    base::{advice::on_command_line, error::Advice},
    io::project::ProjectKind,
    model::scene::{ModelWarning, WarningKind},
};

/// Finding of a model whose observations are mere projections: they say nothing of its links.
pub const NO_TRACKS: &str = "no-tracks";

pub fn findings(inputs: &Inputs) -> Vec<Finding> {
    warnings(inputs)
        .into_iter()
        .chain(unregistered(inputs))
        .chain(no_images(inputs))
        .collect()
}

/// Returns the warnings from reading the model, which a plan gives too.
fn warnings(inputs: &Inputs) -> Vec<Finding> {
    let finding = |warning: &ModelWarning| {
        let (severity, check, cure) = match warning.kind {
            WarningKind::OtherModels => return other_models(inputs, warning),
            WarningKind::OtherParts => (
                Severity::Warning,
                "other-sub-models",
                "join them in the program that made the model, and export it again",
            ),
            WarningKind::OtherWorkspace => (
                Severity::Warning,
                "other-workspace",
                "undistort again from this model (viewrank undistort)",
            ),
            WarningKind::Damaged => (
                Severity::Warning,
                "model-not-as-it-should-be",
                "write the model again with the program that made it",
            ),
            WarningKind::NoPoints => (
                Severity::Error,
                "no-points",
                "export the model with its sparse points",
            ),
            WarningKind::Projected => (
                Severity::Note,
                NO_TRACKS,
                "no action needed; with the tracks of structure from motion, hidden points would not count as seen",
            ),
            WarningKind::Guessed => (
                Severity::Warning,
                "guessed-sizes",
                "put the images where the model expects them; visibility depends on the guessed sizes",
            ),
            WarningKind::Format => (
                Severity::Note,
                "format",
                "no action needed; this is how the format is read",
            ),
        };
        // The reader knows the format, and so the better remedy.
        let cure = warning.cure.as_ref().map_or(cure.into(), on_command_line);
        Finding::new(severity, check, &warning.text, cure)
    };
    inputs.scene.warnings.iter().map(finding).collect()
}

/// Reports sub-models that are not read; copies of the one that is read are harmless.
fn other_models(inputs: &Inputs, warning: &ModelWarning) -> Finding {
    let what = &warning.text;
    let others = &inputs.project.other_models;
    let copies = inputs.project.copies(inputs.scene);
    if !copies.is_empty() && copies.len() == others.len() {
        let cure = "no action needed; the others have mostly the same images";
        return Finding::new(Severity::Note, "model-copies", what, cure);
    }
    let largest = others
        .iter()
        .filter(|model| !copies.contains(model))
        .map(|model| model.registered)
        .max();
    let few = |largest: u64| (largest as f64) < FEW * inputs.scene.views.len() as f64;
    let severity = if largest.is_some_and(few) {
        Severity::Note
    } else {
        Severity::Warning
    };
    let join = if inputs.project.model.format.is_colmap() {
        "match images between them again in COLMAP"
    } else {
        "join them in the program that made them"
    };
    let another = warning
        .cure
        .clone()
        .unwrap_or_else(|| Advice::text("plan each by itself (").set("model").and(")"));
    let cure = on_command_line(&Advice::text(join).and("; until then, ").join(another));
    Finding::new(severity, "other-sub-models", what, cure)
}

/// Reports images without a pose.
fn unregistered(inputs: &Inputs) -> Option<Finding> {
    let left = &inputs.scene.unregistered;
    let all = left.len() + inputs.scene.views.len();
    let severity = if (left.len() as f64) < FEW * all as f64 {
        Severity::Note
    } else {
        Severity::Warning
    };
    (!left.is_empty()).then(|| {
        let what = format!(
            "{} of {} have no pose in the model and are left out",
            left.len(),
            counted(all, "image")
        );
        let cure =
            "match them with more images in structure from motion, or remove them from the folder";
        let views = left.iter().map(|name| ViewFinding::new(name, "")).collect();
        Finding::new(severity, "unregistered-images", what, cure).of_views(views)
    })
}

fn no_images(inputs: &Inputs) -> Option<Finding> {
    let alone = inputs.project.kind == ProjectKind::BareModel;
    let severity = if alone {
        Severity::Note
    } else {
        Severity::Warning
    };
    inputs.project.images.is_none().then(|| {
        let what = "no image folder found: the images can be neither examined nor matched";
        let cure = inputs.project.where_images_belong();
        Finding::new(severity, "no-images", what, cure)
    })
}
